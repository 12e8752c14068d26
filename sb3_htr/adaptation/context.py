"""What of the experience on a task the encoder sees."""

from collections.abc import Callable

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
