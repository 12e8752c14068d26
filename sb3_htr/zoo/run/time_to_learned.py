"""How long a run took to learn what it learned."""

import csv
from pathlib import Path

import numpy as np

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
