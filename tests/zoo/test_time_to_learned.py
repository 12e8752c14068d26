"""When a run had learned."""

import math
from pathlib import Path

import numpy as np
import pytest

from sb3_htr.zoo.run.time_to_learned import time_to_learned

N_TASKS, N_EPISODES = 3, 2


def write_run(folder: Path, returns: list[float], log: str | None = None) -> Path:
    """Evaluations each 1,000 env steps, the last adaptation episodes with these mean returns."""
    last = np.array(returns)[:, None] + np.array([-1.0, 0.0, 1.0])
    first = np.full_like(last, 99.0)
    steps = 1000 * np.arange(1, len(returns) + 1)
    np.savez(folder / "evaluations.npz", timesteps=steps, returns=np.stack([first, last], axis=-1))
    if log is not None:
        (folder / "progress.csv").write_text(log)
    return folder


@pytest.mark.parametrize(
    ("returns", "steps"),
    [([0, 9, 9.6, 9.4, 10], 3000), ([-50, -13, -10, -10], 3000), ([0, 12, 10], 2000)],
)
def test_solved_is_95_percent_of_the_way_to_the_last_evaluation(tmp_path: Path, returns: list[float], steps: int) -> None:
    time = time_to_learned(write_run(tmp_path, returns))
    assert time is not None and time[0] == steps and math.isnan(time[1])


def test_seconds_are_those_of_the_log_between_rollouts(tmp_path: Path) -> None:
    log = "time/total_timesteps,eval/mean_reward,time/time_elapsed\n0,,0\n1000,3.5,\n4000,,8\n"
    assert time_to_learned(write_run(tmp_path, [0, 0, 10], log)) == (3000, 6.0)


@pytest.mark.parametrize("returns", [[0, 0, 0], [3, 5, 1]])
def test_what_ends_where_it_was_lowest_has_learned_nothing(tmp_path: Path, returns: list[float]) -> None:
    assert time_to_learned(write_run(tmp_path, returns)) == (math.inf, math.inf)


def test_a_run_without_two_evaluations_says_nothing(tmp_path: Path) -> None:
    assert time_to_learned(tmp_path) is None
    assert time_to_learned(write_run(tmp_path, [10])) is None
