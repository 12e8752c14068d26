"""MuJoCo dynamics of many copies of one robot, stepped by native threads.

A single env is a batch of one copy. Everything that is computed from a state is computed by the same array code for any number
of copies, and a state alone determines the next one, so single and batched envs agree bit for bit.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from htr_envs.task_env import BoolArray, FloatArray

try:
    import mujoco
    from mujoco.rollout import Rollout
except ImportError as error:
    raise DependencyNotInstalled('MuJoCo is missing or too old: run `pip install "sb3_htr[mujoco]"`.') from error

DoubleArray = NDArray[np.float64]

FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


class MujocoDynamics(ABC):
    """A MuJoCo model with what an env has to know of it; pure functions of arrays with one row for each copy.

    A state is a row (time, qpos, qvel). The solver starts cold in every step: what it remembers of the last step would be part
    of a state otherwise.

    :param spec: the model. The goal's disc and the start's are added to it, which are seen and never felt.
    :param reset_noise_scale: half the width of the uniform noise on the starting positions, and standard deviation of the
        normal noise on the starting velocities.
    :param observation_bounds: observations are clipped at plus and minus these numbers, shape (obs_dim,).
    :raises ValueError: if the noise is negative.
    """

    frame_skip: ClassVar[int]
    """Physics steps in a control step."""
    n_exact_positions: ClassVar[int]
    """So many leading positions start without noise."""
    envs_per_thread: ClassVar[int]
    """With fewer copies for each thread, waking the threads takes longer than they save (measured)."""

    def __init__(self, spec: mujoco.MjSpec, reset_noise_scale: float, observation_bounds: FloatArray) -> None:
        if not reset_noise_scale >= 0.0:
            raise ValueError(f"reset_noise_scale is {reset_noise_scale}, expected a number from 0 on.")
        # a state that is not finite is not replaced by the first one: the episode ends
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        _add_discs(spec)
        self.model = spec.compile()
        self.reset_noise_scale = reset_noise_scale
        self.observation_space = spaces.Box(-observation_bounds, observation_bounds, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.model.nu,), np.float32)

    @property
    def n_state(self) -> int:
        """Length of a state."""
        return int(mujoco.mj_stateSize(self.model, FULL_PHYSICS))

    @property
    def control_step(self) -> float:
        """Duration of a control step in seconds."""
        return float(self.frame_skip * self.model.opt.timestep)

    def positions(self, states: DoubleArray) -> DoubleArray:
        """Generalised positions (n, nq) in states (n, n_state), a view."""
        return states[:, 1 : 1 + self.model.nq]

    def velocities(self, states: DoubleArray) -> DoubleArray:
        """Generalised velocities (n, nv) in states (n, n_state), a view."""
        return states[:, 1 + self.model.nq : 1 + self.model.nq + self.model.nv]

    def start_states(self, n: int, rng: np.random.Generator) -> DoubleArray:
        """Draw start states.

        :param n: how many.
        :param rng: the only source of randomness.
        :return: states, shape (n, n_state).
        """
        states = np.zeros((n, self.n_state))
        position_noise = rng.uniform(-self.reset_noise_scale, self.reset_noise_scale, (n, self.model.nq))
        position_noise[:, : self.n_exact_positions] = 0.0
        self.positions(states)[:] = self._start_position() + position_noise
        self.velocities(states)[:] = self.reset_noise_scale * rng.standard_normal((n, self.model.nv))
        return states

    def observe(self, states: DoubleArray) -> FloatArray:
        """What the agent sees.

        :param states: shape (n, n_state).
        :return: observations in the observation space, also of a state that is not finite, shape (n, obs_dim).
        """
        observations = np.nan_to_num(self._observe(states).astype(np.float32))
        return np.clip(observations, self.observation_space.low, self.observation_space.high)

    def terminated(self, states: DoubleArray) -> BoolArray:
        """Where an episode ends.

        :param states: shape (n, n_state).
        :return: which states are unhealthy or not finite, shape (n,).
        """
        # a number that is not finite makes the sum so, too
        return ~(np.isfinite(states.sum(axis=-1)) & self._is_healthy(states))

    @abstractmethod
    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        """The part of the reward that depends on no task.

        :param actions: clipped to the action space, shape (n, act_dim).
        :param states: after the step, shape (n, n_state).
        :param sensors: at the last physics step, shape (n, nsensordata).
        :return: rewards, shape (n,).
        """

    @abstractmethod
    def _start_position(self) -> DoubleArray:
        """Start without noise, shape (nq,)."""

    @abstractmethod
    def _observe(self, states: DoubleArray) -> DoubleArray:
        """Observations before they are clipped, shape (n, obs_dim)."""

    @abstractmethod
    def _is_healthy(self, states: DoubleArray) -> BoolArray:
        """Which states may go on, shape (n,)."""


def _add_discs(spec: mujoco.MjSpec) -> None:
    # a mocap body can be put anywhere without a new model
    seen_only = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "contype": 0, "conaffinity": 0}
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    goal.add_geom(name="goal", size=[1.0, 0.002, 0.0], rgba=[0.90, 0.62, 0.0, 0.7], **seen_only)
    spec.worldbody.add_geom(name="start", size=[0.05, 0.002, 0.0], rgba=[0.0, 0.0, 0.0, 1.0], **seen_only)


class MujocoBatch:
    """States of some copies of a robot, which step together.

    The threads are started by the first step. They are neither copied nor pickled: a copy starts its own.

    :param dynamics: the robot.
    :param n: how many copies.
    :param n_threads: how many threads step them; the results do not depend on it.
    """

    def __init__(self, dynamics: MujocoDynamics, n: int, n_threads: int) -> None:
        self.dynamics = dynamics
        self.n_threads = min(n, n_threads)
        model = dynamics.model
        self.states: DoubleArray = np.zeros((n, dynamics.n_state))
        # arrays that MuJoCo reads and writes, made once
        self._controls = np.zeros((n, dynamics.frame_skip, model.nu))
        self._next_states = np.zeros((n, dynamics.frame_skip, dynamics.n_state))
        self._sensors = np.zeros((n, dynamics.frame_skip, model.nsensordata))
        self._rollout: Rollout | None = None
        self._data: list[mujoco.MjData] = []

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rollout": None, "_data": []}

    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        """Put some copies in start states.

        :param indices: which copies, shape (n,).
        :param rng: the only source of randomness.
        :return: their observations, shape (n, obs_dim).
        """
        self.states[indices] = self.dynamics.start_states(len(indices), rng)
        return self.dynamics.observe(self.states[indices])

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Move all copies by one control step.

        :param actions: not clipped, shape (n, act_dim).
        :return: observations (n, obs_dim), task-free rewards (n,), which copies terminate (n,).
        """
        if self._rollout is None:
            # with one thread the calling one does the work
            self._rollout = Rollout(nthread=self.n_threads if self.n_threads > 1 else 0)
            self._data = [mujoco.MjData(self.dynamics.model) for _ in range(self.n_threads)]
        actions = np.clip(actions, -1.0, 1.0)
        self._controls[:] = actions[:, None]
        self._rollout.rollout(
            [self.dynamics.model] * len(self.states),
            self._data,
            self.states,
            self._controls,
            nstep=self.dynamics.frame_skip,
            state=self._next_states,
            sensordata=self._sensors,
            skip_checks=True,
        )
        self.states[:] = self._next_states[:, -1]
        return (
            self.dynamics.observe(self.states),
            self.dynamics.task_free_reward(actions, self.states, self._sensors[:, -1]),
            self.dynamics.terminated(self.states),
        )

    def close(self) -> None:
        """End the threads."""
        if self._rollout is not None:
            self._rollout.close()
        self._rollout, self._data = None, []


def available_threads() -> int:
    """How many threads a process should use.

    :return: the environment variable ``OMP_NUM_THREADS`` if it is set, else the number of CPUs that this process may use.
    :raises ValueError: if the variable is no number.
    """
    # OpenMP allows a list, one number for each level of nesting
    wanted = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if wanted:
        if not wanted.isdecimal() or int(wanted) < 1:
            raise ValueError(f"OMP_NUM_THREADS is {wanted!r}, expected a number from 1 on: change it or pass n_threads.")
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
