"""Training, validation and test tasks along one number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def split_evenly(
    low: float, high: float, n_train_tasks: int, n_validation_tasks: int, n_test_tasks: int, task_seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Spread training and test tasks evenly over a range and shuffle them; draw the validation tasks uniformly.

    :param low: smallest value.
    :param high: largest value.
    :param n_train_tasks: how many training tasks.
    :param n_validation_tasks: how many validation tasks.
    :param n_test_tasks: how many test tasks.
    :param task_seed: seed of all three, apart from the seed of a run.
    :return: values of training, validation and test tasks, one axis each.
    :raises ValueError: if a number of tasks is smaller than 1.
    """
    if min(n_train_tasks, n_test_tasks, n_validation_tasks) < 1:
        raise ValueError(
            f"n_train_tasks, n_test_tasks, n_validation_tasks are {n_train_tasks}, {n_test_tasks}, {n_validation_tasks}: "
            "each must be at least 1."
        )
    # numpy never changes RandomState's stream, as it may Generator's: the tasks stay the same for good
    random_state = np.random.RandomState(task_seed)
    values = np.linspace(low, high, n_train_tasks + n_test_tasks)
    random_state.shuffle(values)
    return values[:n_train_tasks], random_state.uniform(low, high, n_validation_tasks), values[n_train_tasks:]
