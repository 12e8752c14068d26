"""Writes the result tables of README.md from ``results/*/summary.json``: ``python -m sb3_htr.experiments.readme``."""

import json
import re
from pathlib import Path
from typing import Any

from sb3_htr.common.checkpoint import atomic_path
from sb3_htr.experiments.report import RESULTS

README = RESULTS.parent / "README.md"
COLUMNS = {
    "last_episode_return": "return of the 20th episode",
    "success_rate": "tasks solved in it",
    "episodes_to_first_success": "episodes to the first success",
}


def table(summary: dict[str, Any]) -> str:
    """
    :param summary: content of a ``summary.json``
    :return: Markdown table, one line per method and explorer
    """
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in summary["rows"]:
        cells = lines.setdefault((row["method"], row["explorer"]), {})
        cells[row["metric"]] = f"{row['iqm']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"
    first = summary["rows"][0]
    head = ["method", "explorer", *COLUMNS.values()]
    body = [[method, explorer, *(cells[metric] for metric in COLUMNS)] for (method, explorer), cells in lines.items()]
    text = "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body))
    return (
        f"{text}\n\n{first['env']}, {first['env_steps']:,} env steps, {first['n_seeds']} seeds, IQM and 95 % stratified "
        f"bootstrap interval, final models on the test tasks. `{summary['command']}`, commit {summary['commit']}, "
        f"{summary['machine']}.\n"
    )


def main() -> None:
    """Replace what stands between ``<!-- results:NAME -->`` and ``<!-- end -->``."""
    text = README.read_text()
    for path in sorted(Path(RESULTS).glob("*/summary.json")):
        summary = json.loads(path.read_text())
        pattern = rf"(<!-- results:{summary['name']} -->\n).*?(<!-- end -->)"
        text = re.sub(pattern, rf"\g<1>{table(summary)}\g<2>", text, flags=re.DOTALL)
    with atomic_path(README) as temporary:
        temporary.write_text(text)


if __name__ == "__main__":
    main()
