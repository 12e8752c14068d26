"""Dynamics written once: any number of copies step as arrays, and a single env is a batch of one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from htr_envs.task_env import BoolArray, FloatArray, TaskEnv, TaskFamily
from htr_envs.task_vector_env import TaskVectorEnv

Family = TypeVar("Family", bound=TaskFamily)


class Dynamics(ABC, Generic[Family]):
    """Copies of a robot that step together; nothing that they do depends on a task.

    :class:`DynamicsEnv` and :class:`DynamicsVectorEnv` are the single and the batched env of them. A subclass keeps
    ``states``; it must be picklable, and a pickled copy must go on alike.

    :param num_envs: how many copies.
    :param observation_space: observation space of one copy, shape (obs_dim,), float32.
    :param action_space: action space of one copy, shape (act_dim,), float32.
    :raises ValueError: if there are no copies.
    """

    states: NDArray[Any]
    """State of every copy, shape (num_envs, state_dim)."""

    def __init__(self, num_envs: int, observation_space: spaces.Box, action_space: spaces.Box) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}, expected at least 1.")
        self.num_envs = num_envs
        self.observation_space = observation_space
        self.action_space = action_space

    @abstractmethod
    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        """Put some copies in start states.

        :param indices: which copies, shape (n,).
        :param rng: the only source of randomness.
        :return: their observations, shape (n, obs_dim), float32.
        """

    @abstractmethod
    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Move all copies by one step.

        :param actions: the agent's actions, shape (num_envs, act_dim), float32, not clipped.
        :return: next observations (num_envs, obs_dim), task-free rewards (num_envs,), which copies terminate (num_envs,).
        """

    def render(self, task_family: Family, task: FloatArray, path: NDArray[Any], render_mode: str) -> NDArray[np.uint8] | None:
        """Draw one episode; only called in a mode that the env's ``metadata`` names.

        :param task_family: the family of the task.
        :param task: the episode's task, shape (task_dim,).
        :param path: states of the episode up to now, from the start on, shape (t + 1, state_dim).
        :param render_mode: how to draw.
        :return: picture (height, width, 3), uint8; None where it is shown in a window.
        """
        raise NotImplementedError(f"{type(self).__name__} draws no pictures.")

    def close(self) -> None:
        """Release threads and windows, if there are any."""


class DynamicsEnv(TaskEnv):
    """One robot with tasks: a batch of one. A subclass whose dynamics draw names its render modes in ``metadata``.

    :param task_family: tasks and rewards.
    :param dynamics: one copy of the robot.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param render_mode: one of the class's ``metadata["render_modes"]``, or None for no pictures.
    :raises ValueError: if the reward type or the render mode is unknown, or there are more copies than one.
    """

    def __init__(
        self,
        task_family: TaskFamily,
        dynamics: Dynamics[Any],
        reward_type: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode is {render_mode!r}, expected None or one of {modes}.")
        if dynamics.num_envs != 1:
            raise ValueError(f"The dynamics have {dynamics.num_envs} copies, a single env needs dynamics of one.")
        super().__init__(task_family, reward_type)
        self.dynamics = dynamics
        self.observation_space = dynamics.observation_space
        self.action_space = dynamics.action_space
        self.render_mode = render_mode
        self._path: list[NDArray[Any]] = []

    def _reset_state(self) -> FloatArray:
        observations = self.dynamics.reset(np.arange(1), self.np_random)
        self._path = []
        self._show()
        return observations[0]

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        observations, task_free_rewards, terminated = self.dynamics.step(action[None])
        self._show()
        return observations[0], task_free_rewards[0], terminated[0]

    def _show(self) -> None:
        # without pictures nobody needs the path, which has no end where there is no time limit
        if self.render_mode is not None:
            self._path.append(self.dynamics.states[0].copy())
        if self.render_mode == "human":
            self.render()

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the current episode up to now.

        :return: picture (height, width, 3), uint8; None with ``"human"``, which shows it in a window, and without a render
            mode.
        :raises gymnasium.error.ResetNeeded: before the first reset, with a render mode.
        """
        if self.render_mode is None:
            return None
        return self.dynamics.render(self.task_family, self.task, np.stack(self._path), self.render_mode)

    def close(self) -> None:
        """Close the window, if there is one."""
        self.dynamics.close()


def refuse_pictures(kwargs: dict[str, Any]) -> None:
    """Refuse the render mode that only a single env has.

    :param kwargs: arguments of a batch, of which it is taken away.
    :raises ValueError: if it is not None.
    """
    render_mode = kwargs.pop("render_mode", None)
    if render_mode is not None:
        raise ValueError(f"A batch draws no pictures: make a single env for render_mode={render_mode!r}.")


class DynamicsVectorEnv(TaskVectorEnv):
    """Many robots with tasks that step together.

    :param task_family: tasks and rewards.
    :param dynamics: all copies of the robot.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :raises ValueError: if the reward type is unknown or ``max_episode_steps`` is smaller than 1.
    """

    def __init__(
        self,
        task_family: TaskFamily,
        dynamics: Dynamics[Any],
        max_episode_steps: int | None = None,
        reward_type: str = "sparse",
    ) -> None:
        one_copy = dynamics.observation_space, dynamics.action_space
        super().__init__(task_family, dynamics.num_envs, *one_copy, max_episode_steps, reward_type)
        self.dynamics = dynamics

    def _reset_state(self, indices: NDArray[np.int64]) -> FloatArray:
        return self.dynamics.reset(indices, self.np_random)

    def _step_state(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        return self.dynamics.step(actions)

    def close_extras(self, **kwargs: Any) -> None:
        """Release what the dynamics hold, such as threads."""
        self.dynamics.close()
