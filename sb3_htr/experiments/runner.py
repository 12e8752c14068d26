"""Runs the cells of an experiment, several at a time, and picks up where a killed one stopped."""

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import htr_envs  # noqa: F401 registers the envs
from sb3_htr.adaptation.evaluation import evaluate_adaptation
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.resume import checkpoints
from sb3_htr.zoo.run.agents import RECORD, agent_at, find_run, read_record

# Means over the training of what HTR paper, B.2 reasons with
LOGGED = ("relabelled_fraction", "rl_reward_mean", "rl_zero_reward_fraction")


@dataclass(frozen=True, eq=False)
class Cell:
    """
    One training run.

    :param env_id: registered env
    :param method: name in hyperparams/methods.yml
    :param variant: name in tables and folders
    :param seed: seed of the run
    :param n_timesteps: budget of env steps
    :param eval_freq: env steps between evaluations on the validation tasks
    :param settings: hyperparameters, joined with those of env and method
    :param env_kwargs: arguments of the env
    :param explorers: how the final model explores on the test tasks; one row of results for each
    """

    env_id: str
    method: str
    variant: str
    seed: int
    n_timesteps: int
    eval_freq: int
    settings: dict[str, Any]
    env_kwargs: dict[str, Any]
    explorers: tuple[str, ...]

    @property
    def name(self) -> str:
        """Folder of the run."""
        kwargs = "".join(f"-{key}{value}" for key, value in self.env_kwargs.items())
        return f"{self.variant}{kwargs}-seed{self.seed}".replace(" ", "")

    def command(self, folder: Path) -> list[str]:
        """
        :param folder: log folder
        :return: command line of the training
        """
        settings = [f"{key}:{value!r}" for key, value in self.settings.items()]
        kwargs = [f"{key}:{value!r}" for key, value in self.env_kwargs.items()]
        return [
            *(sys.executable, "-m", "sb3_htr.zoo.cli", "train", "--env", self.env_id, "--method", self.method),
            *("-f", str(folder), "--verbose", "0", "-n", str(self.n_timesteps)),
            *("--seed", str(self.seed), "--eval-freq", str(self.eval_freq)),
            *(["-params", *settings] if settings else []),
            *(["--env-kwargs", *kwargs] if kwargs else []),
        ]


def run_cell(cell: Cell, folder: Path) -> Path:
    """
    Train, then adapt the final model to the test tasks.

    :param cell: what to run
    :param folder: where all cells' folders are; a cell that has a result there is not run again
    :return: npz with ``timesteps``, ``curve`` (n, n_tasks) on validation tasks, and for each explorer
        ``returns_<explorer>`` and ``successes_<explorer>`` (n_tasks, n_episodes) on test tasks; the means of what is in
        ``LOGGED``; ``wall_s`` of the training and ``commit`` of the code
    """
    result = folder / f"{cell.name}.npz"
    if result.exists():
        return result
    start = time.monotonic()
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    (folder / cell.name).mkdir(parents=True, exist_ok=True)
    command = _resume(folder / cell.name) or cell.command(folder / cell.name)
    with open(folder / cell.name / "log.txt", "a") as log:
        subprocess.run(command, check=True, stdout=log, stderr=log, env=environment)
    wall = time.monotonic() - start
    run = find_run(folder / cell.name)
    agent = agent_at(run, "last")
    model, env = agent.load(), agent.make_vec_env(20)
    evaluations = np.load(run / "evaluations.npz")
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    arrays: dict[str, Any] = {
        **{key: np.nanmean(progress[f"train/{key}"]) for key in LOGGED},
        "timesteps": evaluations["timesteps"],
        "curve": evaluations["results"],
        "wall_s": wall,
        "commit": _commit_of(run),
    }
    for explorer in cell.explorers:
        returns, successes = evaluate_adaptation(model, env, explorer=explorer)
        arrays |= {f"returns_{explorer}": returns.astype(np.float32), f"successes_{explorer}": successes}
    with atomic_path(result) as path:
        np.savez_compressed(path, **arrays)
    print(f"{cell.name}: {json.dumps({e: round(float(arrays[f'returns_{e}'][:, -1].mean()), 2) for e in cell.explorers})}")
    return result


def _resume(folder: Path) -> list[str] | None:
    """Command that goes on with a run that was killed, None if there is none."""
    unfinished = [run for run in folder.glob("*/*") if checkpoints(run)]
    return [sys.executable, "-m", "sb3_htr.zoo.cli", "train", "--resume", str(unfinished[-1])] if unfinished else None


def _commit_of(run: Path) -> str:
    """Of the code that trained, as it was when the training began."""
    record = read_record(run / RECORD)
    return f"{record.get('commit', 'unknown')}{'' if record.get('clean', True) else ' with changes'}"


def run_cells(cells: list[Cell], folder: Path, jobs: int) -> dict[Cell, Path]:
    """
    :param cells: runs of the experiment
    :param folder: where runs and results go
    :param jobs: number of runs at a time, each on one thread
    :return: the result file of each cell
    """
    with ThreadPoolExecutor(jobs) as pool:
        paths = list(pool.map(lambda cell: run_cell(cell, folder), cells))
    return dict(zip(cells, paths, strict=True))
