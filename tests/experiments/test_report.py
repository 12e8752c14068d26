"""From raw results to tables and pictures. The runs are made up; what is said of them must be true."""

import json
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_htr.experiments import (
    goal_distance,
    locomotion,
    point_robot,
    precision,
    relabelling,
    report,
    tables,
    target_speed,
)
from sb3_htr.experiments.report import Plot, episodes_to_first_success, loss_of_stability
from sb3_htr.experiments.runner import LOGGED, Cell, run_cell
from sb3_htr.common.resume import checkpoints
from sb3_htr.zoo import intervals
from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval

EXPERIMENTS: dict[str, tuple[Callable[[int, int], list[Cell]], Plot]] = {
    "point_robot": (point_robot.cells, report.plot_learning),
    "relabelling": (relabelling.cells, relabelling.plot),
    "goal_distance": (goal_distance.cells, goal_distance.plot),
    "target_speed": (target_speed.cells, report.plot_learning),
    "precision": (precision.cells, report.plot_learning),
    "wheeled": (partial(locomotion.cells, "SparseWheeled-v0"), report.plot_learning),
    "ant": (partial(locomotion.cells, "SparseAnt-v0"), report.plot_learning),
}


def made_up(cells: list[Cell], folder: Path) -> dict[Cell, Path]:
    """Every test task of a run returns the number of its seed in the last episode, and solves the task from the third on."""
    results = {}
    for cell in cells:
        arrays: dict[str, Any] = {
            "timesteps": np.arange(1, 5) * 1000,
            "curve": np.ones((4, 20)) * [[1], [5], [4], [4.5]],
            "wall_s": 1.0,
        }
        arrays |= {"commit": "abc", **{key: 0.5 for key in LOGGED}}
        for explorer in cell.explorers:
            arrays[f"returns_{explorer}"] = np.full((20, 6), float(cell.seed), dtype=np.float32)
            arrays[f"successes_{explorer}"] = np.arange(6) >= np.full((20, 1), 2)
        results[cell] = folder / f"{cell.name}.npz"
        np.savez(results[cell], **arrays)
    assert len({cell.name for cell in cells}) == len(cells), "two runs of one name would overwrite each other"
    return results


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_reports_what_its_runs_did(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells, plot = EXPERIMENTS[name]
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(intervals, "REPS", 50)
    folder = report.write(name, made_up(cells(3, 20_000), tmp_path), plot)
    assert (folder / f"{name}.png").stat().st_size > 10_000
    assert len(np.load(folder / "raw.npz").files) > 10
    summary = json.loads((folder / "summary.json").read_text())
    value = {"last_episode_return": 2.0, "success_rate": 1.0, "episodes_to_first_success": 3.0, "loss_of_stability": 1.0}
    for row in summary["rows"]:
        assert row["iqm"] == value[row["metric"]] and row["n_seeds"] == 3
        assert row["low"] <= row["iqm"] <= row["high"]
    assert all(difference["low"] <= 0 <= difference["high"] for difference in summary["differences"])
    table = tables.table(summary)
    assert table.count("| 1.00 [1.00, 1.00] | 3.00 [3.00, 3.00] |") == len({cell.method for cell in cells(1, 1)}) * (
        len({str(cell.env_kwargs) for cell in cells(1, 1)})
    ) + sum(len(cell.explorers) - 1 for cell in cells(1, 1))
    line = f"{cells(1, 1)[0].env_id} | 20,000 | 3 | 2.0 [1."
    assert (line in tables.headline({name: summary})) == (name in tables.ENVS)


def test_a_killed_run_of_an_experiment_goes_on(tmp_path: Path) -> None:
    small: dict[str, Any] = {"n_envs": 4, "n_tasks_per_rollout": 4, "n_episodes_per_task": 3, "learning_starts": 240}
    small |= {
        "gradient_steps": 2,
        "meta_batch_size": 4,
        "batch_size": 4,
        "policy_kwargs": {"net_arch": [8], "encoder_arch": [8]},
    }
    cell = Cell("SparseWheeled-v0", "tiny", 1, 4 * 200 * 6, hyperparams=small, explorers=("search",))
    command = cell.command(tmp_path / cell.name, 2400)
    killed = subprocess.run([*command, "--save-freq", "1"], check=True, capture_output=True)
    assert killed.returncode == 0
    run = next((tmp_path / cell.name).glob("*/*"))
    (run / f"{cell.env_id}.zip").unlink()
    steps = checkpoints(run)[0].name
    result = run_cell(cell, tmp_path, 2400)
    assert f"Going on from {run / 'checkpoints' / steps}" in (tmp_path / cell.name / "log.txt").read_text()
    raw = np.load(result)
    assert raw["returns_search"].shape == (20, 20) and raw["timesteps"].tolist() == [2400, 4800]
    assert len(list((tmp_path / cell.name).glob("*/*"))) == 1


def test_statistics() -> None:
    assert iqm_interval(np.array([0.0, 10, 10, 10, 100]))[0] == pytest.approx(10)
    estimate, low, high = iqm_difference(np.array([11.0, 12, 13, 12, 12]), np.array([1.0, 2, 3, 2, 2]))
    assert estimate == pytest.approx(10) and 8 <= low <= 10 <= high <= 12
    assert loss_of_stability(np.array([[1.0], [9], [8], [5], [7]])) == 4
    successes = np.array([[False, True, True], [False, False, False]])
    assert episodes_to_first_success(successes).tolist() == [2, 4]


def test_optimal_return_is_that_of_the_env() -> None:
    assert goal_distance.optimal_return(1.0, 20) == pytest.approx(13.38, abs=0.05)
    assert goal_distance.optimal_return(2.0, 40) > goal_distance.optimal_return(2.0, 30)
