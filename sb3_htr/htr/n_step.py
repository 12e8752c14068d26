"""n-step returns: the rewards of several steps in a row, and only then a value."""

import numpy as np

from sb3_htr.htr.episode_store import EpisodeIndex


def steps_ahead(index: EpisodeIndex, virtual: np.ndarray, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :param index: of a store
    :param virtual: (n,) int, virtual rows of some steps
    :param n_steps: how many to look at, these steps among them
    :return: (n, n_steps) int, virtual rows of each step and of those that follow it, with the last one of an episode again
        where it ends before; and (n,) int, how many they are until then
    """
    if n_steps == 1:
        return virtual[:, None], np.ones(len(virtual), dtype=np.int64)
    end = index.episode_row[np.searchsorted(index.episode_row, virtual, side="right")]
    n = np.minimum(end - virtual, n_steps)
    return virtual[:, None] + np.minimum(np.arange(n_steps), n[:, None] - 1), n


def n_step_returns(rewards: np.ndarray, n: np.ndarray, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """
    :param rewards: (n_rows, n_steps) float32, of steps in a row
    :param n: (n_rows,) int, how many of them count
    :param gamma: discount of a step
    :return: (n_rows,) float32, their discounted sums; and (n_rows,) float32, the discount of what follows
    """
    step = np.arange(rewards.shape[1])
    discounts = np.where(step < n[:, None], gamma**step, 0.0).astype(np.float32)
    return (rewards * discounts).sum(axis=1), (gamma**n).astype(np.float32)
