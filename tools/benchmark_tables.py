"""Writes the tables of benchmarks from ``benchmarks/results/*.json``."""

import json
from pathlib import Path
from typing import Any

from tables import fill

from sb3_htr.common.markdown import markdown_table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENTS = [ROOT / name for name in ("docs/performance.md", "docs/rivals.md", "benchmarks/README.md")]


def table(content: dict[str, Any]) -> str:
    """
    :param content: of a result file
    :return: Markdown table, one line for each figure
    """
    lines: list[list[str]] = []
    for row in content["rows"]:
        ratio, goal = (_ratio(row[key]) if row[key] else "" for key in ("ratio", "goal"))
        ours, reference = (f"{row[key]:,.{_decimals(row[key])}f}" if row[key] else "" for key in ("ours", "reference"))
        lines.append([row["name"], f"{ours} {row['unit']}", reference, ratio, goal, row["against"]])
    text = markdown_table(["what", "ours", "alternative", "ratio", "goal", "against"], lines)
    return f"{text}\n\n{_origin(content)}\n"


def summary(contents: list[dict[str, Any]]) -> str:
    """
    :param contents: of result files
    :return: Markdown table of the figures that had a goal, on one thread where there are several, against other libraries
    """
    lines = ["| | ours | times as fast as | |", "| --- | --- | --- | --- |"]
    machines: list[str] = []
    for content in contents:
        for row in content.get("rows", []):
            other_library = row["against"].startswith(("SB3", "katerakelly"))
            other_library &= row["name"] != "fast profile"  # whose networks are smaller than the reference's
            if row["goal"] and other_library and "float32, 2 thread" not in row["name"] and "products, 2" not in row["name"]:
                ours = f"{row['ours']:,.{_decimals(row['ours'])}f} {row['unit']}"
                name = f"{content['name']}: {row['name'].removesuffix(', 1 thread(s)')}"
                lines.append(f"| {name} | {ours} | {row['ratio']:.1f} | {row['against']} |")
                # Without its threads, which are those of the last row of the file
                machines.append(content["machine"].rpartition(", ")[0])
    where = ", and ".join(dict.fromkeys(machines))
    return "\n".join(lines) + f"\n\n`make bench`, {where}, 1 thread(s).\n"


def shares(content: dict[str, Any]) -> str:
    """
    :param content: of a profile
    :return: Markdown table
    """
    lines = [[row["name"].removeprefix("aten::"), f"{row['share']:.1%}"] for row in content["shares"]]
    return f"{markdown_table(['part', 'share of CPU time'], lines)}\n\n{_origin(content)}\n"


def _origin(content: dict[str, Any]) -> str:
    return f"`{content['command']}`, {content['date']}, commit {content['commit']}, {content['machine']}."


def _ratio(value: float) -> str:
    return f"{value:.2f}" if value >= 0.1 else f"{value:.1g}"


def _decimals(value: float) -> int:
    return 0 if value >= 100 else 2 if value >= 1 else 3


def tables() -> dict[str, str]:
    """
    :return: of all benchmarks that were run, by the names of their marks
    """
    contents = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    own = {f"benchmark:{c['name']}": shares(c) if "shares" in c else table(c) for c in contents}
    return {**own, "benchmarks": summary(contents)}


def main() -> None:
    """Into all documents."""
    fill(DOCUMENTS, tables())


if __name__ == "__main__":
    main()
