"""Writes the result tables of the documents from ``results/*/summary.json``: ``python -m sb3_htr.experiments.tables``."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.report import RESULTS

DOCUMENTS = (RESULTS.parent / "README.md", RESULTS.parent / "docs" / "results.md", RESULTS.parent / "docs" / "performance.md")
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
    fill(DOCUMENTS, {f"results:{summary['name']}": table(summary) for summary in summaries})


if __name__ == "__main__":
    main()
