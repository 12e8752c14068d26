"""Writes the result tables of the documents from ``results/*/summary.json``: ``python -m sb3_htr.experiments.tables``."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.report import RESULTS

DOCUMENTS = (RESULTS.parent / "README.md", RESULTS.parent / "docs" / "results.md", RESULTS.parent / "docs" / "performance.md")
# Experiments and methods in the table of README.md
ENVS = ("point_robot", "wheeled", "ant")
METHODS = {
    "htr-ser": "HTR, sparse rewards",
    "pearl-dense": "PEARL, dense proxy reward",
    "pearl-sparse": "PEARL, sparse rewards",
}
COLUMNS = {
    "last_episode_return": "return of the 20th episode",
    "success_rate": "tasks solved in it",
    "episodes_to_first_success": "episodes to the first success",
}


def table(summary: dict[str, Any]) -> str:
    """
    :param summary: content of a ``summary.json``
    :return: Markdown table, one line per env argument, method and explorer
    """
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    settings = sorted({key for row in summary["rows"] for key in row["env_kwargs"]})
    for row in summary["rows"]:
        key = (*(str(row["env_kwargs"][setting]) for setting in settings), row["method"], row["explorer"])
        lines.setdefault(key, {})[row["metric"]] = f"{row['iqm']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"
    first = summary["rows"][0]
    head = [*(setting.replace("_", " ") for setting in settings), "method", "explorer", *COLUMNS.values()]
    body = [[*key, *(cells[metric] for metric in COLUMNS)] for key, cells in lines.items()]
    env_steps = " / ".join(f"{n:,}" for n in sorted({row["env_steps"] for row in summary["rows"]}))
    text = "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body))
    return (
        f"{text}\n\n{first['env']}, {env_steps} env steps, {first['n_seeds']} seeds, IQM and 95 % stratified "
        f"bootstrap interval, final models on the test tasks. `{summary['command']}`, commit {summary['commit']}, "
        f"{summary['machine']}.\n"
    )


def headline(summaries: dict[str, dict[str, Any]]) -> str:
    """
    :param summaries: contents of ``summary.json`` by their names, those of ``ENVS`` among them where they are there
    :return: Markdown table, one line per env, with each method under the explorer that its runs name first
    """
    lines = [["env", "env steps", "seeds", *METHODS.values()], ["---"] * (3 + len(METHODS))]
    for summary in (summaries[name] for name in ENVS if name in summaries):
        cells = []
        for method in METHODS:
            rows = [row for row in summary["rows"] if row["method"] == method]
            score = {row["metric"]: row for row in rows if row["explorer"] == rows[0]["explorer"]}
            cells.append(
                "{iqm:.1f} [{low:.1f}, {high:.1f}], ".format(**score["last_episode_return"])
                + f"{score['success_rate']['iqm']:.0%} solved"
                if rows
                else ""
            )
        first = summary["rows"][0]
        lines.append([first["env"], f"{first['env_steps']:,}", str(first["n_seeds"]), *cells])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def fill(documents: Iterable[Path], tables: dict[str, str]) -> None:
    """
    Replace what stands between ``<!-- NAME -->`` and ``<!-- end -->``.

    :param documents: files to write
    :param tables: what goes there, by name
    """
    for document in documents:
        text = document.read_text()
        for name, content in tables.items():
            start, end = f"<!-- {name} -->\n", "<!-- end -->"
            if start in text:
                before, _, after = text.partition(start)
                text = before + start + content + end + after.partition(end)[2]
        with atomic_path(document) as temporary:
            temporary.write_text(text)


def main() -> None:
    """All results that are there."""
    summaries = [json.loads(path.read_text()) for path in sorted(Path(RESULTS).glob("*/summary.json"))]
    tables = {f"results:{summary['name']}": table(summary) for summary in summaries}
    fill(DOCUMENTS, {**tables, "headline": headline({summary["name"]: summary for summary in summaries})})


if __name__ == "__main__":
    main()
