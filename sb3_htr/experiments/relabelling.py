"""SparsePointRobot-v0: how often to relabel, which hindsight task to choose, and the ablation of HTR paper, B.2."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell
from sb3_htr.zoo.plots.curves import band, finish
from sb3_htr.zoo.plots.intervals import iqm_interval
from sb3_htr.zoo.plots.adaptation import COLOURS

ENV_ID = "SparsePointRobot-v0"
# The paper's sweep, and no relabelling
PROBABILITIES = (0.0, 0.1, 0.3, 0.5, 0.8, 1.0)
VARIANTS = {
    "htr-ser": "even (default)",
    "strategy-random": "random",
    "strategy-final": "final",
    "rl-batch-task": "RL batch from the task's replay",
}


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per setting
    :param n_timesteps: budget of env steps
    :return: the defaults with each K; the other hindsight task strategies; the RL batch from all of the task's replay
    """
    settings: dict[str, dict[str, Any]] = {
        # The first one is what the others are compared with
        **{_method(k): {"relabel_probability": k} for k in sorted(PROBABILITIES, key=lambda k: k != 0.8)},
        "strategy-random": {"hindsight_task_strategy": "random"},
        "strategy-final": {"hindsight_task_strategy": "final"},
        "rl-batch-task": {"rl_batch_source": "task"},
    }
    return [
        Cell(ENV_ID, method, seed, n_timesteps, {"replay_buffer_kwargs": kwargs}, explorers=("search",))
        for seed in range(1, n_seeds + 1)
        for method, kwargs in settings.items()
    ]


def _method(k: float) -> str:
    return "htr-ser" if k == 0.8 else f"k-{k:g}"


def plot(results: dict[Cell, Path], path: Path) -> None:
    """
    Left: K against the return on test tasks. Right: learning curves of the variants on validation tasks.

    :param results: raw results of the cells
    :param path: picture to write
    """
    raw: dict[str, list[Any]] = {}
    for cell, result in results.items():
        raw.setdefault(cell.method, []).append(np.load(result))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    scores = [np.array([run["returns_search"][:, -1].mean() for run in raw[_method(k)]]) for k in PROBABILITIES]
    points = np.array([iqm_interval(score) for score in scores])
    left.plot(PROBABILITIES, points[:, 0], "o-", color=COLOURS[0], label="IQM and 95 % interval")
    left.fill_between(PROBABILITIES, points[:, 1], points[:, 2], color=COLOURS[0], alpha=0.2, linewidth=0)
    for k, score in zip(PROBABILITIES, scores, strict=True):
        left.plot([k] * len(score), score, "o", color=COLOURS[6], markersize=3, label="one seed" if k == 0 else None)
    left.set_xlabel("K, probability of relabelling")
    left.set_ylabel("return of the 20th adaptation episode")
    left.set_title("test tasks, final models", fontsize=10)
    for colour, (method, label) in zip(COLOURS, VARIANTS.items(), strict=False):
        curve = np.stack([run["curve"].mean(axis=1) for run in raw[method]])
        band(right, raw[method][0]["timesteps"] / 1000, curve, colour, "-", label)
    right.set_xlabel("thousand env steps of meta-training")
    right.set_ylabel("return of the last adaptation episode")
    right.set_title("validation tasks, hindsight task strategies and ablation", fontsize=10)
    finish(figure, path, f"{ENV_ID}: IQM over {len(raw['htr-ser'])} seeds, 95 % interval")


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("relabelling", __doc__, cells, 40_000, argv, plot)


if __name__ == "__main__":
    main()
