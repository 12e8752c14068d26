"""Reach and Push of Meta-World's ML1 as GoalEnvs, by what Meta-World itself calls a success."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

try:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
except ImportError as error:
    raise DependencyNotInstalled('Meta-World is missing: run `pip install "sb3_htr[metaworld]"`.') from error

DoubleArray = NDArray[np.float64]

TASKS = ("reach", "push")
SUCCESS_DISTANCE = 0.05  # Meta-World's own, for both
N_FRAMES = 36  # numbers in an observation before the goal: this frame and the one before
OBJECT = slice(4, 7)
CAMERA = "corner2"  # hangs upside down


class MetaWorldGoalEnv(gym.Env[dict[str, DoubleArray], NDArray[np.float32]]):
    """A task of Meta-World's ML1: a robot arm moves its hand (``"reach"``) or a puck (``"push"``) to a goal.

    Meta-World's rewards are dense, and its tasks, 50 positions of puck and goal, come by a call of their own. Here both
    positions are drawn at each reset, from the same space, and the reward is 1 where ``info["success"]`` is, else 0.

    :param task: ``"reach"`` or ``"push"``.
    :param render_mode: ``"rgb_array"`` for pictures, or None.
    :raises ValueError: if the task is unknown.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 80}  # type: ignore[misc]

    def __init__(self, task: str, render_mode: str | None = None) -> None:
        if task not in TASKS:
            raise ValueError(f"task is {task!r}, expected one of {TASKS}.")
        self._task, self.render_mode = task, render_mode
        make: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]
        self._env = make(render_mode=render_mode, camera_name=CAMERA)
        self._env.max_path_length = np.inf  # the time limit is a wrapper's
        # what its set_task does, but for freezing the positions
        self._env._set_task_called, self._env._freeze_rand_vec, self._env.seeded_rand_vec = True, False, True
        sizes = {"observation": N_FRAMES, "achieved_goal": 3, "desired_goal": 3}
        boxes: Any = {key: spaces.Box(-np.inf, np.inf, (size,), np.float64) for key, size in sizes.items()}
        self.observation_space: Any = spaces.Dict(boxes)
        self.action_space = self._env.action_space

    @property
    def goal(self) -> DoubleArray:
        """Where hand or puck should be, shape (3,), a copy."""
        return np.array(self._env._target_pos)

    @goal.setter
    def goal(self, position: DoubleArray) -> None:
        self._env._target_pos = position
        self._env._set_pos_site("goal", position)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, DoubleArray], dict[str, Any]]:
        """Start an episode, with positions of its own."""
        super().reset(seed=seed)
        if seed is not None:
            self._env.seed(seed)
        observation, _ = self._env.reset()
        return self._split(observation), {}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, DoubleArray], float, bool, bool, dict[str, Any]]:
        """Do one step, by a movement of the hand and an effort of the gripper, shape (4,)."""
        state, _, _, _, info = self._env.step(action)
        observation = self._split(state)
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        return observation, float(reward), False, False, info

    def _split(self, observation: DoubleArray) -> dict[str, DoubleArray]:
        achieved = self._env.tcp_center if self._task == "reach" else observation[OBJECT]
        return {"observation": observation[:N_FRAMES].copy(), "achieved_goal": np.array(achieved), "desired_goal": self.goal}

    def compute_reward(self, achieved_goal: DoubleArray, desired_goal: DoubleArray, info: Any) -> DoubleArray:
        """Whether goals are reached.

        :param achieved_goal: shape (..., 3).
        :param desired_goal: shape (..., 3).
        :param info: not used.
        :return: 1 where the distance is at most 5 cm, else 0, shape (...).
        """
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return np.asarray(distance <= SUCCESS_DISTANCE, dtype=np.float64)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the arm from a corner of its table.

        :return: picture (480, 480, 3), uint8; None without a render mode.
        """
        if self.render_mode is None:
            return None
        frame: NDArray[np.uint8] = self._env.render()
        return frame[::-1, ::-1]

    def close(self) -> None:
        """Close what pictures need."""
        self._env.close()
