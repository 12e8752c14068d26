"""SparsePointRobot-v0 with goals ever further away (HTR paper, figure 11): sparse rewards, dense proxy, HTR."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from htr_envs import PointRobotFamily
from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell
from sb3_htr.zoo.plots.curves import band, finish
from sb3_htr.zoo.plots.adaptation import COLOURS

ENV_ID = "SparsePointRobot-v0"
# Steps of an episode for each distance: time to get there, and as long again
DISTANCES = {0.5: 20, 0.75: 20, 1.0: 20, 1.5: 30, 2.0: 40}
METHODS: dict[str, dict[str, Any]] = {
    "htr-ser": {},
    "pearl-dense": {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}},
    "pearl-sparse": {"replay_buffer_kwargs": {"relabel_probability": 0.0}},
}


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per method and distance
    :param n_timesteps: budget of env steps for episodes of 20 steps; longer ones have as many episodes and updates
    :return: the defaults, those with the dense proxy for actor and critics, and those without relabelling
    """
    return [
        Cell(
            *(ENV_ID, method, seed, n_timesteps * steps // 20, hyperparams),
            env_kwargs={"goal_distance": distance, "max_episode_steps": steps},
            explorers=("search",),
        )
        for seed in range(1, n_seeds + 1)
        for distance, steps in DISTANCES.items()
        for method, hyperparams in METHODS.items()
    ]


def optimal_return(goal_distance: float, max_episode_steps: int) -> float:
    """
    :param goal_distance: argument of the env
    :param max_episode_steps: argument of the env
    :return: mean return over the test tasks of going to the goal as fast as possible and staying there
    """
    goals = PointRobotFamily(goal_distance=goal_distance).test_tasks.astype(np.float64)
    position, total = np.zeros_like(goals), np.zeros(len(goals))
    for _ in range(max_episode_steps):
        # Each axis is clipped on its own, so this is at least as fast as the straight way
        position += np.clip(goals - position, -0.1, 0.1)
        distance = np.linalg.norm(goals - position, axis=1)
        total += np.where(distance < 0.2, 1 - distance, 0)
    return float(total.mean())


def plot(results: dict[Cell, Path], path: Path) -> None:
    """
    Left: return, relative to the optimum, against the distance. Right: success.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    x = np.array(list(DISTANCES))
    n_seeds = len({cell.seed for cell in results})
    for colour, method in zip(COLOURS, METHODS, strict=False):
        returns, successes = np.zeros((n_seeds, len(x))), np.zeros((n_seeds, len(x)))
        for cell, result in results.items():
            if cell.method == method:
                at = cell.seed - 1, list(DISTANCES).index(cell.env_kwargs["goal_distance"])
                raw = np.load(result)
                returns[at] = raw["returns_search"][:, -1].mean() / optimal_return(**cell.env_kwargs)
                successes[at] = raw["successes_search"][:, -1].mean()
        band(left, x, returns, colour, "-", method)
        band(right, x, successes, colour, "-", method)
    left.axhline(1, color=COLOURS[6], linestyle=":", linewidth=1)
    left.set_ylabel("return of the 20th episode / optimum")
    right.set_ylabel("test tasks solved in the 20th episode")
    for axes in (left, right):
        axes.set_xlabel("distance of the goals (1.5: 30 steps, 2: 40 steps, else 20)")
        axes.set_ylim(-0.03, 1.05)
    finish(figure, path, f"{ENV_ID}: IQM over {n_seeds} seeds, 95 % interval")


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("goal_distance", __doc__, cells, 60_000, argv, plot)


if __name__ == "__main__":
    main()
