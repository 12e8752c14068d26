"""Dynamics in MuJoCo: many copies of one robot, stepped by native threads.

A single env is a batch of one copy. Everything that is computed from a state is computed by the same array code for any number
of copies, and a state alone determines the next one, so single and batched envs agree bit for bit.
"""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar
from weakref import WeakSet

import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from htr_envs.arguments import are_numbers, are_whole
from htr_envs.dynamics import Dynamics, DynamicsVectorEnv, refuse_pictures
from htr_envs.headless import open_no_window
from htr_envs.position_goals import PositionGoalFamily
from htr_envs.task_env import BoolArray, FloatArray

try:
    import mujoco
    from mujoco.rollout import Rollout
except ImportError as error:
    raise DependencyNotInstalled('MuJoCo is missing or too old: run `pip install "sb3_htr[mujoco]"`.') from error
except (AttributeError, RuntimeError) as error:  # of PyOpenGL without the library, and of MuJoCo for an unknown name
    if "MUJOCO_GL" not in os.environ:
        raise
    raise DependencyNotInstalled(
        f"MuJoCo cannot draw by what MUJOCO_GL asks for, {os.environ['MUJOCO_GL']}: install that library, take another of "
        "egl, osmesa and glfw, or unset MUJOCO_GL, which is needed for pictures alone."
    ) from error

DoubleArray = NDArray[np.float64]

FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
FRAME_WIDTH, FRAME_HEIGHT = 640, 400
# From behind the start, looking down on it and on all goals
AZIMUTH, ELEVATION = 90.0, -45.0
# How far away, as multiples of the width and the depth of where they are
DISTANCE = np.array([1.2, 1.45])
# Dynamics with threads; and what a forked process inherited of them, which is kept for good: to delete it is to wait for ever
# for threads that only the parent process has
THREADED: WeakSet[MujocoDynamics] = WeakSet()
LOST: list[Any] = []


def _lose_threads() -> None:
    for dynamics in THREADED:
        LOST.append(dynamics._rollout)
        dynamics._rollout = None
    THREADED.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose_threads)


