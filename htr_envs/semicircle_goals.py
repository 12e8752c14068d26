"""Tasks that are goal positions on a semicircle around the start."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from htr_envs.arguments import are_numbers
from htr_envs.position_goals import PositionGoalFamily
from htr_envs.task_env import FloatArray
from htr_envs.task_sets import draw_task_sets

LOCOMOTION_ARENA = 20.0  # a robot gets up to 10 in 200 steps


def _part(held_out: tuple[float, float]) -> tuple[float, float]:
    try:
        low, high = held_out
        fits = 0.0 <= low < high <= 180.0 and (low, high) != (0.0, 180.0)
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise ValueError(f"held_out is {held_out!r}, expected degrees (from, to), 0 <= from < to <= 180, but not all of them.")
    return low / 180.0, high / 180.0


class SemicircleGoalFamily(PositionGoalFamily):
    """Goals (x, y) at one distance from the start, at angles from 0 to pi.

    The angles of the training tasks are evenly spaced, those of validation and test tasks drawn uniformly and in balance, see
    :func:`draw_task_sets`. Everything follows ``task_seed``, never the seed of a run.

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
        if not are_numbers(goal_distance) or not 0.0 < goal_distance <= arena:
            raise ValueError(f"goal_distance is {goal_distance!r}, expected a number above 0 and up to {arena}.")
        self.goal_distance = float(goal_distance)
        sector = None if held_out is None else _part(held_out)
        drawn = draw_task_sets(n_train_tasks, n_validation_tasks, n_test_tasks, task_seed, sector)
        train, validation, test = (self._goals(np.pi * values) for values in drawn)
        super().__init__(arena, goal_radius, train, validation, test)

    def _goals(self, angles: NDArray[np.float64]) -> FloatArray:
        goals: FloatArray = (self.goal_distance * np.stack((np.cos(angles), np.sin(angles)), axis=-1)).astype(np.float32)
        return goals

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw goals at uniform angles."""
        return self._goals(rng.uniform(0.0, np.pi, n))


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


class AntGoalFamily(LocomotionFamily):
    """The same for a robot whose episodes end when it falls.

    The dense proxy is how much nearer the goal is than from the start. Minus the distance, as elsewhere, would pay for falling
    early; MAESN (Gupta et al., 2018) adds a constant too, 4 at goals 2 away.

    :param goal_distance: distance of the goals from the start, at most 20.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param task_sets: sizes and seed of the task sets, see :class:`SemicircleGoalFamily`.
    :raises ValueError: if a number is out of range.
    """

    def __init__(self, goal_distance: float = 2.0, goal_radius: float = 0.4, **task_sets: Any) -> None:
        super().__init__(goal_distance, goal_radius, **task_sets)
        self.dense_level = self.goal_distance
