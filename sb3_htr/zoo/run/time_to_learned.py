"""How long a run took to learn what it learned."""

import csv
from pathlib import Path

import numpy as np

from sb3_htr.common.arrays import load_arrays

# Of the way from the lowest evaluation to the last
LEARNED = 0.95


def time_to_learned(run: Path) -> tuple[float, float] | None:
    """
    :param run: folder of a training with evaluations
    :return: env steps until the return of the last adaptation episode on the validation tasks first came 95 % of the way from
        the lowest evaluation to the last; and seconds, the evaluations among them, NaN where nothing tells them. Both are
        infinite if the last is the lowest, as nothing was learnt then. None where there are fewer than two evaluations
    """
    if not (run / "evaluations.npz").exists():
        return None
    evaluations = load_arrays(run / "evaluations.npz", ("timesteps", "returns"))
    steps, returns = evaluations["timesteps"], evaluations["returns"][:, :, -1].mean(axis=1)
    if len(steps) < 2:
        return None
    if returns[-1] == returns.min():
        return np.inf, np.inf
    is_learned = returns >= returns.min() + LEARNED * (returns[-1] - returns.min())
    first = steps[is_learned.argmax()]
    return int(first), float(seconds_at(run / "progress.csv", np.array([first]))[0])


def seconds_at(log: Path, steps: np.ndarray) -> np.ndarray:
    """
    :param log: ``progress.csv`` of a training
    :param steps: (n,) env steps
    :return: (n,) seconds of training until then, as logged; of older runs, between the rollouts that were logged around it.
        What was trained after a checkpoint and lost does not count. NaN where nothing tells them
    """
    if not log.exists():
        return np.full(len(steps), np.nan)
    with log.open(newline="") as file:
        rows = [(row.get("time/total_timesteps"), row.get("time/time_elapsed")) for row in csv.DictReader(file)]
    logged = np.array([(float(step), float(second)) for step, second in rows if step and second])
    if len(logged) == 0:
        return np.full(len(steps), np.nan)
    return np.asarray(np.interp(steps, *logged.T))
