"""Goals for robots that have to walk or drive to them."""

from __future__ import annotations

import numpy as np

from htr_envs.semicircle_goals import SemicircleGoalFamily
from htr_envs.task_env import FloatArray

ARENA = 20.0  # a robot gets up to 10 in 200 steps


class LocomotionFamily(SemicircleGoalFamily):
    """Goals on a semicircle, worth 1 minus the distance within the goal radius and 0 outside.

    That is the point robot's reward at a larger scale: with the default radius a step within the goal is worth 0.5 to 1, far
    more than any cost of a step, so that a success stands out. Importing this needs no MuJoCo.

    :param goal_distance: distance of the goals from the start, at most 20.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param n_train_tasks: how many training tasks.
    :param n_test_tasks: how many test tasks.
    :param n_validation_tasks: how many validation tasks.
    :param task_seed: seed of the task sets.
    :raises ValueError: if a number is out of range.
    """

    def __init__(
        self,
        goal_distance: float = 2.0,
        goal_radius: float = 0.5,
        n_train_tasks: int = 80,
        n_test_tasks: int = 20,
        n_validation_tasks: int = 20,
        task_seed: int = 1337,
    ) -> None:
        if goal_radius > 1.0:
            raise ValueError(f"goal_radius is {goal_radius}, expected at most 1, so that a success is worth 1 - d > 0.")
        super().__init__(ARENA, goal_distance, goal_radius, n_train_tasks, n_test_tasks, n_validation_tasks, task_seed)

    def _goal_reward(self, distance: FloatArray) -> FloatArray:
        return np.float32(1.0) - distance
