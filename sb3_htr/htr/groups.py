"""Groups of rows one after another, as the transitions of a list of episodes."""

import numpy as np


def first_rows(lengths: np.ndarray) -> np.ndarray:
    """
    :param lengths: (n,) int, rows of each group
    :return: (n,) int, the first row of each
    """
    return np.cumsum(lengths) - lengths


def positions(lengths: np.ndarray) -> np.ndarray:
    """
    :param lengths: (n,) int, rows of each group
    :return: (sum of the lengths,) int, of each row the place in its group: 0, 1, ... for each of them
    """
    return np.arange(lengths.sum()) - np.repeat(first_rows(lengths), lengths)
