"""Runs the cells of an experiment, several at a time, and picks up where a killed one stopped."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.resume import checkpoints
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.protocol import evaluate, last_episode_return
from sb3_htr.zoo.run.agents import RECORD, agent_at, file_stem, find_runs, read_record

# Means over the training of what HTR paper, B.2 reasons with
LOGGED = ("relabelled_fraction", "rl_reward_mean", "rl_zero_reward_fraction")


def run_cell(cell: Cell, runs: Path) -> Path:
    """
    Train, unless there is a finished run, then evaluate the final model.

    :param cell: what to run
    :param runs: folder of all experiments' runs; a cell that has a result there is not run again
    :return: npz with ``timesteps``, ``curve`` (n, n_tasks) on validation tasks; what
        :func:`sb3_htr.experiments.protocol.evaluate` tells of the final model; the means of what is in ``LOGGED``;
        ``wall_s`` of the training and ``commit`` of the code that trained
    :raises ValueError: if the run in the cell's folder is another one
    """
    result, folder = cell.result(runs), cell.run_folder(runs)
    if result.exists():
        return result
    folder.mkdir(parents=True, exist_ok=True)
    trained = find_finished(cell, folder)
    if trained is None:
        with open(folder / "log.txt", "a") as log:
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            subprocess.run(_resume(folder) or cell.training(folder), check=True, stdout=log, stderr=log, env=environment)
        trained = find_finished(cell, folder)
        if trained is None:
            raise RuntimeError(f"The training in {folder} ended before its {cell.n_timesteps:,} env steps: see its log.txt.")
    run, model = trained
    evaluations = np.load(run / "evaluations.npz")
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    arrays: dict[str, Any] = {
        **{key: np.nanmean(progress[f"train/{key}"]) for key in LOGGED},
        "timesteps": evaluations["timesteps"],
        "curve": evaluations["results"],
        "wall_s": _wall_time(progress["time/time_elapsed"]),
        "commit": _commit_of(run),
        **evaluate(cell, model),
    }
    with atomic_path(result) as path:
        np.savez_compressed(path, **arrays)
    names = [evaluation.name for evaluation in cell.evaluations]
    scores = {name: round(float(last_episode_return(arrays, name).mean()), 2) for name in names}
    print(f"{cell.experiment}/{cell.name}: {json.dumps(scores)}")
    return result


def find_finished(cell: Cell, folder: Path) -> tuple[Path, PEARL] | None:
    """
    :param cell: what was to be trained
    :param folder: log folder
    :return: the run folder and its final model, None if there is no run, or none that is finished
    :raises ValueError: if a run in the folder is another one
    """
    for run in find_runs(folder) if any(folder.rglob(RECORD)) else ():
        record = read_record(run / RECORD)
        for key in ("env_id", "env_kwargs", "method", "seed", "n_timesteps"):
            if record[key] != getattr(cell, key):
                raise ValueError(
                    f"{run} has {key} {record[key]!r}, but {cell.experiment}/{cell.name} needs {getattr(cell, key)!r}: "
                    f"move this run away, or choose other --runs."
                )
        # An interrupted training leaves a model, too
        if (run / f"{file_stem(cell.env_id)}.zip").exists():
            model = agent_at(run, "last").load()
            if model.num_timesteps >= cell.n_timesteps:
                return run, model
    return None


def _resume(folder: Path) -> list[str] | None:
    """Command that goes on with a run that was killed, None if there is none."""
    unfinished = [run for run in folder.glob("*/*") if checkpoints(run)]
    return [sys.executable, "-m", "sb3_htr.zoo.cli", "train", "--resume", str(unfinished[-1])] if unfinished else None


def _wall_time(elapsed: np.ndarray) -> float:
    """Seconds, from those since the training began or went on (n,)."""
    elapsed = elapsed[~np.isnan(elapsed)]
    return float(elapsed[np.append(np.diff(elapsed) < 0, True)].sum())


def _commit_of(run: Path) -> str:
    """Of the code that trained, as it was when the training began."""
    record = read_record(run / RECORD)
    return f"{record.get('commit', 'unknown')}{'' if record.get('clean', True) else ' with changes'}"


def run_cells(cells: list[Cell], runs: Path, jobs: int) -> dict[Cell, Path]:
    """
    :param cells: runs of the experiment
    :param runs: folder of all experiments' runs
    :param jobs: number of runs at a time, each on one thread
    :return: the result file of each cell
    """
    with ThreadPoolExecutor(jobs) as pool:
        paths = list(pool.map(lambda cell: run_cell(cell, runs), cells))
    return dict(zip(cells, paths, strict=True))
