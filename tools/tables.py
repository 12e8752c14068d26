"""Writes the result tables of the documents from ``results/*/summary.json``: ``python tools/tables.py``."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.protocol import MIN_RUNS
from sb3_htr.zoo.run.method import OWN

RESULTS = Path(__file__).parents[1] / "results"
DOCUMENTS = (RESULTS.parent / "README.md", RESULTS.parent / "docs" / "results.md", RESULTS.parent / "docs" / "performance.md")
# The table of README.md, and of PEARL's own protocol: methods by their experiments; explorers with what is shown of them
HEADLINES: dict[str, dict[str, tuple[str, ...]]] = {
    "headline": {
        "point_robot": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "wheeled": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "ant": ("htr-ser", "pearl-dense"),
        "fetch_reach": ("htr-ser", "pearl-sparse"),
        "fetch_push": ("htr-ser", "pearl-sparse"),
        "point_maze": ("htr-ser",),
    },
    "headline:prior": {
        "prior": ("htr-ser-prior", "pearl-dense-prior"),
        "wheeled_prior": ("htr-ser-prior", "pearl-dense-prior"),
        "ant_prior": ("htr-ser", "pearl-dense"),
    },
}
# What the first variant of experiments is compared with
COMPARED: dict[str, dict[str, tuple[str, ...]]] = {
    "differences": {
        "point_robot": ("pearl-sparse", "pearl-dense"),
        "wheeled": ("pearl-sparse", "pearl-dense"),
        "ant": ("pearl-dense",),
        "fetch_reach": ("pearl-sparse",),
        "fetch_push": ("pearl-sparse",),
        "prior": ("pearl-dense-prior",),
        "wheeled_prior": ("pearl-dense-prior",),
    },
    "differences:rivals": {"rivals": ("pearl-dense, tuned", "htr-hipi", "htr-hfr", "rl2", "sac-her")},
}
EXPLORERS = {
    "belief": {"last_episode_return": "return", "success_rate": "tasks solved", "episodes_to_first_success": "first success"},
    "prior": {"last_episode_return": "return", "success_rate": "tasks solved"},
}
COLUMNS = {
    "last_episode_return": "return of episode {n_episodes}",
    "success_rate": "tasks solved in it",
    "episodes_to_first_success": "episodes to the first success",
}


def columns(summary: dict[str, Any]) -> dict[str, str]:
    """
    :param summary: content of a ``summary.json``
    :return: metrics and heads of the columns of scores
    """
    n_episodes = summary["rows"][0].get("n_episodes", 20)
    # A family that tells no successes has none
    has_successes = any(row["metric"] == "success_rate" and row["high"] > 0 for row in summary["rows"])
    shown = COLUMNS if has_successes else ("last_episode_return",)
    return {metric: COLUMNS[metric].format(n_episodes=n_episodes) for metric in shown}


def table(summary: dict[str, Any]) -> str:
    """
    :param summary: content of a ``summary.json``
    :return: Markdown table, one line per env argument, method and explorer; tasks unlike those of training have a column each
    """
    rows = summary["rows"]
    lines: dict[tuple[str, ...], dict[str, dict[str, dict[str, Any]]]] = {}
    settings = sorted({key for row in rows for key in row["env_kwargs"]})
    for row in rows:
        key = (*(str(row["env_kwargs"][setting]) for setting in settings), row["variant"], f"`{row['explorer']}`")
        lines.setdefault(key, {}).setdefault(_place(row), {})[row["metric"]] = row
    settings = [setting.replace("_", " ") for setting in settings]
    shown = columns(summary)
    elsewhere = [place for place in dict.fromkeys(map(_place, rows)) if place]
    head = [*settings, "method", "explorer", *shown.values(), *(f"{place}: return, solved" for place in elsewhere)]
    body = [
        [
            *key,
            *(_score(places.get("", {}), metric) for metric in shown),
            *(_both(places.get(place, {})) for place in elsewhere),
        ]
        for key, places in lines.items()
    ]
    env_steps = " / ".join(f"{n:,}" for n in sorted({row["env_steps"] for row in rows}))
    about = f"{rows[0]['env']}, {env_steps} env steps, {_runs(rows)}."
    later = summary.get("evaluation_commit", summary["commit"])
    # Interquartile means of three runs trim none
    middle = "IQM over runs (of three or fewer, their mean)" if min(row["n_seeds"] for row in rows) <= 3 else "IQM over runs"
    commits = summary["commit"] if later == summary["commit"] else f"{summary['commit']}, evaluated by {later}"
    text = "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body))
    return (
        f"{text}\n\n{about} Final models on the test tasks: {middle}, "
        f"95 % bootstrap interval over runs, tasks and {summary.get('n_eval_seeds', 1)} evaluation seeds. "
        f"`{summary['command']}`, commit {commits}, {summary['machine']}.\n"
    )


def _score(rows: dict[str, dict[str, Any]], metric: str) -> str:
    if metric not in rows:
        return ""
    return _numbers(rows[metric], 2)


def _both(rows: dict[str, dict[str, Any]]) -> str:
    """Return with its interval, and tasks solved."""
    return f"{_score(rows, 'last_episode_return')}, {rows['success_rate']['iqm']:.2f}" if rows else ""


def _runs(rows: list[dict[str, Any]]) -> str:
    """How many there are, of which methods, and whether these are enough."""
    # In the env where there are fewest
    n_runs = {row["variant"]: row["n_seeds"] for row in sorted(rows, key=lambda row: -row["n_seeds"])}
    texts = []
    for n in sorted({*n_runs.values()}, reverse=True):
        few = f", **fewer than the {MIN_RUNS} that a claim needs**" if n < MIN_RUNS else ""
        of = ", ".join(variant for variant, m in n_runs.items() if m == n)
        texts.append(f"{n} run{'s' * (n > 1)}{f' of {of}' if len({*n_runs.values()}) > 1 else ''}{few}")
    return "; ".join(texts)


def _place(row: dict[str, Any]) -> str:
    """What env a model was tested on, other than in training; empty if it was that."""
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in row.get("tested_on", {}).items())


def headline(summaries: dict[str, dict[str, Any]], methods_of: dict[str, tuple[str, ...]]) -> str:
    """
    :param summaries: contents of ``summary.json`` by their names
    :param methods_of: what is shown of them, where they are there
    :return: Markdown table, one line per env and method
    """
    shown = [(explorer, metric) for explorer, metrics in EXPLORERS.items() for metric in metrics]
    heads = [f"`{explorer}`: {EXPLORERS[explorer][metric]}" for explorer, metric in shown]
    lines = [["env", "env steps", "runs", "method", *heads]]
    lines.append(["---"] * len(lines[0]))
    for name, methods in methods_of.items():
        scores: dict[tuple[str, ...], dict[tuple[str, str], str]] = {}
        for row in summaries.get(name, {"rows": []})["rows"]:
            if row["variant"] in methods and not row.get("tested_on") and (row["explorer"], row["metric"]) in shown:
                key = (row["env"], f"{row['env_steps']:,}", str(row["n_seeds"]), row["variant"])
                scores.setdefault(key, {})[row["explorer"], row["metric"]] = _interval(row)
        lines += [[*key, *(cells.get(column, "") for column in shown)] for key, cells in scores.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def differences(summaries: dict[str, dict[str, Any]], methods_of: dict[str, tuple[str, ...]]) -> str:
    """
    :param summaries: contents of ``summary.json`` by their names
    :param methods_of: what their first variant is compared with, where it is there
    :return: Markdown table, one line per env and method: return of the first variant less that of the method, by explorer and,
        by its first one, in the last of the other envs that both were tested in; and env steps, as a multiple of its own
    """
    explorers = ("belief", "learned-prior", "prior")
    lines = [["env", "less", *(f"`{explorer}`" for explorer in explorers), "`belief`, further away", "env steps until solved"]]
    for name, methods in methods_of.items():
        summary = summaries.get(name, {"differences": [], "slowdowns": []})
        for method in methods:
            rows = [row for row in summary["differences"] if row["variant"] == method]
            if not rows:
                continue
            # What explores in a way of its own is compared with the first explorer
            by_place = {
                (explorers[0] if row["explorer"] == OWN else row["explorer"], _place(row)): _numbers(row, 1) for row in rows
            }
            away = [place for explorer, place in by_place if explorer == explorers[0] and place]
            (slowdown,) = (row for row in summary["slowdowns"] if row["variant"] == method)
            n_runs = rows[0]["n_seeds"]
            few = f", {n_runs} run{'s' * (n_runs > 1)}" if n_runs < MIN_RUNS else ""
            cells = [by_place.get((explorer, ""), "") for explorer in explorers]
            further = f"{by_place[explorers[0], away[-1]]} ({away[-1]})" if away else ""
            lines.append([rows[0]["env"], f"`{method}`{few}", *cells, further, _times(slowdown)])
    # Without columns that say nothing
    shown = [column for column in zip(*lines, strict=True) if any(column[1:]) or len(lines) == 1]
    head, *body = zip(*shown, strict=True)
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body)) + "\n"


def _times(row: dict[str, Any]) -> str:
    """How many times as many; runs that never solved enough have no upper limit."""
    if row["low"] is None:
        return ""
    return (
        f"{row['iqm']:.1f} [{row['low']:.1f}, {row['high']:.1f}]" if row["high"] is not None else f"at least {row['low']:.1f}"
    )


def _interval(row: dict[str, Any]) -> str:
    if row["metric"] == "success_rate":
        return f"{row['iqm']:.0%} [{row['low']:.0%}, {row['high']:.0%}]"
    return _numbers(row, 1)


def _numbers(row: dict[str, Any], digits: int) -> str:
    # Adding 0 turns -0 into 0
    iqm, low, high = (f"{round(row[key], digits) + 0.0:.{digits}f}" for key in ("iqm", "low", "high"))
    return f"{iqm} [{low}, {high}]"


def filled(text: str, tables: dict[str, str]) -> str:
    """
    :param text: of a document
    :param tables: what goes between ``<!-- NAME -->`` and ``<!-- end -->``, by name
    :return: the document with it
    """
    for name, content in tables.items():
        start, end = f"<!-- {name} -->\n", "<!-- end -->"
        if start in text:
            before, _, after = text.partition(start)
            text = before + start + content + end + after.partition(end)[2]
    return text


def fill(documents: Iterable[Path], tables: dict[str, str]) -> None:
    """
    :param documents: files to write
    :param tables: see :func:`filled`
    """
    for document in documents:
        text = filled(document.read_text(), tables)
        with atomic_path(document) as temporary:
            temporary.write_text(text)


def tables() -> dict[str, str]:
    """
    :return: of all results that are there, by the names of their marks
    """
    summaries = [json.loads(path.read_text()) for path in sorted(Path(RESULTS).glob("*/summary.json"))]
    own = {f"results:{summary['name']}": table(summary) for summary in summaries}
    by_name = {summary["name"]: summary for summary in summaries}
    headlines = {name: headline(by_name, methods_of) for name, methods_of in HEADLINES.items()}
    return {**own, **headlines, **{name: differences(by_name, methods_of) for name, methods_of in COMPARED.items()}}


def main() -> None:
    """Into all documents."""
    fill(DOCUMENTS, tables())


if __name__ == "__main__":
    main()
