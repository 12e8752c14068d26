"""Training, validation and test tasks along one number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from htr_envs.arguments import are_whole

# How near drawn tasks may be to others, as shares of the range, and how often they are drawn until none is nearer
NEAREST, MAX_DRAWS = 1e-6, 100


def check_task_sets(n_train_tasks: int, n_validation_tasks: int, n_test_tasks: int, task_seed: int) -> None:
    """Refuse numbers of which no task sets can be drawn.

    :param n_train_tasks: how many training tasks.
    :param n_validation_tasks: how many validation tasks.
    :param n_test_tasks: how many test tasks.
    :param task_seed: seed of all three.
    :raises ValueError: if one is no whole number, or out of range.
    """
    sizes = n_train_tasks, n_validation_tasks, n_test_tasks
    if not are_whole(*sizes) or min(sizes) < 1:
        told = ", ".join(map(repr, sizes))
        raise ValueError(
            f"n_train_tasks, n_validation_tasks, n_test_tasks are {told}: each must be a whole number of at least 1."
        )
    if not are_whole(task_seed) or not 0 <= task_seed < 2**32:
        raise ValueError(f"task_seed is {task_seed!r}, expected a whole number from 0 to {2**32 - 1}.")


def draw_task_sets(
    n_train_tasks: int,
    n_validation_tasks: int,
    n_test_tasks: int,
    task_seed: int,
    held_out: tuple[float, float] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Training, validation and test tasks along one number from 0 to 1, of which tasks are distributed uniformly.

    Training tasks are 80 % of an even grid, 0 and 1 in it, as in PEARL's reference implementation. Validation and test tasks
    are drawn, one uniformly from each of as many equal parts, so that they are balanced: never on a grid, and so never the
    training tasks of another seed. Each of the three has a source of randomness of its own.

    :param n_train_tasks: how many training tasks.
    :param n_validation_tasks: how many validation tasks.
    :param n_test_tasks: how many test tasks.
    :param task_seed: seed of all three, apart from the seed of a run.
    :param held_out: an interval that training tasks avoid and the others lie in, None for no such split.
    :return: numbers of training, validation and test tasks, one axis each.
    :raises ValueError: if a number of tasks is smaller than 1, the seed is none, or the interval is none in [0, 1].
    """
    check_task_sets(n_train_tasks, n_validation_tasks, n_test_tasks, task_seed)
    low, high = (0.0, 1.0) if held_out is None else held_out
    if not 0.0 <= low < high <= 1.0 or held_out == (0.0, 1.0):
        raise ValueError(f"The interval held out of training is {low:g} to {high:g} of the range, expected a part of it.")
    # numpy never changes RandomState's stream, as it may Generator's: the tasks stay the same for good
    grid = np.linspace(0.0, 1.0, n_train_tasks + max(n_train_tasks // 4, 1))
    np.random.RandomState(task_seed).shuffle(grid)
    train = grid[:n_train_tasks]
    if held_out is not None:
        train = train * (1.0 - (high - low))
        # nothing lies beyond an interval that goes to the end
        train = train if high == 1.0 else np.where(train < low, train, train + (high - low))

    def draw(n: int, purpose: int, others: NDArray[np.float64]) -> NDArray[np.float64]:
        random_state = np.random.RandomState([task_seed, purpose])
        part, values, others = np.arange(n), np.zeros(n), np.sort(others)
        for _ in range(MAX_DRAWS):
            values[part] = low + (high - low) * (part + random_state.uniform(size=len(part))) / n
            # In float32, two of them may be one task
            above = np.searchsorted(others, values)
            neighbours = others[np.stack([np.maximum(above - 1, 0), np.minimum(above, len(others) - 1)])]
            part = np.flatnonzero(np.abs(values - neighbours).min(axis=0) < NEAREST)
            if len(part) == 0:
                break
        random_state.shuffle(values)
        return values

    validation = draw(n_validation_tasks, 1, train)
    return train, validation, draw(n_test_tasks, 2, np.append(train, validation))
