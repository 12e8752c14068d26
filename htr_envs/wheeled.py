"""Sparse Wheeled: drive a robot with two wheels to an unseen goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from htr_envs.locomotion_family import ARENA, LocomotionFamily
from htr_envs.mujoco_dynamics import DoubleArray, MujocoDynamics
from htr_envs.mujoco_env import RENDER_MODES, MujocoTaskEnv, MujocoTaskVectorEnv
from htr_envs.task_env import BoolArray, FloatArray

MODEL = Path(__file__).parent / "assets" / "wheeled.xml"
WHEEL_RADIUS = 0.1
TOP_SPEED = 10.0  # of the robot and of its wheels' rims, m/s; out of reach, as is the next one
TOP_TURN_RATE = 100.0  # rad/s


class WheeledDynamics(MujocoDynamics):
    """The robot of :class:`WheeledEnv`.

    :param ctrl_cost_weight: weight of the control cost.
    :param reset_noise_scale: noise of the starting state.
    """

    frame_skip = 2
    n_exact_positions = 3  # x, y, and z, with which the robot stands on the floor

    def __init__(self, ctrl_cost_weight: float, reset_noise_scale: float) -> None:
        bounds = [ARENA, ARENA, 1.0, 1.0, TOP_SPEED, TOP_SPEED, TOP_TURN_RATE, TOP_SPEED, TOP_SPEED]
        super().__init__(mujoco.MjSpec.from_file(str(MODEL)), reset_noise_scale, np.array(bounds, dtype=np.float32))
        self.ctrl_cost_weight = np.float32(ctrl_cost_weight)

    def _start_position(self) -> DoubleArray:
        return np.array([0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0])

    def _observe(self, states: DoubleArray) -> DoubleArray:
        x, y, _, heading, _, _ = self.positions(states).T
        velocity_x, velocity_y, _, turn_rate, left_wheel, right_wheel = self.velocities(states).T
        # copied, because numpy may compute them otherwise for numbers that do not lie side by side in memory
        heading = heading.copy()
        cos, sin = np.cos(heading), np.sin(heading)
        forwards = cos * velocity_x + sin * velocity_y
        sideways = cos * velocity_y - sin * velocity_x
        rims = WHEEL_RADIUS * left_wheel, WHEEL_RADIUS * right_wheel
        return np.stack((x, y, cos, sin, forwards, sideways, turn_rate, *rims), axis=-1)

    def _is_healthy(self, states: DoubleArray) -> BoolArray:
        return np.ones(len(states), dtype=np.bool_)

    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        return -self.ctrl_cost_weight * np.square(actions).sum(axis=-1)


class WheeledEnv(MujocoTaskEnv):
    """ """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 100}  # type: ignore[misc]

    def __init__(
        self,
        reward_type: str = "sparse",
        render_mode: str | None = None,
        ctrl_cost_weight: float = 0.005,
        reset_noise_scale: float = 0.01,
        **family_kwargs: Any,
    ) -> None:
        dynamics = WheeledDynamics(ctrl_cost_weight, reset_noise_scale)
        super().__init__(LocomotionFamily(**family_kwargs), dynamics, reward_type, render_mode)


class WheeledVectorEnv(MujocoTaskVectorEnv):
    """Many two-wheeled robots that step together, in native threads; see :class:`WheeledEnv` for what they do.

    :param num_envs: how many robots.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param n_threads: how many threads step the robots, None for ``OMP_NUM_THREADS`` if that is set, else one for each CPU that
        this process may use. The results do not depend on it.
    :param ctrl_cost_weight: weight of the control cost.
    :param reset_noise_scale: noise of the starting state.
    :param family_kwargs: arguments of :class:`htr_envs.LocomotionFamily`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = 200,
        reward_type: str = "sparse",
        n_threads: int | None = None,
        ctrl_cost_weight: float = 0.005,
        reset_noise_scale: float = 0.01,
        **family_kwargs: Any,
    ) -> None:
        dynamics = WheeledDynamics(ctrl_cost_weight, reset_noise_scale)
        family = LocomotionFamily(**family_kwargs)
        super().__init__(family, dynamics, num_envs, max_episode_steps, reward_type, n_threads)
