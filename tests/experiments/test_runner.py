"""Cells of an experiment are runs of the command line."""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_htr.common.resume import checkpoints
from sb3_htr.experiments import grid
from sb3_htr.experiments.grid import Experiment, Variant
from sb3_htr.experiments.runner import run_cell
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.agents import agent_at

SMALL: dict[str, Any] = {
    "n_envs": 4,
    "n_tasks_per_rollout": 4,
    "n_episodes_per_task": 3,
    "learning_starts": 240,
    "gradient_steps": 2,
    "meta_batch_size": 4,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [8], "encoder_arch": [8]},
}


def test_a_killed_run_of_an_experiment_goes_on(tmp_path: Path) -> None:
    variant = Variant("htr-ser", "tiny", SMALL)
    experiment = Experiment("", "SparsePointRobot-v0", 1200, (variant,), 1, 480, ("belief",))
    (cell,) = experiment.cells()
    command = cell.command(tmp_path / cell.name)
    killed = subprocess.run([*command, "--save-freq", "1"], check=False, capture_output=True, text=True)
    assert killed.returncode == 0, killed.stderr
    run = next((tmp_path / cell.name).glob("*/*"))
    (run / f"{cell.env_id}.zip").unlink()
    steps = checkpoints(run)[0].name
    result = run_cell(cell, tmp_path)
    assert f"Going on from {run / 'checkpoints' / steps}" in (tmp_path / cell.name / "log.txt").read_text()
    raw = np.load(result)
    assert raw["returns_belief"].shape == (100, 20) and raw["timesteps"].tolist() == [480, 960]
    assert len(list((tmp_path / cell.name).glob("*/*"))) == 1
    changed = result.stat().st_mtime_ns
    assert run_cell(cell, tmp_path) == result and result.stat().st_mtime_ns == changed, "a result is not made again"


def test_the_command_repeats_an_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With `--quick`, one seed and a tenth of the env steps; each cell trains by its method, with its settings."""
    settings = {**SMALL, "replay_buffer_kwargs": {"relabeller": {"cell_size": 0.3}}}
    variants = (Variant("htr-ec", "coarse", settings, {"goal_distance": 0.5}), Variant("pearl-sparse-prior", "", SMALL))
    experiment = Experiment("Two tiny runs.", "SparsePointRobot-v0", 9600, variants, eval_freq=4800)
    monkeypatch.setitem(grid.EXPERIMENTS, "tiny", experiment)
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["experiment", "--help"])
    assert "SparsePointRobot-v0: Two tiny runs." in capsys.readouterr().out
    assert main(["experiment", "tiny", "--quick", "--jobs", "1"]) == 0
    results, runs = tmp_path / "results" / "quick-tiny", tmp_path / "runs" / "quick-tiny"
    assert {path.name for path in results.iterdir()} == {"tiny.png", "raw.npz", "summary.json"}
    summary = json.loads((results / "summary.json").read_text())
    assert summary["command"] == "sb3-htr experiment tiny --quick", "what repeats these results"
    coarse, plain = (agent_at(runs / cell.name) for cell in experiment.cells(1, 0.1))
    assert (coarse.method, plain.method) == ("htr-ec", "pearl-sparse-prior")
    assert coarse.record["env_kwargs"] == {"goal_distance": 0.5} and coarse.record["n_timesteps"] == 960
    relabeller: Any = coarse.load(trust=True).replay_buffer_kwargs["relabeller"]
    assert relabeller["name"] == "EpisodeClustering" and relabeller["cell_size"] == 0.3
    assert plain.load().explorer.name == "prior"
