"""Runs of the command line, of a moment each, and folders as they leave them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from helpers import ENV_ID
from sb3_htr import PEARL
from sb3_htr.zoo.run.record import RECORD
from sb3_htr.zoo.run.shipped import shipped

# For `-params`, in rollouts of 240 steps
SMALL = [
    "n_tasks_per_rollout:4",
    "n_episodes_per_task:3",
    "learning_starts:240",
    "gradient_steps:2",
    "n_envs:4",
    "policy_kwargs:{'net_arch':[16],'encoder_arch':[16]}",
]
# Of a cell of an experiment, likewise
OF_CELL: dict[str, Any] = {
    "n_envs": 4,
    "n_tasks_per_rollout": 4,
    "n_episodes_per_task": 3,
    "learning_starts": 240,
    "gradient_steps": 2,
    "meta_batch_size": 4,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [8], "encoder_arch": [8]},
}
METHOD = "htr-ser"
SHIPPED = shipped("trained_agents") / METHOD / f"{ENV_ID}.zip"
# Finds no agent there, so that the shipped one is taken
NOWHERE = ["--env", ENV_ID, "-f", "/nowhere"]


def train_arguments(folder: Path, n: int = 240, *arguments: str, env_id: str = ENV_ID, eval_freq: int = -1) -> list[str]:
    """A command line to which settings can be added."""
    how_long = ["-n", str(n), "--eval-freq", str(eval_freq), "--eval-episodes", "2", "--verbose", "0"]
    return ["train", "--env", env_id, "-f", str(folder), *how_long, *arguments, "-params", *SMALL]


def run_folder(folder: Path, method: str = METHOD, number: int = 1, env_id: str = ENV_ID) -> Path:
    """Where a training puts its run."""
    return folder / method / f"{env_id}_{number}"


def make_run(folder: Path, model: PEARL, number: int = 1, method: str = METHOD, **record: Any) -> Path:
    """A run folder as a training leaves it, of two evaluations."""
    run = run_folder(folder, method, number)
    run.mkdir(parents=True)
    defaults = ["--algo", "pearl", "-conf", "x.yml", "--num-threads", "1", "--save-freq", "20000"]
    settings: dict[str, Any] = {
        "env_id": ENV_ID,
        "method": method,
        "env_kwargs": {},
        "gym_packages": [],
        "seed": number,
        "n_timesteps": 960,
        "hardware": ["cpu"],
        "hyperparams": {"explorer": {"name": model.explorer.name}},
        "arguments": [*defaults, "-f", "runs", "--env", ENV_ID],
    }
    (run / RECORD).write_text(json.dumps({**settings, **record}))
    model.save(run / "best_model.zip")
    model.save(run / f"{ENV_ID}.zip")
    returns = np.random.default_rng(number).uniform(size=(2, 20, 4))
    np.savez(
        run / "evaluations.npz", timesteps=[480, 960], results=returns[:, :, -1], returns=returns, successes=returns > 0.5
    )
    return run
