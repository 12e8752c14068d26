"""Tasks that are goal positions on a plane."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from htr_envs.arguments import are_numbers
from htr_envs.task_env import BoolArray, FloatArray, TaskFamily, Trajectory, at_step, check_reward_type, l2_distance


class PositionGoalFamily(TaskFamily):
    """Goals (x, y), wherever they are drawn from. The first two numbers of an observation are the position.

    A step is worth 1 minus the distance to the goal within the goal radius, and 0 outside, which is the formula that the HTR
    paper (appendix A.3) gives for the point robot.

    :param arena: goals and hindsight goals lie in the square [-arena, arena]^2.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param train_tasks: goals to meta-train on, shape (n, 2).
    :param validation_tasks: goals to choose hyper-parameters and checkpoints on, shape (n, 2).
    :param test_tasks: goals to report results on, shape (n, 2).
    :raises ValueError: if the radius is out of range.
    """

    #: Dense reward at the goal. Where a fall ends an episode, it is as far as a goal may be from the start: else all dense
    #: rewards are costs, and to fall early saves them
    dense_level: float = 0.0

    def __init__(
        self,
        arena: float,
        goal_radius: float,
        train_tasks: FloatArray,
        validation_tasks: FloatArray,
        test_tasks: FloatArray,
    ) -> None:
        if not are_numbers(goal_radius) or not 0.0 < goal_radius <= 1.0:
            raise ValueError(
                f"goal_radius is {goal_radius!r}, expected above 0 and at most 1, so that a success is worth 1 - d > 0."
            )
        self.goal_radius = float(goal_radius)
        super().__init__(spaces.Box(-arena, arena, (2,), np.float32), train_tasks, validation_tasks, test_tasks)

    def _distance(self, traj: Trajectory, task: ArrayLike) -> FloatArray:
        return l2_distance(traj.next_observations[..., :2], np.asarray(task, dtype=np.float32)[..., None, :])

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        """Goal reward plus task-free reward of every step.

        :param reward_type: ``"sparse"``: 0 for the goal where it is not reached. ``"dense"``: :attr:`dense_level` minus the
            distance to the goal.
        """
        check_reward_type(reward_type)
        distance = self._distance(traj, task)
        if reward_type == "dense":
            goal_reward = np.float32(self.dense_level) - distance
        else:
            goal_reward = np.where(distance < self.goal_radius, np.float32(1.0) - distance, np.float32(0.0))
        return np.asarray(goal_reward + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        """Whether the next state of every step is within the goal radius."""
        return np.asarray(self._distance(traj, task) < self.goal_radius)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The position after one step, which is the goal that this step reaches."""
        return at_step(traj.next_observations[..., :2], index)
