"""Sparse Target Speed: find and hold an unknown speed, in whatever direction."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from htr_envs.arguments import are_numbers
from htr_envs.dynamics import Dynamics, DynamicsEnv, DynamicsVectorEnv, refuse_pictures
from htr_envs.task_env import BoolArray, FloatArray, TaskFamily, Trajectory, at_step, check_reward_type, l2_distance
from htr_envs.task_sets import draw_task_sets

FRICTION = np.float32(0.95)
THRUST = np.float32(0.2)
CONTROL_COST = np.float32(0.01)
# What full thrust along one axis would reach in the end
TOP_SPEED = 4.0


class TargetSpeedFamily(TaskFamily):
    """Speeds to hold, worth 1 for each step within the tolerance and 0 outside.

    A task is one number, and all velocities of that speed solve it: it is no place to be, neither on the plane nor among the
    velocities.

    :param min_speed: smallest target speed, above 0.
    :param max_speed: largest target speed, at most 4.
    :param tolerance: a speed is held where the difference to it is smaller than this.
    :param n_train_tasks: how many training tasks.
    :param n_test_tasks: how many test tasks.
    :param n_validation_tasks: how many validation tasks.
    :param task_seed: seed of the task sets.
    :raises ValueError: if a number is out of range.
    """

    def __init__(
        self,
        min_speed: float = 1.5,
        max_speed: float = 3.0,
        tolerance: float = 0.1,
        n_train_tasks: int = 80,
        n_test_tasks: int = 100,
        n_validation_tasks: int = 20,
        task_seed: int = 1337,
    ) -> None:
        if not are_numbers(min_speed, max_speed) or not 0.0 < min_speed < max_speed <= TOP_SPEED:
            raise ValueError(
                f"min_speed, max_speed are {min_speed!r}, {max_speed!r}, expected 0 < min_speed < max_speed <= {TOP_SPEED}."
            )
        if not are_numbers(tolerance) or not tolerance > 0.0:
            raise ValueError(f"tolerance is {tolerance!r}, expected a number above 0.")
        self.min_speed = float(min_speed)
        self.max_speed = float(max_speed)
        self.tolerance = float(tolerance)
        drawn = draw_task_sets(n_train_tasks, n_validation_tasks, n_test_tasks, task_seed)
        train, validation, test = (min_speed + (max_speed - min_speed) * values[:, None] for values in drawn)
        super().__init__(
            # the corner of the box of velocities, rounded up
            task_space=spaces.Box(0.0, np.float32(1.5 * TOP_SPEED), (1,), np.float32),
            train_tasks=train,
            validation_tasks=validation,
            test_tasks=test,
        )

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw speeds uniformly."""
        return rng.uniform(self.min_speed, self.max_speed, (n, 1)).astype(np.float32)

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        """Speed reward plus task-free reward of every step.

        :param reward_type: ``"sparse"``: 1 where the speed is held. ``"dense"``: minus the difference to the speed.
        """
        check_reward_type(reward_type)
        task_reward = -self._error(traj, task) if reward_type == "dense" else self.is_success(traj, task)
        return np.asarray(task_reward + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        """Whether the next state of every step has the speed."""
        return np.asarray(self._error(traj, task) < np.float32(self.tolerance))

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The speed after one step."""
        return self._speed(at_step(traj.next_observations, index))[..., None]

    @staticmethod
    def _speed(velocity: FloatArray) -> FloatArray:
        return l2_distance(velocity, np.zeros(2, dtype=np.float32))

    def _error(self, traj: Trajectory, task: ArrayLike) -> FloatArray:
        error: FloatArray = np.abs(self._speed(traj.next_observations) - np.asarray(task, dtype=np.float32)[..., None, 0])
        return error


class TargetSpeedDynamics(Dynamics[TargetSpeedFamily]):
    """The sledges of :class:`TargetSpeedEnv`; their states are their velocities.

    :param num_envs: how many sledges.
    """

    def __init__(self, num_envs: int) -> None:
        velocities, thrusts = spaces.Box(-TOP_SPEED, TOP_SPEED, (2,), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32)
        super().__init__(num_envs, velocities, thrusts)
        self.states = np.zeros((num_envs, 2), dtype=np.float32)

    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        self.states[indices] = 0.0
        return self.states[indices]

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        thrust = np.clip(actions, -1.0, 1.0)
        # full thrust from the bound leads back to it but for rounding, and the observation's bounds must hold
        self.states = np.clip(FRICTION * self.states + THRUST * thrust, -TOP_SPEED, TOP_SPEED)
        cost = CONTROL_COST * (thrust[:, 0] ** 2 + thrust[:, 1] ** 2)
        return self.states, -cost, np.zeros(self.num_envs, dtype=np.bool_)

    def render(
        self, task_family: TargetSpeedFamily, task: FloatArray, path: FloatArray, render_mode: str
    ) -> NDArray[np.uint8]:
        """Draw the plane of velocities, the ring that solves the task, filled strongly while the speed is held, and the path.

        :return: picture (400, 400, 3), uint8.
        """
        from htr_envs.rendering import BLUE, ORANGE, PALE_ORANGE, Canvas  # who never renders needs no Pillow

        (speed,), tolerance = task.tolist(), task_family.tolerance
        canvas = Canvas(4.2)
        held = bool(abs(np.hypot(*path[-1]) - speed) < tolerance)
        canvas.circle((0.0, 0.0), speed, 2 * tolerance / canvas.pixel, ORANGE if held else PALE_ORANGE)
        canvas.axes()
        canvas.path(path)
        canvas.legend([("target speed, hidden from the agent", ORANGE), ("start", None), ("sledge", BLUE)])
        return canvas.image()


class TargetSpeedEnv(DynamicsEnv):
    """
    ## Description

    A sledge on a plane with friction must go at a speed that it is not told; the direction does not matter. The reward is zero
    until the speed is right. Tasks of this kind are not about reaching a place: many states solve a task, and holding one
    takes constant effort. It is the sparse counterpart of the target velocity families of meta-reinforcement learning, small
    enough to train within minutes.

    ## Action Space

    The action is clipped to the box. The velocity becomes 0.95 times what it was plus 0.2 times the action.

    | Num | Action          | Min | Max | Unit                      |
    |-----|-----------------|-----|-----|---------------------------|
    | 0   | thrust along x  | -1  | 1   | 0.2 units of speed a step |
    | 1   | thrust along y  | -1  | 1   | 0.2 units of speed a step |

    ## Observation Space

    | Num | Observation      | Min | Max | Unit  |
    |-----|------------------|-----|-----|-------|
    | 0   | velocity along x | -4  | 4   | speed |
    | 1   | velocity along y | -4  | 4   | speed |

    Nothing in it tells the target speed.

    ## Rewards

    With `e` the absolute difference between the speed after the step and the target speed:

    - `reward_type="sparse"`: `1` if `e < tolerance`, else `0`.
    - `reward_type="dense"`: `-e`, the proxy reward of the oracle baseline.

    Both plus the task-free reward, a control cost of 0.01 times the squared length of the clipped action.
    `info["is_success"]` is `e < tolerance`.

    ## Task distribution

    A task is a speed between `min_speed` and `max_speed`. The 80 training tasks are four fifths of 100 speeds, evenly
    spaced from end to end and shuffled by `task_seed`; validation and test tasks are drawn uniformly and in balance.
    `task_space` goes from 0 beyond the largest possible speed, because a hindsight task is any speed that was reached. The
    family is our own, its numbers chosen such that undirected thrust does not get there: a uniformly random policy holds its
    target at some step of 0.01 % of its episodes (of 25,000, by `examples/floor_and_ceiling.py`).

    ## Starting State

    The sledge rests.

    ## Episode End

    ### Termination

    Never, not even at the target speed.

    ### Truncation

    After 40 steps.

    ## Arguments

    | Parameter            | Default    | Description                                                       |
    |----------------------|------------|-------------------------------------------------------------------|
    | `min_speed`          | `1.5`      | smallest target speed                                             |
    | `max_speed`          | `3.0`      | largest target speed                                              |
    | `tolerance`          | `0.1`      | difference to the target speed below which it is held             |
    | `n_train_tasks`      | `80`       | number of training tasks                                          |
    | `n_test_tasks`       | `100`      | number of test tasks                                              |
    | `n_validation_tasks` | `20`       | number of validation tasks                                        |
    | `task_seed`          | `1337`     | seed of the task sets, apart from the run's seed                  |
    | `reward_type`        | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`                         |
    | `render_mode`        | `None`     | `"rgb_array"` for pictures of velocities, `"human"` for a window  |

    `reset(options={"task_id": i})` or `reset(options={"task": [speed]})` gives the env a task, which stays until it
    is changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(TargetSpeedFamily(**family_kwargs), TargetSpeedDynamics(1), reward_type, render_mode)


class TargetSpeedVectorEnv(DynamicsVectorEnv):
    """Many sledges that step together; see :class:`TargetSpeedEnv` for what they do.

    :param num_envs: how many sledges.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param family_kwargs: arguments of :class:`TargetSpeedFamily`.
    """

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = 40, reward_type: str = "sparse", **family_kwargs: Any
    ) -> None:
        refuse_pictures(family_kwargs)
        super().__init__(TargetSpeedFamily(**family_kwargs), TargetSpeedDynamics(num_envs), max_episode_steps, reward_type)
