"""The part of a reward that depends on the task."""

import numpy as np

# It is that much above 0, or it is 0: the difference of two float32
ROUNDING = 1e-5


def task_reward(reward: np.ndarray, task_free_reward: np.ndarray) -> np.ndarray:
    """
    :param reward: of steps, of any shape
    :param task_free_reward: what these would return if they solved nothing; its shape broadcasts with the other
    :return: what they return beside, 0 where that is nothing
    """
    beside = reward - task_free_reward
    return np.where(beside > ROUNDING, beside, 0.0)
