"""The pictures of experiments, from the raw results of their cells."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from htr_envs import PointRobotFamily
from sb3_htr.experiments.runner import Cell
from sb3_htr.zoo.plots.curves import band, finish
from sb3_htr.zoo.plots.intervals import iqm_interval
from sb3_htr.zoo.plots.style import COLOURS

Results = dict[Cell, Path]


def by_variant(results: Results) -> dict[str, list[tuple[Cell, Any]]]:
    """
    :param results: raw results of the cells
    :return: cells and their arrays, by variant
    """
    groups: dict[str, list[tuple[Cell, Any]]] = {}
    for cell, result in results.items():
        groups.setdefault(cell.variant, []).append((cell, np.load(result)))
    return groups


def n_seeds(results: Results) -> int:
    """
    :param results: raw results of the cells
    :return: runs of each variant
    """
    return len({cell.seed for cell in results})


def learning(results: Results, path: Path) -> None:
    """
    Left: learning curves on validation tasks. Right: the final models' adaptation to the test tasks.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    for colour, (variant, runs) in zip(COLOURS, by_variant(results).items(), strict=False):
        curve = np.stack([raw["curve"].mean(axis=1) for _, raw in runs])
        band(left, runs[0][1]["timesteps"] / 1000, curve, colour, "-", variant)
        for explorer, style in zip(runs[0][0].explorers, ("-", "--"), strict=False):
            returns = np.stack([raw[f"returns_{explorer}"].mean(axis=0) for _, raw in runs])
            band(right, np.arange(1, returns.shape[1] + 1), returns, colour, style, f"{variant}, explorer {explorer}")
    left.set_xlabel("thousand env steps of meta-training")
    left.set_ylabel("return of the last adaptation episode")
    left.set_title("validation tasks, during meta-training", fontsize=10)
    right.set_xlabel("adaptation episode")
    right.set_ylabel("return")
    right.xaxis.get_major_locator().set_params(integer=True)
    right.set_title("test tasks, final models", fontsize=10)
    finish(figure, path, f"{next(iter(results)).env_id}: IQM over {n_seeds(results)} seeds, 95 % interval")


def optimal_return(goal_distance: float, max_episode_steps: int) -> float:
    """
    :param goal_distance: argument of SparsePointRobot-v0
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


def goal_distance(results: Results, path: Path) -> None:
    """
    Left: return, relative to the optimum, against the distance. Right: success.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    for colour, (variant, runs) in zip(COLOURS, by_variant(results).items(), strict=False):
        x = sorted({cell.env_kwargs["goal_distance"] for cell, _ in runs})

        def scores(score: Callable[[Cell, Any], float], runs: list[tuple[Cell, Any]] = runs) -> np.ndarray:
            """(n_seeds, n_distances)"""
            ordered = sorted(runs, key=lambda run: (run[0].seed, run[0].env_kwargs["goal_distance"]))
            return np.array([score(*run) for run in ordered]).reshape(n_seeds(results), -1)

        def relative_return(cell: Cell, raw: Any) -> float:
            return float(raw["returns_belief"][:, -1].mean() / optimal_return(**cell.env_kwargs))

        band(left, np.array(x), scores(relative_return), colour, "-", variant)
        success = scores(lambda cell, raw: float(raw["successes_belief"][:, -1].mean()))
        band(right, np.array(x), success, colour, "-", variant)
    left.axhline(1, color=COLOURS[6], linestyle=":", linewidth=1)
    left.set_ylabel("return of the 20th episode / optimum")
    right.set_ylabel("test tasks solved in the 20th episode")
    for axes in (left, right):
        axes.set_xlabel("distance of the goals (1.5: 30 steps, 2: 40 steps, else 20)")
        axes.set_ylim(-0.03, 1.05)
    finish(figure, path, f"{next(iter(results)).env_id}: IQM over {n_seeds(results)} seeds, 95 % interval")


def relabelling(results: Results, path: Path) -> None:
    """
    Left: K against the return on test tasks. Right: learning curves of the other variants on validation tasks.

    :param results: raw results of the cells
    :param path: picture to write
    """
    groups = {variant: [raw for _, raw in runs] for variant, runs in by_variant(results).items()}
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    probabilities = sorted(float(variant.removeprefix("K = ")) for variant in groups if variant.startswith("K = "))
    scores = [np.array([run["returns_belief"][:, -1].mean() for run in groups[f"K = {k:g}"]]) for k in probabilities]
    points = np.array([iqm_interval(score) for score in scores])
    left.plot(probabilities, points[:, 0], "o-", color=COLOURS[0], label="IQM and 95 % interval")
    left.fill_between(probabilities, points[:, 1], points[:, 2], color=COLOURS[0], alpha=0.2, linewidth=0)
    for k, score in zip(probabilities, scores, strict=True):
        left.plot([k] * len(score), score, "o", color=COLOURS[6], markersize=3, label="one seed" if k == 0 else None)
    left.set_xlabel("K, probability of relabelling")
    left.set_ylabel("return of the 20th adaptation episode")
    left.set_title("test tasks, final models", fontsize=10)
    shown = [variant for variant in groups if variant == "K = 0.8" or not variant.startswith("K = ")]
    for colour, variant in zip(COLOURS, shown, strict=False):
        curve = np.stack([run["curve"].mean(axis=1) for run in groups[variant]])
        band(right, groups[variant][0]["timesteps"] / 1000, curve, colour, "-", variant)
    right.set_xlabel("thousand env steps of meta-training")
    right.set_ylabel("return of the last adaptation episode")
    right.set_title("validation tasks, hindsight task strategies and ablation", fontsize=10)
    finish(figure, path, f"{next(iter(results)).env_id}: IQM over {n_seeds(results)} seeds, 95 % interval")
