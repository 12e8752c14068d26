"""Tasks that are goal positions on a semicircle around the start."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from htr_envs.task_env import BoolArray, FloatArray, TaskFamily, Trajectory, at_step, check_reward_type, draw_task_sets

LOCOMOTION_ARENA = 20.0  # a robot gets up to 10 in 200 steps


class SemicircleGoalFamily(TaskFamily):
    """Goals (x, y) at one distance from the start, at angles from 0 to pi.

    A step is worth 1 minus the distance to the goal within the goal radius, and 0 outside, which is the formula that the HTR
    paper (appendix A.3) gives for the point robot.

    The angles of the training tasks are evenly spaced, those of validation and test tasks drawn uniformly and in balance, see
    :func:`draw_task_sets`. Everything follows ``task_seed``, never the seed of a run. The first two numbers of an observation
    are the position.

    :param arena: goals and hindsight goals lie in the square [-arena, arena]^2.
    :param goal_distance: distance of the goals from the start at (0, 0).
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param n_train_tasks: how many training tasks.
    :param n_test_tasks: how many test tasks.
    :param n_validation_tasks: how many validation tasks.
    :param task_seed: seed of the task sets.
    :param held_out: a sector, from and to an angle in degrees, that training tasks avoid and validation and test tasks lie in:
        a split that cannot be interpolated. None for no such split.
    :raises ValueError: if a number is out of range.
    """

    def __init__(
        self,
        arena: float,
        goal_distance: float,
        goal_radius: float,
        n_train_tasks: int = 80,
        n_test_tasks: int = 100,
        n_validation_tasks: int = 20,
        task_seed: int = 1337,
        held_out: tuple[float, float] | None = None,
    ) -> None:
        if not 0.0 < goal_distance <= arena:
            raise ValueError(f"goal_distance is {goal_distance}, expected a number above 0 and up to {arena}.")
        if not 0.0 < goal_radius <= 1.0:
            raise ValueError(
                f"goal_radius is {goal_radius}, expected above 0 and at most 1, so that a success is worth 1 - d > 0."
            )
        self.goal_distance = float(goal_distance)
        self.goal_radius = float(goal_radius)
        sector = None if held_out is None else (held_out[0] / 180.0, held_out[1] / 180.0)
        drawn = draw_task_sets(n_train_tasks, n_validation_tasks, n_test_tasks, task_seed, sector)
        train, validation, test = (self._goals(np.pi * values) for values in drawn)
        super().__init__(
            task_space=spaces.Box(-arena, arena, (2,), np.float32),
            train_tasks=train,
            validation_tasks=validation,
            test_tasks=test,
        )

    def _goals(self, angles: NDArray[np.float64]) -> FloatArray:
        goals: FloatArray = (self.goal_distance * np.stack((np.cos(angles), np.sin(angles)), axis=-1)).astype(np.float32)
        return goals

    def _distance(self, traj: Trajectory, task: ArrayLike) -> FloatArray:
        goal = np.asarray(task, dtype=np.float32)[..., None, :]
        # column by column, which is three times as fast; not np.linalg.norm: its sum may be ordered by memory layout, and
        # rewards must be the same bits for any batch shape
        x, y = (traj.next_observations[..., i] - goal[..., i] for i in (0, 1))
        distance: FloatArray = np.sqrt(x * x + y * y, dtype=np.float32)
        return distance

    def _goal_reward(self, distance: FloatArray) -> FloatArray:
        """Sparse reward at these distances to the goal, where each of them reaches it."""
        return np.float32(1.0) - distance

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw goals at uniform angles."""
        return self._goals(rng.uniform(0.0, np.pi, n))

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        """Goal reward plus task-free reward of every step.

        :param reward_type: ``"sparse"``: 0 for the goal where it is not reached. ``"dense"``: minus the distance to the goal.
        """
        check_reward_type(reward_type)
        distance = self._distance(traj, task)
        if reward_type == "dense":
            goal_reward = -distance
        else:
            goal_reward = np.where(distance < self.goal_radius, self._goal_reward(distance), np.float32(0.0))
        return np.asarray(goal_reward + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        """Whether the next state of every step is within the goal radius."""
        return np.asarray(self._distance(traj, task) < self.goal_radius)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The position after one step, which is the goal that this step reaches."""
        return at_step(traj.next_observations[..., :2], index)


class LocomotionFamily(SemicircleGoalFamily):
    """Goals on a semicircle, worth 1 minus the distance within the goal radius and 0 outside.

    That is the point robot's reward at a larger scale: with the default radius a step within the goal is worth 0.5 to 1, far
    more than any cost of a step, so that a success stands out. Importing this needs no MuJoCo.

    :param goal_distance: distance of the goals from the start, at most 20.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param task_sets: sizes and seed of the task sets, see :class:`SemicircleGoalFamily`.
    :raises ValueError: if a number is out of range.
    """

    def __init__(self, goal_distance: float = 2.0, goal_radius: float = 0.5, **task_sets: Any) -> None:
        super().__init__(LOCOMOTION_ARENA, goal_distance, goal_radius, **task_sets)
