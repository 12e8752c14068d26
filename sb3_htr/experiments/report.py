"""Turns the raw results of an experiment into ``results/<name>/``."""

import json
import platform
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments import figures
from sb3_htr.experiments.calibration import expected_calibration_error
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.grid import Experiment
from sb3_htr.experiments.protocol import EVAL_SEEDS, METRICS, scores
from sb3_htr.experiments.runner import LOGGED
from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval


def summarize(command: str, results: dict[Cell, Path]) -> dict[str, Any]:
    """
    :param command: that repeats it
    :param results: raw results of the cells of an experiment
    :return: content of ``summary.json``
    """
    groups: dict[str, dict[str, list[Cell]]] = {}
    for cell in results:
        groups.setdefault(str(cell.env_kwargs), {}).setdefault(cell.variant, []).append(cell)
    rows, differences, explorer_differences = [], [], []
    for variants in groups.values():
        references: dict[str, np.ndarray] = {}
        compared = next(iter(variants))
        for variant, cells in variants.items():
            first, raws = cells[0], [np.load(results[cell]) for cell in cells]
            about: dict[str, Any] = {
                "env": first.env_id,
                "env_kwargs": first.env_kwargs,
                "method": first.method,
                "variant": variant,
            }
            about |= {"settings": first.settings, "env_steps": first.n_timesteps, "n_seeds": len(cells)}
            means = {key: round(float(np.mean([raw[key] for raw in raws])), 4) for key in (*LOGGED, "wall_s")}
            calibration_error = expected_calibration_error(np.sum([raw["calibration"] for raw in raws], axis=0))
            means["calibration_error"] = round(calibration_error, 4)
            first_explorers: dict[str, tuple[str, np.ndarray]] = {}
            for evaluation in first.evaluations:
                tested = {**about, **evaluation._asdict()}
                for metric in METRICS:
                    interval = _rounded(iqm_interval(scores(raws, metric, evaluation.name)))
                    rows.append({**tested, "metric": metric, **interval, **means})
                returns = scores(raws, "last_episode_return", evaluation.name)
                reference = references.setdefault(evaluation.name, returns)
                explorer, by_it = first_explorers.setdefault(str(evaluation.tested_on), (evaluation.explorer, returns))
                if explorer != evaluation.explorer:
                    difference = {**tested, "of": explorer, "metric": "last_episode_return"}
                    explorer_differences.append({**difference, **_rounded(iqm_interval(by_it - returns))})
                if variant != compared:
                    difference = {**tested, "of": compared, "metric": "last_episode_return"}
                    differences.append({**difference, **_rounded(iqm_difference(reference, returns))})
    commits = sorted({str(np.load(path)["commit"]) for path in results.values()})
    return {
        "name": next(iter(results)).experiment,
        "command": command,
        "commit": ", ".join(commits),
        "date": date.today().isoformat(),
        "machine": f"{_processor()}, one thread per run, Python {platform.python_version()}",
        "n_eval_seeds": len(EVAL_SEEDS),
        "rows": rows,
        # first variant minus this one, by the same explorer on the same tasks
        "differences": differences,
        # first explorer minus this one, of the same models
        "explorer_differences": explorer_differences,
    }


def _rounded(interval: tuple[float, float, float]) -> dict[str, float]:
    # adding 0 turns -0 into 0
    return {key: round(value, 3) + 0.0 for key, value in zip(("iqm", "low", "high"), interval, strict=True)}


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def write(command: str, experiment: Experiment, results: dict[Cell, Path], folder: Path) -> None:
    """
    Write ``summary.json``, ``raw.npz`` and the pictures of an experiment.

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
        path.write_text(json.dumps(summarize(command, results), indent=1) + "\n")
    experiment.figure(results, folder / f"{experiment.name}.png")
    figures.reliability(results, folder / "reliability.png")
