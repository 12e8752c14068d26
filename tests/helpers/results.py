"""Raw results of experiments that nobody ran."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.protocol import EVAL_SEEDS
from sb3_htr.experiments.runner import LOGGED, hyperparams_of


def made_up(cells: list[Cell], folder: Path) -> dict[Cell, Path]:
    """Every test task of a run returns the number of its seed in the last episode, and solves the task from the third on."""
    results = {}
    for cell in cells:
        arrays: dict[str, Any] = {
            "timesteps": np.arange(1, 5) * 1000,
            "curve": np.ones((4, 20)) * [[1], [5], [4], [4.5]],
            "solved": np.arange(20) < np.array([[0], [15], [16], [20]]),
            "elapsed_s": np.arange(1.0, 5.0),
        }
        arrays["hyperparams"] = json.dumps(hyperparams_of(cell))
        arrays |= {"cell": cell.facts(), "commit": "abc", "evaluation_commit": "abc", **{key: 0.5 for key in LOGGED}}
        arrays["calibration"] = np.tile([[4.0, 1.0, 2.0]], (10, 1))
        for evaluation in cell.evaluations:
            returns = float(cell.seed + len(evaluation.tested_on))
            arrays[f"returns_{evaluation.name}"] = np.full((len(EVAL_SEEDS), 20, 6), returns, dtype=np.float32)
            arrays[f"successes_{evaluation.name}"] = np.broadcast_to(np.arange(6) >= 2, (len(EVAL_SEEDS), 20, 6))
        results[cell] = folder / f"{cell.name}.npz"
        np.savez(results[cell], **arrays)
    assert len({cell.name for cell in cells}) == len(cells), "two runs of one name would overwrite each other"
    return results
