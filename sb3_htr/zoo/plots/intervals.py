"""Interquartile means over runs, with intervals that resample all that was drawn: runs, evaluation seeds and tasks."""

import numpy as np
from rliable import metrics
from scipy import stats

# Bootstrap samples
REPS = 2000
# Of the intervals
PERCENTILES = (2.5, 97.5)

Interval = tuple[float, float, float]


def iqm_interval(scores: np.ndarray) -> Interval:
    """
    A run's score is its mean over evaluation seeds and tasks. Each bootstrap sample draws runs, for each of them evaluation
    seeds, and tasks, which are the same for all runs, as they were when they were measured.

    :param scores: (n_runs,) one score per run, or (n_runs, n_eval_seeds, n_tasks)
    :return: interquartile mean over runs, and its 95 % hierarchical bootstrap interval; NaN for the ends of a single run's,
        which says nothing of others
    """
    scores, rng = _as_grid(scores), np.random.default_rng(0)
    return _interval(_iqm(scores), _resample(scores, _draw_tasks(scores, rng), rng))


def iqm_difference(scores: np.ndarray, reference: np.ndarray) -> Interval:
    """
    :param scores: as of :func:`iqm_interval`
    :param reference: the same of another method, with runs of its own, on the same tasks
    :return: difference of the interquartile means over runs, and its 95 % hierarchical bootstrap interval; NaN for its ends
        where either has a single run
    """
    scores, reference, rng = _as_grid(scores), _as_grid(reference), np.random.default_rng(0)
    tasks = _draw_tasks(scores, rng)
    difference = _resample(scores, tasks, rng) - _resample(reference, tasks, rng)
    return _interval(_iqm(scores) - _iqm(reference), difference)


def _as_grid(scores: np.ndarray) -> np.ndarray:
    return np.asarray(scores, dtype=np.float64).reshape(len(scores), *(np.shape(scores)[1:] or (1, 1)))


def _iqm(scores: np.ndarray) -> float:
    return float(metrics.aggregate_iqm(scores.mean(axis=(1, 2))))


def _draw_tasks(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(REPS, n_tasks), the weight of each task in the mean of a bootstrap sample."""
    n_tasks = scores.shape[2]
    return rng.multinomial(n_tasks, np.full(n_tasks, 1 / n_tasks), size=REPS) / n_tasks


def _resample(scores: np.ndarray, tasks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(REPS,), interquartile means of bootstrap samples; NaN of a single run."""
    n_runs, n_seeds, _ = scores.shape
    if n_runs == 1:
        return np.full(REPS, np.nan)
    over_tasks = scores @ tasks.T
    run = rng.integers(n_runs, size=(REPS, n_runs, 1))
    seed = rng.integers(n_seeds, size=(REPS, n_runs, n_seeds))
    runs = over_tasks[run, seed, np.arange(REPS)[:, None, None]].mean(axis=2)
    # rliable's interquartile mean, of all samples at once
    return np.asarray(stats.trim_mean(runs, 0.25, axis=1))


def _interval(estimate: float, samples: np.ndarray) -> Interval:
    low, high = np.percentile(samples, PERCENTILES)
    return estimate, float(low), float(high)
