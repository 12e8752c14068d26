"""How soon adaptations succeed."""

import numpy as np


def first_success(successes: np.ndarray) -> np.ndarray:
    """
    :param successes: (..., n_episodes) bool, whether each adaptation episode solved its task
    :return: (...) int, number of the first that did, from 1 on; one more than there are where none did
    """
    return np.where(successes.any(axis=-1), successes.argmax(axis=-1) + 1, successes.shape[-1] + 1)
