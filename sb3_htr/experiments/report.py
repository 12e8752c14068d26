"""Turns the raw results of an experiment into ``results/<name>/``."""

import json
import platform
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.grid import Experiment
from sb3_htr.experiments.runner import LOGGED, Cell, run_cells
from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval


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


def summarize(name: str, command: str, results: dict[Cell, Path]) -> dict[str, Any]:
    """
    :param name: of the experiment
    :param command: that repeats it
    :param results: raw results of its cells
    :return: content of ``summary.json``
    """
    groups: dict[str, dict[str, list[Cell]]] = {}
    for cell in results:
        groups.setdefault(str(cell.env_kwargs), {}).setdefault(cell.variant, []).append(cell)
    rows, differences = [], []
    for variants in groups.values():
        reference: np.ndarray | None = None
        for variant, cells in variants.items():
            first, raw = cells[0], [np.load(results[cell]) for cell in cells]
            about: dict[str, Any] = {
                "env": first.env_id,
                "env_kwargs": first.env_kwargs,
                "method": first.method,
                "variant": variant,
            }
            about |= {"settings": first.settings, "env_steps": first.n_timesteps, "n_seeds": len(cells)}
            means = {key: round(float(np.mean([r[key] for r in raw])), 4) for key in (*LOGGED, "wall_s")}
            for explorer in first.explorers:
                for metric, function in METRICS.items():
                    scores = np.array([function(r, explorer) for r in raw])
                    interval = _rounded(iqm_interval(scores))
                    rows.append({**about, "explorer": explorer, "metric": metric, **interval, **means})
            scores = np.array([METRICS["last_episode_return"](r, first.explorers[0]) for r in raw])
            if reference is None:
                reference, compared = scores, variant
            else:
                difference = {"of": compared, "metric": "last_episode_return", "explorer": first.explorers[0]}
                differences.append({**about, **difference, **_rounded(iqm_difference(reference, scores))})
    commits = sorted({str(np.load(path)["commit"]) for path in results.values()})
    return {
        "name": name,
        "command": command,
        "commit": ", ".join(commits),
        "date": date.today().isoformat(),
        "machine": f"{_processor()}, one thread per run, Python {platform.python_version()}",
        "rows": rows,
        # first variant minus this one
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


def write(name: str, command: str, experiment: Experiment, results: dict[Cell, Path], folder: Path) -> None:
    """
    Write ``summary.json``, ``raw.npz`` and the picture of an experiment.

    :param name: of the experiment
    :param command: that repeats it
    :param experiment: draws the picture
    :param results: raw results of its cells
    :param folder: where they go
    """
    folder.mkdir(parents=True, exist_ok=True)
    raw = {f"{cell.name}/{key}": value for cell, path in results.items() for key, value in np.load(path).items()}
    with atomic_path(folder / "raw.npz") as path:
        np.savez_compressed(path, **raw)
    with atomic_path(folder / "summary.json") as path:
        path.write_text(json.dumps(summarize(name, command, results), indent=1) + "\n")
    experiment.figure(results, folder / f"{name}.png")


def run(name: str, command: str, experiment: Experiment, cells: list[Cell], runs: Path, output: Path, jobs: int) -> None:
    """
    :param name: of the experiment
    :param command: that repeats it
    :param experiment: what is run
    :param cells: its runs
    :param runs: folder for them
    :param output: folder for the results
    :param jobs: runs at a time
    """
    write(name, command, experiment, run_cells(cells, runs, jobs), output)
