"""What of the experience on a task the encoder sees."""

from collections.abc import Callable

import numpy as np
import torch as th

from sb3_htr.common.type_aliases import Context


def context_dim(obs_dim: int, action_dim: int) -> int:
    """
    :param obs_dim: length of an observation
    :param action_dim: length of an action
    :return: length of a context row
    """
    return obs_dim + action_dim + 1


def context_rows(context: Context, normalize: Callable[[th.Tensor], th.Tensor]) -> th.Tensor:
    """
    :param context: transitions as they were collected
    :param normalize: puts observations on one scale
    :return: (n, context_dim) float32, rows (o, a, r)
    """
    return th.cat([normalize(context.observations), context.actions, context.rewards[:, None]], dim=1)


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
