"""How a transition is stored: as one row of float32 columns."""

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_htr.common.type_aliases import Context, Trajectory


class Transitions:
    """
    Columns of the stored rows, and what the reward hook sees of them.

    :param observation_space: Box
    :param action_space: Box
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        assert isinstance(action_space, spaces.Box)
        o, a = (int(np.prod(space.shape or ())) for space in (observation_space, action_space))
        self.observation, self.action, self.reward = slice(0, o), slice(o, o + a), o + a
        self.next_observation = slice(o + a + 1, 2 * o + a + 1)
        self.task_free_reward, self.done = 2 * o + a + 1, 2 * o + a + 2
        self.width = 2 * o + a + 3
        self._low, self._high = (bound.ravel().astype(np.float32) for bound in (action_space.low, action_space.high))
        self._is_scaled = bool((self._low == -1).all() and (self._high == 1).all())

    def trajectory(self, rows: np.ndarray) -> Trajectory:
        """
        :param rows: (..., T, width) stored transitions
        :return: what the reward hook needs of them
        """
        actions = rows[..., self.action]
        return Trajectory(
            observations=rows[..., self.observation],
            actions=actions if self._is_scaled else self._low + 0.5 * (actions + 1.0) * (self._high - self._low),
            next_observations=rows[..., self.next_observation],
            task_free_reward=rows[..., self.task_free_reward],
        )

    def context(self, rows: np.ndarray, lengths: np.ndarray, device: th.device | str) -> Context:
        """
        :param rows: (n, width) stored transitions, those of the first task first
        :param lengths: (n_tasks,) int64, how many are of each task
        :param device: where the context is put
        :return: what a posterior is inferred from
        """
        columns = self.observation, self.action, self.reward, self.next_observation
        arrays = (*(rows[:, column] for column in columns), lengths)
        return Context(*(th.as_tensor(array, device=device) for array in arrays))