class MujocoDynamics(Dynamics[PositionGoalFamily]):
    """Copies of a robot that is a MuJoCo model, and what an env has to know of it.

    A state is a row (time, qpos, qvel). The solver starts cold in every step: what it remembers of the last step would be part
    of a state otherwise. The threads are started by the first step, the renderer by the first picture. They are neither copied
    nor pickled: a copy starts its own.

    :param num_envs: how many copies.
    :param n_threads: how many threads step them; the results do not depend on it. None for ``OMP_NUM_THREADS`` if that is set,
        else one for each CPU that this process may use, but for no more than have enough to do.
    :param spec: the model. The goal's disc and the start's are added to it, which are seen and never felt.
    :param reset_noise_scale: half the width of the uniform noise on the starting positions, and standard deviation of the
        normal noise on the starting velocities.
    :param observation_bounds: observations are clipped at plus and minus these numbers, shape (obs_dim,).
    :raises ValueError: if the noise is negative or not finite, or another number smaller than 1.
    """

    frame_skip: ClassVar[int]
    """Physics steps in a control step."""
    n_exact_positions: ClassVar[int]
    """So many leading positions start without noise."""
    envs_per_thread: ClassVar[int]
    """With fewer copies for each thread, waking the threads takes longer than they save (measured)."""

    states: DoubleArray

    def __init__(
        self,
        num_envs: int,
        n_threads: int | None,
        spec: mujoco.MjSpec,
        reset_noise_scale: float,
        observation_bounds: FloatArray,
    ) -> None:
        if not are_numbers(reset_noise_scale) or not 0.0 <= reset_noise_scale < np.inf:
            raise ValueError(f"reset_noise_scale is {reset_noise_scale!r}, expected a finite number from 0 on.")
        if n_threads is None:
            n_threads = min(available_threads(), max(1, num_envs // self.envs_per_thread))
        if not are_whole(n_threads) or n_threads < 1:
            raise ValueError(f"n_threads is {n_threads!r}: pass a whole number from 1 on, or None for as many as CPUs.")
        # a state that is not finite is not replaced by the first one: the episode ends
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        _add_discs(spec)
        self.model = spec.compile()
        observation_space = spaces.Box(-observation_bounds, observation_bounds, dtype=np.float32)
        super().__init__(num_envs, observation_space, spaces.Box(-1.0, 1.0, (self.model.nu,), np.float32))
        self.n_threads = min(num_envs, n_threads)
        self.reset_noise_scale = reset_noise_scale
        n_state = mujoco.mj_stateSize(self.model, FULL_PHYSICS)
        self.states = np.zeros((num_envs, n_state))
        # arrays that MuJoCo reads and writes, made once
        self._controls = np.zeros((num_envs, self.frame_skip, self.model.nu))
        self._next_states = np.zeros((num_envs, self.frame_skip, n_state))
        self._sensors = np.zeros((num_envs, self.frame_skip, self.model.nsensordata))
        self._rollout: tuple[Rollout, list[mujoco.MjData]] | None = None
        self._renderer: tuple[Any, mujoco.MjData] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rollout": None, "_renderer": None}

    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        self.states[indices] = self.start_states(len(indices), rng)
        return self.observe(self.states[indices])

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        if self._rollout is None:
            THREADED.add(self)
            # with one thread the calling one does the work
            threads = Rollout(nthread=self.n_threads if self.n_threads > 1 else 0)
            self._rollout = threads, [mujoco.MjData(self.model) for _ in range(self.n_threads)]
        rollout, data = self._rollout
        actions = np.clip(actions, -1.0, 1.0)
        self._controls[:] = actions[:, None]
        rollout.rollout(
            [self.model] * self.num_envs,
            data,
            self.states,
            self._controls,
            nstep=self.frame_skip,
            state=self._next_states,
            sensordata=self._sensors,
            skip_checks=True,
        )
        self.states[:] = self._next_states[:, -1]
        rewards = self.task_free_reward(actions, self.states, self._sensors[:, -1])
        return self.observe(self.states), rewards, self.terminated(self.states)

    def render(
        self, task_family: PositionGoalFamily, task: FloatArray, path: DoubleArray, render_mode: str
    ) -> NDArray[np.uint8] | None:
        """Draw the robot, the start and the goal, which is a disc of the goal radius.

        :return: picture (400, 640, 3), uint8; None with ``"human"``.
        """
        if self._renderer is None:
            # imported here: who never renders needs no OpenGL
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

            open_no_window(render_mode)
            self.model.geom("goal").size[0] = task_family.goal_radius
            data = mujoco.MjData(self.model)  # of its own: a picture changes nothing in the simulation
            start, family = np.zeros((1, 2)), task_family
            places = np.concatenate([start, family.train_tasks, family.validation_tasks, family.test_tasks])
            low, high = places.min(axis=0), places.max(axis=0)
            camera = {"lookat": np.array([*(low + high) / 2, 0.0]), "distance": (DISTANCE * (high - low)).max()}
            camera |= {"azimuth": AZIMUTH, "elevation": ELEVATION}
            self._renderer = MujocoRenderer(self.model, data, camera, FRAME_WIDTH, FRAME_HEIGHT, camera_id=-1), data
        renderer, data = self._renderer
        mujoco.mj_setState(self.model, data, path[-1], FULL_PHYSICS)
        data.mocap_pos[0, :2] = task
        mujoco.mj_forward(self.model, data)
        if renderer.viewer is not None:
            # another env's window, opened or closed since, may have taken it away
            renderer.viewer.make_context_current()
        frame: NDArray[np.uint8] | None = renderer.render(render_mode)
        return frame

    def close(self) -> None:
        """End the threads and close the window, if there is one."""
        for opened in (self._rollout, self._renderer):
            if opened is not None:
                opened[0].close()
        self._rollout = self._renderer = None

    def positions(self, states: DoubleArray) -> DoubleArray:
        """Generalised positions (n, nq) in states (n, state_dim), a view."""
        return states[:, 1 : 1 + self.model.nq]

    def velocities(self, states: DoubleArray) -> DoubleArray:
        """Generalised velocities (n, nv) in states (n, state_dim), a view."""
        return states[:, 1 + self.model.nq : 1 + self.model.nq + self.model.nv]

    def start_states(self, n: int, rng: np.random.Generator) -> DoubleArray:
        """Draw start states.

        :param n: how many.
        :param rng: the only source of randomness.
        :return: states, shape (n, state_dim).
        """
        states = np.zeros((n, self.states.shape[1]))
        position_noise = rng.uniform(-self.reset_noise_scale, self.reset_noise_scale, (n, self.model.nq))
        position_noise[:, : self.n_exact_positions] = 0.0
        self.positions(states)[:] = self._start_position() + position_noise
        self.velocities(states)[:] = self.reset_noise_scale * rng.standard_normal((n, self.model.nv))
        return states

    def observe(self, states: DoubleArray) -> FloatArray:
        """What the agent sees.

        :param states: shape (n, state_dim).
        :return: observations in the observation space, also of a state that is not finite, shape (n, obs_dim).
        """
        observations = np.nan_to_num(self._observe(states).astype(np.float32))
        return np.clip(observations, self.observation_space.low, self.observation_space.high)

    def terminated(self, states: DoubleArray) -> BoolArray:
        """Where an episode ends.

        :param states: shape (n, state_dim).
        :return: which states are unhealthy or not finite, shape (n,).
        """
        # a number that is not finite makes the sum so, too
        return ~(np.isfinite(states.sum(axis=-1)) & self._is_healthy(states))

    @abstractmethod
    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        """The part of the reward that depends on no task.

        :param actions: clipped to the action space, shape (n, act_dim).
        :param states: after the step, shape (n, state_dim).
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


class MujocoVectorEnv(DynamicsVectorEnv):
    """Many robots that step together, in native threads.

    :param num_envs: how many robots.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param n_threads: how many threads step the robots; the results do not depend on it. None for ``OMP_NUM_THREADS`` if that
        is set, else one for each CPU that this process may use, but for no more than have enough to do.
    :param kwargs: the other arguments of the single env, but for ``render_mode``.
    """

    make: ClassVar[Callable[..., tuple[PositionGoalFamily, MujocoDynamics]]]
    """Of num_envs, n_threads and kwargs."""

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = 200,
        reward_type: str = "sparse",
        n_threads: int | None = None,
        **kwargs: Any,
    ) -> None:
        refuse_pictures(kwargs)
        super().__init__(*self.make(num_envs, n_threads, **kwargs), max_episode_steps, reward_type)


def _add_discs(spec: mujoco.MjSpec) -> None:
    # a mocap body can be put anywhere without a new model
    seen_only = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "contype": 0, "conaffinity": 0}
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    goal.add_geom(name="goal", size=[1.0, 0.002, 0.0], rgba=[0.90, 0.62, 0.0, 0.7], **seen_only)
    spec.worldbody.add_geom(name="start", size=[0.05, 0.002, 0.0], rgba=[0.0, 0.0, 0.0, 1.0], **seen_only)


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
