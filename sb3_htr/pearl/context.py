"""Contexts of whole episodes."""

import numpy as np


def evenly_spread(lengths: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """
    What of an episode becomes its context: steps at equal distances.

    :param lengths: (n,) int, number of steps of each episode
    :param size: number of steps to take of each, at most
    :return: the steps taken, those of the first episode first, and (n,) int, how many are of each
    """
    taken = np.minimum(lengths, size)
    position = np.arange(taken.sum()) - np.repeat(np.cumsum(taken) - taken, taken)
    return ((2 * position + 1) * np.repeat(lengths, taken)) // (2 * np.repeat(taken, taken)), taken
