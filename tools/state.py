"""Writes which results are older than which changes of the code, ``results/changes.yml``: ``python tools/state.py``."""

import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from tables import RESULTS, fill

from sb3_htr.common.markdown import markdown_table
from sb3_htr.experiments.cell import file_name
from sb3_htr.pearl.horizon import settings_for
from sb3_htr.zoo.run.method import OWN, PEARLMethod, methods

DOCUMENTS = (RESULTS.parent / "docs" / "results" / "state.md",)
HEADS = ("results", "runs", "trained by", "changed since, in training", "changed since, in evaluation")
# What raw data say of a run; older ones say less
SAID = ("commit", "evaluation_commit", "cell", "hyperparams", "rl_zero_reward_fraction")


class Run(NamedTuple):
    """
    A run of an experiment.

    :param experiment: folder of its results
    :param variant: name in tables
    :param commits: that trained and that evaluated it, as its raw data name them
    :param facts: of it, which ``where`` in ``changes.yml`` asks for
    :param explorers: that it was evaluated by in the end, during its training, and that of its rollouts
    """

    experiment: str
    variant: str
    commits: tuple[str, str]
    facts: dict[str, Any]
    explorers: tuple[set[str], set[str], set[str]]


def runs(results: Path, envs: dict[str, dict[str, Any]]) -> Iterator[Run]:
    """
    :param results: a folder for each experiment
    :param envs: facts of envs by their ids
    :return: those of all ``raw-*.npz``
    """
    for path in sorted(results.glob("*/raw-*.npz")):
        raw = np.load(path)
        for name in [key.removesuffix("/commit") for key in raw.files if key.endswith("/commit")]:
            said = {key: raw[f"{name}/{key}"] for key in SAID if f"{name}/{key}" in raw}
            cell, hyperparams = (json.loads(str(said.get(key, "{}"))) for key in ("cell", "hyperparams"))
            kwargs = file_name("".join(f"-{key}{value}" for key, value in cell.get("env_kwargs", {}).items()))
            variant = re.sub(r"-seed\d+$", "", name).removesuffix(kwargs)
            if not cell:
                rows = json.loads((path.parent / "summary.json").read_text())["rows"]
                cell = next({**row, "env_id": row["env"]} for row in rows if row["variant"] == variant)
            method = methods().get(cell["method"])
            used = {**(method.hyperparams() if isinstance(method, PEARLMethod) else {}), **cell["settings"], **hyperparams}
            keys = [key.removeprefix(f"{name}/returns_") for key in raw.files if key.startswith(f"{name}/returns_")]
            final = {re.split(r", | \w+=", key)[0] for key in keys}
            during, rollouts = ({_name(used.get(key))} for key in ("explorer", "train_explorer"))
            facts = _facts(cell, used, envs[cell["env_id"]], bool(said.get("rl_zero_reward_fraction") != 1))
            commits = str(said["commit"]), str(said["evaluation_commit"])
            yield Run(path.parent.name, variant, commits, facts, (final, during, rollouts))


def _name(explorer: Any) -> str:
    return str(explorer["name"] if isinstance(explorer, dict) else explorer or OWN)


def _facts(cell: dict[str, Any], used: dict[str, Any], env: dict[str, Any], rewarded: bool) -> dict[str, Any]:
    steps = cell["env_kwargs"].get("max_episode_steps", env["steps"])
    settings = {**settings_for(steps, n_tasks_per_rollout=1), **used}
    return {
        "method": cell["method"],
        "env": cell["env_id"],
        "steps": steps,
        "contexts": steps / settings["context_size"],
        "is": {*env.get("is", ()), *["rewarded"] * rewarded},
    }


def concerns(where: dict[str, Any], facts: dict[str, Any]) -> bool:
    """
    :param where: of a change
    :param facts: of a run
    :return: whether all that is asked for is so
    """
    answers: dict[str, Callable[[Any], bool]] = {
        "methods": lambda patterns: any(fnmatch(facts["method"], pattern) for pattern in patterns),
        "envs": lambda envs: facts["env"] in envs,
        "steps_over": lambda steps: facts["steps"] > steps,
        "contexts_over": lambda contexts: facts["contexts"] > contexts,
        "is": lambda what: facts["is"].issuperset(what),
        "not": lambda other: not concerns(other, facts),
    }
    return all(answers[key](asked) for key, asked in where.items())


