"""Writes the result tables of the documents from ``results/*/summary.json``: ``python tools/tables.py``."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.markdown import markdown_table
from sb3_htr.experiments.cell import file_name
from sb3_htr.experiments.protocol import MIN_RUNS
from sb3_htr.experiments.table import numbers, place, table
from sb3_htr.zoo.plots.intervals import iqm_interval
from sb3_htr.zoo.run.method import OWN

RESULTS = Path(__file__).parents[1] / "results"
DOCS = RESULTS.parent / "docs"
PAGES = (DOCS / "performance.md", DOCS / "real_robot.md")
DOCUMENTS = (RESULTS.parent / "README.md", *sorted(DOCS.glob("results/*.md")), *PAGES)
# The table of README.md: envs in words and tasks that are further away, by experiments; heads, methods, whether of such tasks.
# Of tasks as in training, it shows an early adaptation episode, too
SHORT: dict[str, tuple[str, str | None]] = {
    "point_robot": ("Point robot", "goal distance 1.4"),
    "wheeled": ("Wheeled robot", "goal distance 2.5"),
    "ant": ("Ant", "goal distance 2.5"),
    "fetch_reach": ("FetchReach, goal hidden", None),
    "fetch_push": ("FetchPush, goal hidden", None),
}
SHORT_COLUMNS = (
    ("HTR", "htr-ser", False),
    ("HTR, further away", "htr-ser", True),
    ("no relabelling", "pearl-sparse", False),
    ("dense reward in training", "pearl-dense", False),
    ("dense reward, further away", "pearl-dense", True),
)
SHORT_EPISODE = 2
# That of the results, and of PEARL's own protocol: methods by their experiments; explorers with what is shown of them
HEADLINES: dict[str, dict[str, tuple[str, ...]]] = {
    "headline": {
        "point_robot": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "wheeled": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "ant": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "target_speed": ("htr-ser", "pearl-dense", "pearl-sparse"),
        "fetch_reach": ("htr-ser", "pearl-sparse"),
        "fetch_push": ("htr-ser", "pearl-sparse"),
        "point_maze": ("htr-ser",),
    },
    "headline:prior": {
        "prior": ("htr-ser-prior", "pearl-dense-prior", "pearl-sparse-prior"),
        "wheeled_prior": ("htr-ser-prior", "pearl-dense-prior"),
        "ant_prior": ("htr-ser", "pearl-dense"),
    },
}
# What the first variant of experiments is compared with
COMPARED: dict[str, dict[str, tuple[str, ...]]] = {
    "differences": {
        "point_robot": ("pearl-sparse", "pearl-dense"),
        "wheeled": ("pearl-sparse", "pearl-dense"),
        "ant": ("pearl-sparse", "pearl-dense"),
        "target_speed": ("pearl-sparse", "pearl-dense"),
        "fetch_reach": ("pearl-sparse",),
        "fetch_push": ("pearl-sparse",),
        "prior": ("pearl-sparse-prior", "pearl-dense-prior"),
        "wheeled_prior": ("pearl-dense-prior",),
    },
    "differences:rivals": {
        "rivals": (
            *("pearl-dense, tuned", "htr-hipi, tuned", "htr-hipi", "htr-hfr, tuned", "htr-hfr"),
            *("rl2, tuned", "rl2", "sac-her"),
        ),
        "wheeled": ("htr-hipi", "htr-hfr", "rl2", "sac-her"),
        "ant": ("htr-hipi", "htr-hfr", "rl2", "sac-her"),
    },
}
# Where full thrust passes every task, and so solves it: when many are solved first says nothing
PASSED = ("target_speed",)
# Adaptation episodes, of 20, after which the tasks that are solved are shown
EARLY = (1, 2, 5)


def short(summaries: dict[str, dict[str, Any]], results: Path = RESULTS) -> str:
    """
    :param summaries: contents of ``summary.json`` by their names
    :param results: folder of the raw data of each
    :return: Markdown table, one line per env: how many test tasks are solved by ``belief``
    """

    def cell(name: str, row: dict[str, Any] | None) -> str:
        if row is None or row["tested_on"]:
            return _interval(row) if row else ""
        shares = solved_by_episode(results / name / f"raw-{row['method']}.npz", row["variant"], "belief")
        return f"{iqm_interval(shares[:, SHORT_EPISODE - 1])[0]:.0%}, {_interval(row)}"

    lines = []
    for name, (env, further) in SHORT.items():
        rows: dict[tuple[str, str | None], dict[str, Any]] = {
            (row["variant"], place(row)): row
            for row in summaries[name]["rows"]
            if row["metric"] == "success_rate" and row["explorer"] == "belief"
        }
        shown = [rows.get((method, further if away else "")) for _, method, away in SHORT_COLUMNS]
        n_runs = min(row["n_seeds"] for row in shown if row)
        few = f"; {n_runs} runs" if n_runs < MIN_RUNS else ""
        lines.append([env + few, *(cell(name, row) for row in shown)])
    return markdown_table(["env", *(head for head, *_ in SHORT_COLUMNS)], lines) + "\n"


def headline(summaries: dict[str, dict[str, Any]], methods_of: dict[str, tuple[str, ...]], results: Path = RESULTS) -> str:
    """
    :param summaries: contents of ``summary.json`` by their names
    :param methods_of: what is shown of them, where they are there
    :param results: folder of the raw data of each
    :return: Markdown table, one line per env and method
    """
    shown = [(explorer, metric) for explorer in ("belief", "prior") for metric in ("last_episode_return", "success_rate")]
    early = [f"episode {episode}" for episode in EARLY]
    heads = ["`belief`: return", f"solved in {early[0]}", *early[1:], "episode 20", "worst run", "`prior`: return", "solved"]
    lines: list[list[str]] = []
    for name, methods in methods_of.items():
        scores: dict[tuple[str, ...], dict[tuple[str, str], str]] = {}
        for row in summaries.get(name, {"rows": []})["rows"]:
            if row["variant"] in methods and not row["tested_on"] and (row["explorer"], row["metric"]) in shown:
                key = (row["env"], f"{row['env_steps']:,}", str(row["n_seeds"]), row["variant"], row["method"])
                scores.setdefault(key, {})[row["explorer"], row["metric"]] = _interval(row)
        for (env, n_steps, n_runs, variant, method), cells in scores.items():
            returned, solved, *by_prior = (cells.get(column, "") for column in shown)
            shares = solved_by_episode(results / name / f"raw-{method}.npz", variant, "belief")
            begin = [f"{iqm_interval(shares[:, episode - 1])[0]:.0%}" for episode in EARLY]
            lines.append([env, n_steps, n_runs, variant, returned, *begin, solved, f"{shares[:, -1].min():.0%}", *by_prior])
    return markdown_table(["env", "env steps", "runs", "method", *heads], lines) + "\n"


def solved_by_episode(file: Path, variant: str, explorer: str) -> np.ndarray:
    """
    :param file: raw data of runs
    :param variant: whose runs
    :param explorer: by which they adapted
    :return: (n_runs, n_episodes), of the test tasks, which share each run solves in each adaptation episode
    """
    own = re.compile(rf"{re.escape(file_name(variant))}-seed\d+/successes_{explorer}")
    with np.load(file) as raw:
        return np.stack([raw[name].mean(axis=(0, 1)) for name in raw.files if own.fullmatch(name)])


def rivals(summary: dict[str, Any]) -> str:
    """
    :param summary: content of a ``summary.json``
    :return: Markdown table, one line per method: tasks solved by its first explorer, in each env that it was tested in, and
        how many times the env steps of the first method it needs
    """
    explorers: dict[str, str] = {}
    solved: dict[tuple[str, ...], dict[str, str]] = {}
    for row in summary["rows"]:
        if row["metric"] == "success_rate" and row["explorer"] == explorers.setdefault(row["variant"], row["explorer"]):
            key = (row["variant"], f"`{row['explorer']}`", f"{row['env_steps']:,}")
            solved.setdefault(key, {})[place(row)] = _interval(row)
    first = summary["rows"][0]["variant"]
    slower = {first: "1", **{row["variant"]: times(row) for row in summary["slowdowns"]}}
    places = list(dict.fromkeys(where for cells in solved.values() for where in cells))
    heads = [f"tasks solved, {where}" if where else "tasks solved" for where in places]
    lines = [[*key, *(cells.get(where, "") for where in places), slower.get(key[0], "")] for key, cells in solved.items()]
    return markdown_table(["method", "explorer", "env steps", *heads, f"times the env steps of {first}"], lines) + "\n"


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
                (explorers[0] if row["explorer"] == OWN else row["explorer"], place(row)): numbers(row, 1) for row in rows
            }
            away = [where for explorer, where in by_place if explorer == explorers[0] and where]
            (slowdown,) = (row for row in summary["slowdowns"] if row["variant"] == method)
            n_runs = rows[0]["n_seeds"]
            few = f", {n_runs} run{'s' * (n_runs > 1)}" if n_runs < MIN_RUNS else ""
            cells = [by_place.get((explorer, ""), "") for explorer in explorers]
            further = f"{by_place[explorers[0], away[-1]]} ({away[-1]})" if away else ""
            lines.append([rows[0]["env"], f"`{method}`{few}", *cells, further, "" if name in PASSED else times(slowdown)])
    # Without columns that say nothing
    shown = [column for column in zip(*lines, strict=True) if any(column[1:]) or len(lines) == 1]
    head, *body = zip(*shown, strict=True)
    return markdown_table(head, body) + "\n"


def times(row: dict[str, Any]) -> str:
    """
    :param row: of the slowdowns of a ``summary.json``
    :return: how many times as many env steps, or nothing where it may be any smaller and any larger; a single run has no
        interval
    """
    never = f"{row['n_unsolved']} of {row['n_seeds']} never" if row["n_unsolved"] else ""
    if row["at_most"] and row["at_least"]:
        return "at its first evaluation" if row["n_at_first"] == row["n_seeds"] else never
    sign = "≤ " if row["at_most"] else "≥ " if row["at_least"] else ""
    low, high = ("" if row[end] is None else f"{row[end]:.1f}" for end in ("low", "high"))
    interval = f" [{low or 0}, {f'{high}]' if high else '∞)'}" if low or high else ""
    return f"{sign}{row['iqm']:.1f}{interval}" + (never and f", {never}")


def _interval(row: dict[str, Any]) -> str:
    if row["metric"] == "success_rate":
        return f"{row['iqm']:.0%}" + ("" if row["low"] is None else f" [{row['low']:.0%}, {row['high']:.0%}]")
    return numbers(row, 1)


def imperfections(lines: str) -> str:
    """
    :param lines: what ``examples/imperfect_robot.py`` prints of some envs
    :return: a table with a column for each env
    """
    head, *rows = (line.strip("| ").split(" | ") for line in lines.splitlines() if "---" not in line)
    found = {(env, kind): scores for env, kind, *scores in rows if env != head[0]}
    envs, kinds = (list(dict.fromkeys(names)) for names in zip(*found, strict=True))
    shown = [[kind, *("{}; {}, {}".format(*found[env, kind]) for env in envs)] for kind in kinds]
    return markdown_table([head[1], *envs], shown) + "\n"


def filled(text: str, tables: dict[str, str], page: object = "The document") -> str:
    """
    :param text: of a document
    :param tables: what goes between ``<!-- NAME -->`` and ``<!-- end -->``, by name
    :param page: the document, for the message
    :return: the document with it
    :raises ValueError: if a table has no end, or the next one begins before it
    """
    for name, content in tables.items():
        start, end = f"<!-- {name} -->\n", "<!-- end -->"
        if start in text:
            before, _, after = text.partition(start)
            old, found, rest = after.partition(end)
            if not found or "<!--" in old:
                raise ValueError(f"{page} has no {end} of its own for {start.strip()}: add it.")
            text = before + start + content + end + rest
    return text


def fill(documents: Iterable[Path], tables: dict[str, str]) -> None:
    """
    :param documents: files to write
    :param tables: see :func:`filled`
    """
    for document in documents:
        text = filled(document.read_text(encoding="utf-8"), tables, document)
        with atomic_path(document) as temporary:
            temporary.write_text(text, encoding="utf-8")


def tables() -> dict[str, str]:
    """
    :return: of all results that are there, by the names of their marks
    """
    summaries = [json.loads(path.read_text()) for path in sorted(Path(RESULTS).glob("*/summary.json"))]
    own = {f"results:{summary['name']}": table(summary) for summary in summaries}
    by_name = {summary["name"]: summary for summary in summaries}
    headlines = {name: headline(by_name, methods_of) for name, methods_of in HEADLINES.items()}
    headlines["headline:short"] = short(by_name)
    headlines["headline:rivals"] = rivals(by_name["rivals"])
    headlines["imperfections"] = imperfections((RESULTS / "imperfect_robot.md").read_text())
    return {**own, **headlines, **{name: differences(by_name, methods_of) for name, methods_of in COMPARED.items()}}


def main() -> None:
    """Into all documents."""
    fill(DOCUMENTS, tables())


if __name__ == "__main__":
    main()
