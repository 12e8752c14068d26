"""Task environments whose dynamics are a MuJoCo model, single and batched."""

from __future__ import annotations

import os
import sys
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from htr_envs.mujoco_dynamics import FULL_PHYSICS, MujocoBatch, MujocoDynamics, available_threads
from htr_envs.semicircle_goals import SemicircleGoalFamily
from htr_envs.task_env import BoolArray, FloatArray, TaskEnv
from htr_envs.task_vector_env import TaskVectorEnv

RENDER_MODES = ("human", "rgb_array")
FRAME_WIDTH, FRAME_HEIGHT = 640, 400
# From behind the start, looking down on the semicircle of goals
CAMERA = {"lookat": np.array([0.0, 0.9, 0.0]), "distance": 4.8, "azimuth": 90.0, "elevation": -45.0}


class MujocoTaskEnv(TaskEnv):
    """One robot in MuJoCo: a batch of one.

    :param task_family: goals (x, y) and rewards.
    :param dynamics: the robot.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param render_mode: ``"human"`` for a window, ``"rgb_array"`` for pictures, None for neither.
    :raises ValueError: if the reward type or the render mode is unknown.
    """

    def __init__(
        self, task_family: SemicircleGoalFamily, dynamics: MujocoDynamics, reward_type: str, render_mode: str | None
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}, but only 'human' and 'rgb_array' exist: pass one or None.")
        super().__init__(task_family, reward_type)
        self.observation_space = dynamics.observation_space
        self.action_space = dynamics.action_space
        self.render_mode = render_mode
        self._batch = MujocoBatch(dynamics, n=1, n_threads=1)
        self._goal_radius = task_family.goal_radius
        self._renderer: Any = None
        self._render_data: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_renderer": None, "_render_data": None}  # a copy opens its own window

    def _reset_state(self) -> FloatArray:
        observations = self._batch.reset(np.zeros(1, dtype=np.int64), self.np_random)
        if self.render_mode == "human":
            self.render()
        return observations[0]

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        observations, task_free_rewards, terminated = self._batch.step(action[None])
        if self.render_mode == "human":
            self.render()
        return observations[0], float(task_free_rewards[0]), bool(terminated[0])

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the robot, the start and the goal of the current episode, which is a disc of the goal radius.

        :return: picture (400, 640, 3), uint8; None with ``"human"``, which shows it in a window, and without a render mode.
        """
        if self.render_mode is None:
            return None
        model = self._batch.dynamics.model
        if self._renderer is None:
            # imported here: who never renders needs no OpenGL
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

            if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                # gymnasium would try to open a window first, which ends the process where there is no screen
                os.environ.setdefault("MUJOCO_GL", "egl")
            self._render_data = mujoco.MjData(model)
            model.geom("goal").size[0] = self._goal_radius
            self._renderer = MujocoRenderer(model, self._render_data, dict(CAMERA), FRAME_WIDTH, FRAME_HEIGHT, camera_id=-1)
        # data of its own: a picture changes nothing in the simulation
        mujoco.mj_setState(model, self._render_data, self._batch.states[0], FULL_PHYSICS)
        self._render_data.mocap_pos[0, :2] = self.task
        mujoco.mj_forward(model, self._render_data)
        frame: NDArray[np.uint8] | None = self._renderer.render(self.render_mode)
        return frame

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer, self._render_data = None, None
        self._batch.close()


class MujocoTaskVectorEnv(TaskVectorEnv):
    """Many robots in MuJoCo that step together, in native threads.

    :param task_family: goals and rewards.
    :param dynamics: the robot.
    :param num_envs: how many robots.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param n_threads: how many threads step the robots; the results do not depend on it. None for ``OMP_NUM_THREADS`` if that
        is set, else one for each CPU that this process may use, but for no more than have enough to do.
    :raises ValueError: if the reward type is unknown or a number is smaller than 1.
    """

    def __init__(
        self,
        task_family: SemicircleGoalFamily,
        dynamics: MujocoDynamics,
        num_envs: int,
        max_episode_steps: int | None,
        reward_type: str,
        n_threads: int | None,
    ) -> None:
        spaces = dynamics.observation_space, dynamics.action_space
        super().__init__(task_family, num_envs, *spaces, max_episode_steps, reward_type)
        if n_threads is None:
            n_threads = min(available_threads(), max(1, num_envs // dynamics.envs_per_thread))
        if n_threads < 1:
            raise ValueError(f"n_threads is {n_threads}: pass at least 1, or None for as many as there are CPUs.")
        self._batch = MujocoBatch(dynamics, num_envs, n_threads)

    def _reset_state(self, indices: NDArray[np.int64]) -> FloatArray:
        return self._batch.reset(indices, self.np_random)

    def _step_state(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        return self._batch.step(actions)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._batch.close()
