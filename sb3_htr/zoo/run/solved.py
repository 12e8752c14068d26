"""How long a run took to learn what it learned."""

import csv
from pathlib import Path

import numpy as np

# Of the way from the lowest evaluation to the last
SOLVED = 0.95


def time_to_solved(run: Path) -> tuple[int, float] | None:
    """
    :param run: folder of a training with evaluations
    :return: env steps until the return of the last adaptation episode on the validation tasks first came 95 % of the way from
        the lowest evaluation to the last; and seconds, the evaluations among them, NaN where nothing tells them. None where
        there are no evaluations
    """
    if not (run / "evaluations.npz").exists():
        return None
    with np.load(run / "evaluations.npz") as evaluations:
        steps, returns = evaluations["timesteps"], evaluations["returns"][:, :, -1].mean(axis=1)
    is_solved = returns >= returns.min() + SOLVED * (returns[-1] - returns.min())
    first = int(steps[is_solved.argmax()])
    return first, _seconds_at(run / "progress.csv", first)


def _seconds_at(log: Path, step: int) -> float:
    """When an env step was reached: between the rollouts that were logged around it."""
    if not log.exists():
        return float("nan")
    with log.open(newline="") as file:
        rows = [(row.get("time/total_timesteps"), row.get("time/time_elapsed")) for row in csv.DictReader(file)]
    logged = np.array([(float(steps), float(seconds)) for steps, seconds in rows if steps and seconds])
    return float(np.interp(step, logged[:, 0], logged[:, 1])) if len(logged) else float("nan")
