"""Interquartile means over runs, with their intervals."""

import numpy as np
from rliable import library, metrics

# Bootstrap samples
REPS = 2000


def iqm_interval(scores: np.ndarray) -> tuple[float, float, float]:
    """
    :param scores: (n_seeds,) one score per run
    :return: interquartile mean over runs, and its 95 % stratified bootstrap interval
    """
    np.random.seed(0)  # rliable hands its random_state on to a library that has come to ignore it
    estimates, intervals = library.get_interval_estimates(
        {"": scores[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=REPS
    )
    return float(estimates[""][0]), float(intervals[""][0, 0]), float(intervals[""][1, 0])


def iqm_difference(scores: np.ndarray, reference: np.ndarray) -> tuple[float, float, float]:
    """
    :param scores: (n_seeds,) one score per run
    :param reference: (n_seeds,) the same of another method
    :return: difference of the interquartile means over runs, and its 95 % stratified bootstrap interval
    """
    np.random.seed(0)
    estimates, intervals = library.get_interval_estimates(
        {"": (scores[:, None], reference[:, None])},
        lambda x, y: np.array([metrics.aggregate_iqm(x) - metrics.aggregate_iqm(y)]),
        reps=REPS,
    )
    return float(estimates[""][0]), float(intervals[""][0, 0]), float(intervals[""][1, 0])
