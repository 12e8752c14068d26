"""Tables of the documents, from results that are made up."""

from pathlib import Path
from typing import Any

import pytest
from benchmark_tables import summary
from tables import fill, rivals, times


def slowdown(variant: str, *, low: float | None = None, high: float | None = None, **values: Any) -> dict[str, Any]:
    counts = {"n_seeds": 5, "n_unsolved": 0, "n_at_first": 0, "at_most": False, "at_least": False}
    return {"variant": variant, "iqm": 3.0, "low": low, "high": high, **counts, **values}


@pytest.mark.parametrize(
    "row, shown",
    [
        (slowdown("", low=2.0, high=4.0), "3.0 [2.0, 4.0]"),
        (slowdown("", low=2.0, at_least=True), "≥ 3.0 [2.0, ∞)"),
        (slowdown("", high=4.0, at_most=True, n_at_first=1), "≤ 3.0 [0, 4.0]"),
        (slowdown("", at_least=True, at_most=True, n_at_first=1), ""),
        (slowdown("", at_least=True, at_most=True, n_at_first=5), "at its first evaluation"),
        (slowdown("", at_least=True, at_most=True, n_unsolved=3), "3 of 5 never"),
        (slowdown("", n_seeds=1), "3.0"),
        (slowdown("", n_seeds=1, at_least=True), "≥ 3.0"),
    ],
)
def test_what_is_not_known_of_a_ratio_is_not_shown(row: dict[str, Any], shown: str) -> None:
    assert times(row) == shown


def test_rivals_are_compared_with_the_first_method() -> None:
    def row(variant: str, metric: str, solved: float, **where: Any) -> dict[str, Any]:
        interval = {"iqm": solved, "low": solved - 0.1, "high": solved}
        return {"variant": variant, "explorer": "own", "metric": metric, "env_steps": 1000, "tested_on": where, **interval}

    rows = [
        *(row("mine", "success_rate", 1.0), row("mine", "success_rate", 0.9, goal_distance=2)),
        *(row("slow", "last_episode_return", 5.0), row("slow", "success_rate", 0.5)),
        row("untimed", "success_rate", 0.2),
    ]
    slowdowns = [slowdown("slow", at_least=True, n_unsolved=1, low=2.0)]
    assert [line.strip("| ").split(" | ") for line in rivals({"rows": rows, "slowdowns": slowdowns}).splitlines()] == [
        ["method", "explorer", "env steps", "tasks solved", "tasks solved, goal distance 2", "times the env steps of mine"],
        ["---"] * 6,
        ["mine", "`own`", "1,000", "100% [90%, 100%]", "90% [80%, 90%]", "1"],
        ["slow", "`own`", "1,000", "50% [40%, 50%]", "", "≥ 3.0 [2.0, ∞), 1 of 5 never"],
        ["untimed", "`own`", "1,000", "20% [10%, 20%]"],
    ]


@pytest.mark.parametrize("after", ["old\n", "old\n<!-- two -->\n<!-- end -->\n"], ids=["of the page", "of another block"])
def test_a_block_without_an_end_does_not_take_that_of_another(after: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text := f"<!-- one -->\n{after}the rest\n")
    with pytest.raises(ValueError, match=r"page\.md has no <!-- end --> of its own for <!-- one -->: add it"):
        fill([page], {"one": "new\n"})
    assert page.read_text() == text


def test_the_summary_of_benchmarks_names_the_machines_of_its_rows() -> None:
    def content(name: str, machine: str, goal: float | None) -> dict[str, Any]:
        row = {"name": "one", "unit": "ms", "ours": 2.0, "ratio": 3.0, "goal": goal, "against": "SB3's own"}
        return {"name": name, "machine": machine, "rows": [row]}

    def origin(*contents: dict[str, Any]) -> str:
        return summary(list(contents)).splitlines()[-1]

    here = content("a", "A, 2 cores, 1 thread(s)", 1.0), content("b", "A, 2 cores, 2 thread(s)", 1.0)
    elsewhere = content("c", "B, 4 cores, 1 thread(s)", 1.0)
    unshown = content("d", "C, 1 cores, 1 thread(s)", None)
    assert origin(unshown, *here) == "`make bench`, A, 2 cores, 1 thread(s)."
    assert origin(*here, elsewhere) == "`make bench`, A, 2 cores, and B, 4 cores, 1 thread(s)."
