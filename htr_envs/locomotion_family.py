"""Goals for robots that have to walk or drive to them."""

from __future__ import annotations

from htr_envs.semicircle_goals import SemicircleGoalFamily

ARENA = 20.0  # a robot gets up to 10 in 200 steps


class LocomotionFamily(SemicircleGoalFamily):
    """Goals on a semicircle, worth 1 minus the distance within the goal radius and 0 outside.

    That is the point robot's reward at a larger scale: with the default radius a step within the goal is worth 0.5 to 1, far
    more than any cost of a step, so that a success stands out. Importing this needs no MuJoCo.

    :param goal_distance: distance of the goals from the start, at most 20.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param task_sets: sizes and seed of the task sets, see :class:`SemicircleGoalFamily`.
    :raises ValueError: if a number is out of range.
    """

    def __init__(self, goal_distance: float = 2.0, goal_radius: float = 0.5, **task_sets: int) -> None:
        super().__init__(ARENA, goal_distance, goal_radius, **task_sets)
