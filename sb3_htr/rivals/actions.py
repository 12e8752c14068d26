"""Actions as networks give them, and as the env takes them."""

import numpy as np
from gymnasium import spaces


def scaled(actions: np.ndarray, space: spaces.Box) -> np.ndarray:
    """
    :param actions: (..., action_dim), in the bounds of the action space
    :param space: of actions
    :return: the same, float32, scaled to [-1, 1]
    """
    return np.asarray(2.0 * (actions - space.low) / (space.high - space.low) - 1.0, dtype=np.float32)


def unscaled(actions: np.ndarray, space: spaces.Box) -> np.ndarray:
    """
    :param actions: (..., action_dim), scaled to [-1, 1]
    :param space: of actions
    :return: the same, float32, in the bounds of the action space
    """
    return np.asarray(space.low + 0.5 * (actions + 1.0) * (space.high - space.low), dtype=np.float32)