@cache
def is_older(code: str, changes: tuple[str, ...], repository: Path) -> bool:
    """
    :param code: commits, as raw data name them
    :param changes: commits of a change
    :param repository: has all of them
    :return: whether one of the former lacks one of the latter
    :raises ValueError: if the code names no commit, or git does not know one
    """
    made_by = re.findall(r"\b[0-9a-f]{7,40}\b", code)
    if not made_by:
        raise ValueError(f"Raw data say that they are of the code {code!r}, expected a commit.")
    for pair in [(change, commit) for change in changes for commit in made_by]:
        asked = subprocess.run(["git", "merge-base", "--is-ancestor", *pair], cwd=repository, capture_output=True, text=True)
        if asked.returncode == 1:
            return True
        if asked.returncode:
            raise ValueError(f"git cannot compare {' and '.join(pair)}: get all of its history. {asked.stderr.strip()}")
    return False


def since(run: Run, changes: list[dict[str, Any]], repository: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """
    :param run: of an experiment
    :param changes: of ``changes.yml``
    :param repository: has all of their commits, and those of the run
    :return: names of those that it is older than, in its training and in its evaluation
    """
    in_training, in_evaluation = [], []
    final, during, rollouts = run.explorers
    for change in [change for change in changes if concerns(change.get("where", {}), run.facts)]:
        name, kind, explorers = change["name"], change["in"], {*change.get("explorers", final | during)}
        trained, evaluated = (partial(is_older, code, tuple(change["commits"]), repository) for code in run.commits)
        if (kind != "evaluation" or ("explorers" in change and explorers & rollouts)) and trained():
            in_training.append(name)
        if kind != "training" and explorers & final and evaluated():
            in_evaluation.append(name)
        elif kind == "evaluation" and explorers & during and trained():
            in_evaluation.append(f"{name} (curves)")
    return tuple(in_training), tuple(in_evaluation)


def state(results: Path) -> str:
    """
    :param results: a folder for each experiment, and ``changes.yml``, within a git repository
    :return: Markdown: what is of today's code, and what is but for changes of rounding; then a table with a line for all runs
        of an experiment that are older than the same changes, those of rounding in a sentence beneath it
    """
    known = yaml.safe_load((results / "changes.yml").read_text(encoding="utf-8"))
    rounding = [change["name"] for change in known["changes"] if change.get("rounding")]
    n_runs: Counter[tuple[str, str]] = Counter()
    today: list[Run] = []
    but_for: dict[str, list[Run]] = {}
    rows: dict[tuple[str, ...], list[Run]] = {}
    not_older: dict[str, list[Run]] = {name: [] for name in rounding}
    for run in runs(results, known["envs"]):
        n_runs[run.experiment, run.variant] += 1
        older = since(run, known["changes"], results)
        shown = [", ".join(name for name in names if name not in rounding) for names in older]
        if any(shown):
            rows.setdefault((run.experiment, *(names or "-" for names in shown)), []).append(run)
            for name in set(rounding).difference(*older):
                not_older[name].append(run)
        elif any(older):
            but_for.setdefault(" and ".join(f"*{name}*" for names in older for name in names), []).append(run)
        else:
            today.append(run)
    text = f"By today's code: {_labels(today, n_runs) or 'none'}.\n\n"
    text += "".join(f"By today's code but for {names}: {_labels(some, n_runs)}.\n\n" for names, some in but_for.items())
    lines = []
    for (_, *changed), some in sorted(rows.items(), key=lambda row: row[0][0]):
        commits = dict.fromkeys(re.sub(r"\b([0-9a-f]{7})[0-9a-f]+", r"\1", run.commits[0]) for run in some)
        lines.append((_labels(some, n_runs), str(len(some)), ", ".join(commits), *changed))
    text += markdown_table(HEADS, lines) + "\n"
    for name, some in not_older.items():
        text += f"\nAll in the table are older than *{name}*, too{', but for ' * bool(some)}{_labels(some, n_runs)}.\n"
    return text


def _labels(some: list[Run], n_runs: Counter[tuple[str, str]]) -> str:
    """Experiments that some runs are of, with their variants if there are other runs of them."""
    labels = []
    for experiment in dict.fromkeys(run.experiment for run in some):
        own = Counter(run.variant for run in some if run.experiment == experiment)
        every = {variant: n for (of, variant), n in n_runs.items() if of == experiment}
        names = [f"`{name}`" + f" ({n} of {every[name]})" * (n < every[name]) for name, n in own.items()]
        labels.append(f"**{experiment}**" + f": {', '.join(names)}" * (own != every))
    return "; ".join(labels)


def tables() -> dict[str, str]:
    """
    :return: by the name of its mark
    """
    return {"state": state(RESULTS)}


def main() -> None:
    """Into its page."""
    fill(DOCUMENTS, tables())


if __name__ == "__main__":
    main()
