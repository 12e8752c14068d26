"""Sparse Ant: walk on four weak legs to an unseen goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np

from htr_envs.locomotion_family import ARENA, LocomotionFamily
from htr_envs.mujoco_dynamics import DoubleArray, MujocoDynamics
from htr_envs.mujoco_env import RENDER_MODES, MujocoTaskEnv, MujocoTaskVectorEnv
from htr_envs.task_env import BoolArray, FloatArray

MODEL = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "ant.xml"
GEAR = 30.0
LOWER_LEGS = ("left_ankle_geom", "right_ankle_geom", "third_ankle_geom", "fourth_ankle_geom")
HEALTHY_Z_RANGE = (0.2, 1.0)


def _low_gear_ant() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(MODEL))
    for actuator in spec.actuators:
        actuator.gear[0] = GEAR
    for name in LOWER_LEGS:
        leg = spec.geom(name)
        # a little thicker than the leg, whose contacts lie on its surface
        leg.parent.add_site(name=name, type=leg.type, fromto=leg.fromto, size=1.2 * leg.size, group=4)
        spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)
    return spec


class AntDynamics(MujocoDynamics):
    """The robot of :class:`AntEnv`.

    :param ctrl_cost_weight: weight of the control cost.
    :param contact_cost_weight: weight of the contact cost.
    :param healthy_reward: reward of each step that ends healthy.
    :param reset_noise_scale: noise of the starting state.
    """

    frame_skip = 5
    n_exact_positions = 2  # x, y

    def __init__(
        self, ctrl_cost_weight: float, contact_cost_weight: float, healthy_reward: float, reset_noise_scale: float
    ) -> None:
        positions = [ARENA, ARENA, 10.0, 1.0, 1.0, 1.0, 1.0, *[np.pi] * 8]
        velocities = [100.0] * 14
        super().__init__(_low_gear_ant(), reset_noise_scale, np.array(positions + velocities, dtype=np.float32))
        self.ctrl_cost_weight = np.float32(ctrl_cost_weight)
        self.contact_cost_weight = np.float32(contact_cost_weight)
        self.healthy_reward = np.float32(healthy_reward)

    def _start_position(self) -> DoubleArray:
        return np.array(self.model.qpos0)

    def start_states(self, n: int, rng: np.random.Generator) -> DoubleArray:
        states = super().start_states(n, rng)
        quaternions = self.positions(states)[:, 3:7]
        quaternions /= np.sqrt(np.square(quaternions).sum(axis=-1, keepdims=True))
        return states

    def _observe(self, states: DoubleArray) -> DoubleArray:
        return states[:, 1:]

    def _is_healthy(self, states: DoubleArray) -> BoolArray:
        low, high = HEALTHY_Z_RANGE
        z = self.positions(states)[:, 2]
        return (z >= low) & (z <= high)

    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        contacts = np.clip(sensors, -1.0, 1.0).astype(np.float32)
        healthy = ~self.terminated(states)
        return (
            self.healthy_reward * healthy
            - self.ctrl_cost_weight * np.square(actions).sum(axis=-1)
            - self.contact_cost_weight * np.square(contacts).sum(axis=-1)
        )


class AntEnv(MujocoTaskEnv):
    """ """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # type: ignore[misc]

    def __init__(
        self,
        reward_type: str = "sparse",
        render_mode: str | None = None,
        ctrl_cost_weight: float = 0.005,
        contact_cost_weight: float = 5e-4,
        healthy_reward: float = 0.05,
        reset_noise_scale: float = 0.01,
        goal_radius: float = 0.4,
        **family_kwargs: Any,
    ) -> None:
        dynamics = AntDynamics(ctrl_cost_weight, contact_cost_weight, healthy_reward, reset_noise_scale)
        super().__init__(LocomotionFamily(goal_radius=goal_radius, **family_kwargs), dynamics, reward_type, render_mode)


class AntVectorEnv(MujocoTaskVectorEnv):
    """Many ants that step together, in native threads; see :class:`AntEnv` for what they do.

    :param num_envs: how many ants.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param n_threads: how many threads step the ants, None for ``OMP_NUM_THREADS`` if that is set, else one for each CPU that
        this process may use. The results do not depend on it.
    :param ctrl_cost_weight: weight of the control cost.
    :param contact_cost_weight: weight of the contact cost.
    :param healthy_reward: reward of each step that ends healthy.
    :param reset_noise_scale: noise of the starting state.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param family_kwargs: other arguments of :class:`htr_envs.LocomotionFamily`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = 200,
        reward_type: str = "sparse",
        n_threads: int | None = None,
        ctrl_cost_weight: float = 0.005,
        contact_cost_weight: float = 5e-4,
        healthy_reward: float = 0.05,
        reset_noise_scale: float = 0.01,
        goal_radius: float = 0.4,
        **family_kwargs: Any,
    ) -> None:
        dynamics = AntDynamics(ctrl_cost_weight, contact_cost_weight, healthy_reward, reset_noise_scale)
        family = LocomotionFamily(goal_radius=goal_radius, **family_kwargs)
        super().__init__(family, dynamics, num_envs, max_episode_steps, reward_type, n_threads)
