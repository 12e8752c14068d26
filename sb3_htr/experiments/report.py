"""Turns the raw results of an experiment into ``results/<name>/``."""

import json
import platform
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.runner import LOGGED, Cell
from sb3_htr.zoo.plots.curves import band, finish
from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval
from sb3_htr.zoo.plots.adaptation import COLOURS

RESULTS = Path(__file__).parents[2] / "results"

# Draws the results of all cells into a file
Plot = Callable[[dict[Cell, Path], Path], None]


def loss_of_stability(curve: np.ndarray) -> float:
    """
    :param curve: (n_evaluations, n_tasks), returns on validation tasks during training
    :return: how far the worst of the last three evaluations is below the best of all
    """
    means = curve.mean(axis=1)
    return float(means.max() - means[-3:].min())


def episodes_to_first_success(successes: np.ndarray) -> np.ndarray:
    """
    :param successes: (n_tasks, n_episodes)
    :return: (n_tasks,), the first episode that solved the task; one more than there are if none did
    """
    return np.where(successes.any(axis=1), successes.argmax(axis=1) + 1, successes.shape[1] + 1)


METRICS: dict[str, Callable[[Any, str], float]] = {
    "last_episode_return": lambda raw, explorer: float(raw[f"returns_{explorer}"][:, -1].mean()),
    "success_rate": lambda raw, explorer: float(raw[f"successes_{explorer}"][:, -1].mean()),
    "episodes_to_first_success": lambda raw, explorer: float(episodes_to_first_success(raw[f"successes_{explorer}"]).mean()),
    "loss_of_stability": lambda raw, explorer: loss_of_stability(raw["curve"]),
}


def summarize(name: str, results: dict[Cell, Path]) -> dict[str, Any]:
    """
    :param name: of the experiment
    :param results: raw results of its cells
    :return: content of ``summary.json``
    """
    groups: dict[tuple[str, str], dict[str, list[Cell]]] = {}
    for cell in results:
        groups.setdefault((cell.env_id, str(cell.env_kwargs)), {}).setdefault(cell.method, []).append(cell)
    rows, differences = [], []
    for methods in groups.values():
        reference: np.ndarray | None = None
        for method, cells in methods.items():
            raw = [np.load(results[cell]) for cell in cells]
            about = {"env": cells[0].env_id, "env_kwargs": cells[0].env_kwargs, "method": method}
            for explorer in cells[0].explorers:
                for metric, function in METRICS.items():
                    scores = np.array([function(r, explorer) for r in raw])
                    settings = {"hyperparams": cells[0].hyperparams, "explorer": explorer, "metric": metric}
                    budget = {"env_steps": cells[0].n_timesteps, "n_seeds": len(cells)}
                    rows.append({**about, **settings, **budget, **_rounded(iqm_interval(scores))})
            means = {key: round(float(np.mean([r[key] for r in raw])), 4) for key in (*LOGGED, "wall_s")}
            for row in rows[-len(METRICS) * len(cells[0].explorers) :]:
                row.update(means)
            scores = np.array([METRICS["last_episode_return"](r, cells[0].explorers[0]) for r in raw])
            if reference is None:
                reference, first = scores, method
            else:
                difference = _rounded(iqm_difference(reference, scores))
                differences.append({**about, "of": first, "metric": "last_episode_return", **difference})
    commits = sorted({str(np.load(path)["commit"]) for path in results.values()})
    return {
        "name": name,
        "command": " ".join(["python", "-m", f"sb3_htr.experiments.{name}", *sys.argv[1:]]),
        "commit": ", ".join(commits),
        "date": date.today().isoformat(),
        "machine": f"{_processor()}, one thread per run, Python {platform.python_version()}",
        "rows": rows,
        # first method minus this one
        "differences": differences,
    }


def _rounded(interval: tuple[float, float, float]) -> dict[str, float]:
    # adding 0 turns -0 into 0
    return {key: round(value, 3) + 0.0 for key, value in zip(("iqm", "low", "high"), interval, strict=True)}


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
