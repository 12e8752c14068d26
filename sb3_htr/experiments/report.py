"""Turns the raw results of an experiment into ``results/<name>/``."""

import json
import platform
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from rliable import library, metrics

from sb3_htr.common.checkpoint import atomic_path
from sb3_htr.experiments.runner import LOGGED, Cell

RESULTS = Path(__file__).parents[2] / "results"
# Okabe and Ito's colours
COLOURS = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999"]

# Draws the results of all cells into a file
Plot = Callable[[dict[Cell, Path], Path], None]


def iqm_interval(scores: np.ndarray, reps: int = 2000) -> tuple[float, float, float]:
    """
    :param scores: (n_seeds,) one score per run
    :param reps: bootstrap samples
    :return: interquartile mean over runs, and its 95 % stratified bootstrap interval
    """
    np.random.seed(0)  # rliable hands its random_state on to a library that has come to ignore it
    estimates, intervals = library.get_interval_estimates(
        {"": scores[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=reps
    )
    return float(estimates[""][0]), float(intervals[""][0, 0]), float(intervals[""][1, 0])


def episodes_to_first_success(successes: np.ndarray) -> np.ndarray:
    """
    :param successes: (n_tasks, n_episodes)
    :return: (n_tasks,), the first episode that solved the task; one more than there are if none did
    """
    return np.where(successes.any(axis=1), successes.argmax(axis=1) + 1, successes.shape[1] + 1)


METRICS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
    "last_episode_return": lambda returns, successes: float(returns[:, -1].mean()),
    "success_rate": lambda returns, successes: float(successes[:, -1].mean()),
    "episodes_to_first_success": lambda returns, successes: float(episodes_to_first_success(successes).mean()),
}


def summarize(name: str, results: dict[Cell, Path]) -> dict[str, Any]:
    """
    :param name: of the experiment
    :param results: raw results of its cells
    :return: content of ``summary.json``
    """
    groups: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in results:
        groups.setdefault((cell.env_id, cell.method, str(cell.env_kwargs)), []).append(cell)
    rows = []
    for (env_id, method, _), cells in groups.items():
        raw = [np.load(results[cell]) for cell in cells]
        for explorer in cells[0].explorers:
            for metric, function in METRICS.items():
                scores = np.array([function(r[f"returns_{explorer}"], r[f"successes_{explorer}"]) for r in raw])
                iqm, low, high = iqm_interval(scores)
                rows.append(
                    {
                        "env": env_id,
                        "method": method,
                        "explorer": explorer,
                        "hyperparams": cells[0].hyperparams,
                        "env_kwargs": cells[0].env_kwargs,
                        "metric": metric,
                        "env_steps": cells[0].n_timesteps,
                        "n_seeds": len(cells),
                        "iqm": round(iqm, 3),
                        "low": round(low, 3),
                        "high": round(high, 3),
                        **{key: round(float(np.mean([r[key] for r in raw])), 4) for key in LOGGED},
                        "wall_s": round(float(np.mean([r["wall_s"] for r in raw])), 1),
                    }
                )
    commits = sorted({str(np.load(path)["commit"]) for path in results.values()})
    return {
        "name": name,
        "command": " ".join(["python", "-m", f"sb3_htr.experiments.{name}", *sys.argv[1:]]),
        "commit": ", ".join(commits),
        "date": date.today().isoformat(),
        "machine": f"{_processor()}, one thread per run, Python {platform.python_version()}",
        "rows": rows,
    }


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def write(name: str, results: dict[Cell, Path], plot: Plot) -> Path:
    """
    Write ``summary.json``, ``raw.npz`` and the picture of an experiment.

    :param name: of the experiment
    :param results: raw results of its cells
    :param plot: draws the picture
    :return: folder with the three
    """
    folder = RESULTS / name
    folder.mkdir(parents=True, exist_ok=True)
    raw = {f"{cell.name}/{key}": value for cell, path in results.items() for key, value in np.load(path).items()}
    with atomic_path(folder / "raw.npz") as path:
        np.savez_compressed(path, **raw)
    with atomic_path(folder / "summary.json") as path:
        path.write_text(json.dumps(summarize(name, results), indent=1) + "\n")
    plot(results, folder / f"{name}.png")
    return folder


def plot_learning(results: dict[Cell, Path], path: Path) -> None:
    """
    Left: learning curves on validation tasks. Right: the final models' adaptation to the test tasks.

    :param results: raw results of the cells
    :param path: picture to write
    """
    groups: dict[str, list[Any]] = {}
    for cell, result in results.items():
        groups.setdefault(cell.method, []).append((cell, np.load(result)))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    for colour, (method, runs) in zip(COLOURS, groups.items(), strict=False):
        curve = np.stack([raw["curve"].mean(axis=1) for _, raw in runs])
        band(left, runs[0][1]["timesteps"] / 1000, curve, colour, "-", method)
        for explorer, style in zip(runs[0][0].explorers, ("-", "--"), strict=False):
            returns = np.stack([raw[f"returns_{explorer}"].mean(axis=0) for _, raw in runs])
            band(right, np.arange(1, returns.shape[1] + 1), returns, colour, style, f"{method}, explorer {explorer}")
    left.set_xlabel("thousand env steps of meta-training")
    left.set_ylabel("return of the last adaptation episode")
    left.set_title("validation tasks, during meta-training", fontsize=10)
    right.set_xlabel("adaptation episode")
    right.set_ylabel("return")
    right.xaxis.get_major_locator().set_params(integer=True)
    right.set_title("test tasks, final models", fontsize=10)
    n_seeds = len(next(iter(groups.values())))
    finish(figure, path, f"{next(iter(results)).env_id}: IQM over {n_seeds} seeds, 95 % interval")


def finish(figure: Figure, path: Path, title: str) -> None:
    """
    :param figure: to make alike all others, and to save
    :param path: picture to write
    :param title: of the figure
    """
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    figure.suptitle(title, fontsize=11)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def band(axes: plt.Axes, x: np.ndarray, scores: np.ndarray, colour: str, style: str, label: str) -> None:
    """
    Draw the IQM over runs at each x, with its interval.

    :param axes: where
    :param x: (n,)
    :param scores: (n_runs, n)
    :param colour: of line and band
    :param style: of the line, matplotlib's
    :param label: for the legend
    """
    points = np.array([iqm_interval(column, reps=500) for column in scores.T])
    axes.plot(x, points[:, 0], style, color=colour, label=label)
    axes.fill_between(x, points[:, 1], points[:, 2], color=colour, alpha=0.2, linewidth=0)
