"""Tables of the documents, from results that are made up."""

from typing import Any

from tables import rivals


def test_rivals_are_compared_with_the_first_method() -> None:
    def row(variant: str, metric: str, solved: float, **where: Any) -> dict[str, Any]:
        interval = {"iqm": solved, "low": solved - 0.1, "high": solved}
        return {"variant": variant, "explorer": "own", "metric": metric, "env_steps": 1000, "tested_on": where, **interval}

    rows = [
        *(row("mine", "success_rate", 1.0), row("mine", "success_rate", 0.9, goal_distance=2)),
        *(row("slow", "last_episode_return", 5.0), row("slow", "success_rate", 0.5)),
        row("untimed", "success_rate", 0.2),
    ]
    slowdowns = [{"variant": "slow", "iqm": 3.0, "low": 2.0, "high": None, "n_unsolved": 1, "n_seeds": 5}]
    assert [line.strip("| ").split(" | ") for line in rivals({"rows": rows, "slowdowns": slowdowns}).splitlines()] == [
        ["method", "explorer", "env steps", "tasks solved", "tasks solved, goal distance 2", "times the env steps of mine"],
        ["---"] * 6,
        ["mine", "`own`", "1,000", "100% [90%, 100%]", "90% [80%, 90%]", "1"],
        ["slow", "`own`", "1,000", "50% [40%, 50%]", "", "≥ 3.0 [2.0, ∞), 1 of 5 never"],
        ["untimed", "`own`", "1,000", "20% [10%, 20%]"],
    ]
