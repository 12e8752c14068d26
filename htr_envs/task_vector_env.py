"""The batched counterpart of a task environment: one array step for all copies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from htr_envs.meta_env import check_seed, checked_action, task_from_options
from htr_envs.task_env import (
    BoolArray,
    FloatArray,
    HasRewardHooks,
    TaskFamily,
    Trajectory,
    ask_hook,
    check_reward_type,
    read_only,
)


class TaskVectorEnv(HasRewardHooks, VectorEnv[FloatArray, FloatArray, NDArray[Any]], ABC):
    """Many copies of a task environment that step together, without a loop over them.

    A subclass writes the same two hooks as for :class:`htr_envs.TaskEnv`, on arrays. The rule on tasks is the same too, for
    each copy on its own: a task once given stays until it is changed, a copy that was given none draws one at each reset.

    A finished copy is reset within the same step (``AutoresetMode.SAME_STEP``): the observation returned is then the first one
    of its next episode. Everything else that ``step`` returns belongs to the step that was done:

    - ``infos["task_id"]`` (num_envs,), int64: indices into ``train_tasks``, -1 for a task given as a vector;
    - ``infos["is_success"]`` (num_envs,), bool;
    - ``infos["achieved_task"]`` (num_envs, task_dim), float32: the tasks that the next states solve;
    - ``infos["task_free_reward"]`` (num_envs,), float32;
    - ``infos["final_obs"]`` (num_envs, obs_dim), float32: a plain array, the next observations before any reset; and
      ``infos["_final_obs"]`` (num_envs,), bool: where they end an episode, which is where ``final_obs`` has a meaning.

    The tasks of the episodes now running, after any reset, are ``tasks`` and ``task_ids``.

    :param task_family: tasks and rewards.
    :param num_envs: how many copies.
    :param single_observation_space: observation space of one copy, shape (obs_dim,).
    :param single_action_space: action space of one copy, shape (act_dim,).
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` (the true one) or ``"dense"`` (the proxy).
    :raises ValueError: if the reward type is unknown or a number is smaller than 1.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # type: ignore[misc]

    def __init__(
        self,
        task_family: TaskFamily,
        num_envs: int,
        single_observation_space: spaces.Box,
        single_action_space: spaces.Box,
        max_episode_steps: int | None,
        reward_type: str = "sparse",
    ) -> None:
        check_reward_type(reward_type)
        if num_envs < 1 or (max_episode_steps is not None and max_episode_steps < 1):
            raise ValueError(f"num_envs is {num_envs} and max_episode_steps {max_episode_steps}: both must be at least 1.")
        self.task_family = task_family
        self.reward_type = reward_type
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = single_observation_space
        self.single_action_space = single_action_space
        self.observation_space = batch_space(single_observation_space, num_envs)
        self.action_space = batch_space(single_action_space, num_envs)

        task_shape = (num_envs, *task_family.train_tasks.shape[1:])
        self._is_task_given = np.zeros(num_envs, dtype=np.bool_)
        self._given_task_ids = np.full(num_envs, -1, dtype=np.int64)
        self._given_tasks = np.zeros(task_shape, dtype=np.float32)
        self._ids_of_episodes = np.full(num_envs, -1, dtype=np.int64)
        self._tasks_of_episodes = np.zeros(task_shape, dtype=np.float32)
        self._elapsed_steps = np.zeros(num_envs, dtype=np.int64)
        self._last_observations: FloatArray | None = None

    @abstractmethod
    def _reset_state(self, indices: NDArray[np.int64]) -> FloatArray:
        """Put some copies in a start state, drawn with ``self.np_random``.

        :param indices: which copies, shape (n,).
        :return: their first observations, shape (n, obs_dim), float32.
        """

    @abstractmethod
    def _step_state(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Move all copies by one step.

        :param actions: the agent's actions, shape (num_envs, act_dim), float32, not clipped.
        :return: next observations (num_envs, obs_dim), task-free rewards (num_envs,), which copies terminate (num_envs,).
        """

    def set_task(self, tasks: ArrayLike | None, indices: ArrayLike | None = None) -> None:
        """Choose the tasks of the episodes from the next reset of each copy on.

        :param tasks: indices into ``train_tasks``, shape (n,), or vectors, shape (n, task_dim), one for each copy meant; one
            index for all of them; or None to draw a training task at each reset.
        :param indices: which copies are meant, ints (n,) or a mask (num_envs,); None for all of them.
        :raises ValueError: if an id or an index is out of range, a vector not in the task space, or their number wrong.
        """
        chosen = np.arange(self.num_envs)
        if indices is not None:
            try:
                # an empty list is an array of floats
                chosen = np.atleast_1d(chosen[np.asarray(indices) if np.size(indices) else []])
            except (IndexError, ValueError):
                raise ValueError(
                    f"indices are {indices!r}: pass whole numbers below {self.num_envs}, or a mask of {self.num_envs} bools."
                ) from None
        if tasks is None:
            self._is_task_given[chosen] = False
            return
        values = np.full(len(chosen), tasks) if np.ndim(tasks) == 0 else tasks
        if np.ndim(values) == 1 and np.size(values) and np.asarray(values).dtype.kind == "f":
            shape = (len(chosen), *self._tasks_of_episodes.shape[1:])
            raise ValueError(f"The tasks {tasks!r} are no whole numbers, as ids are: vectors need the shape {shape}.")
        self._give_tasks("task" if np.ndim(values) > 1 else "task_id", values, chosen)

    def _give_tasks(self, key: str, value: Any, indices: NDArray[np.int64]) -> None:
        if key == "task_id":
            task_ids = self.task_family.task_indices(value, indices.shape)
            self._given_task_ids[indices], self._given_tasks[indices] = task_ids, self.task_family.train_tasks[task_ids]
        else:
            vectors = self.task_family.task_vectors(value, indices.shape + self._tasks_of_episodes.shape[1:])
            self._given_task_ids[indices], self._given_tasks[indices] = -1, vectors
        self._is_task_given[indices] = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode in every copy.

        :param seed: seed of the one generator that all copies share, None to go on with it.
        :param options: ``{"task_id": ids}``, shape (num_envs,), or ``{"task": vectors}``, shape (num_envs, task_dim); like
            ``set_task`` before.
        :return: first observations (num_envs, obs_dim), float32, and infos with ``task_id``.
        :raises ValueError: if an option is unknown or its tasks are invalid.
        """
        chosen = task_from_options(options)
        everyone = np.arange(self.num_envs)
        check_seed(seed)
        if chosen is not None:
            self._give_tasks(*chosen, everyone)
        super().reset(seed=seed)  # not before: a reset that is refused changes nothing
        self.closed = False  # what steps now can be closed again
        assert self.single_observation_space.shape is not None
        self._last_observations = np.zeros((self.num_envs, *self.single_observation_space.shape), dtype=np.float32)
        self._begin_episodes(self._last_observations, everyone)
        return self._last_observations.copy(), {"task_id": self.task_ids}

    def _begin_episodes(self, observations: FloatArray, indices: NDArray[np.int64]) -> None:
        # drawn for all of them even if it is not used, for the reason given in MetaEnv.reset
        drawn = self.np_random.integers(len(self.task_family.train_tasks), size=len(indices))
        given = self._is_task_given[indices]
        self._ids_of_episodes[indices] = np.where(given, self._given_task_ids[indices], drawn)
        self._tasks_of_episodes[indices] = np.where(
            given[:, None], self._given_tasks[indices], self.task_family.train_tasks[drawn]
        )
        self._elapsed_steps[indices] = 0
        states, expected = self._reset_state(indices), (len(indices), *observations.shape[1:])
        if states is None or np.shape(states) != expected:
            what = "nothing" if states is None else f"shape {np.shape(states)}"
            raise ValueError(f"_reset_state returned {what}, expected {expected}: a first observation for each of `indices`.")
        observations[indices] = states

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Do one step in every copy, and reset those that it finishes.

        :param actions: the actions, shape (num_envs, act_dim).
        :return: observations (num_envs, obs_dim), rewards, terminations, truncations (num_envs,), infos as in the class.
        :raises ValueError: if the actions have the wrong shape, or are not finite; or for what ``_step_state`` may not return.
        :raises gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._last_observations is None:
            raise ResetNeeded("step was called before the first reset: call reset() first.")
        actions = checked_action(actions, self.action_space)
        stepped = self._step_state(actions.copy())  # as in a single env
        given = tuple(map(np.shape, stepped)) if isinstance(stepped, tuple | list) else f"a {type(stepped).__name__}"
        expected = (self._last_observations.shape, (self.num_envs,), (self.num_envs,))
        if given != expected:
            raise ValueError(
                "_step_state returns observations, task-free rewards and terminations, one of each for each env: expected "
                f"arrays of the shapes {expected}, got {given}."
            )
        states, task_free_reward, terminated = stepped
        # float32 as in a single env, before rewards are computed of it
        task_free_reward, terminated = np.asarray(task_free_reward, dtype=np.float32), np.asarray(terminated)
        if terminated.dtype != np.bool_:
            raise ValueError(
                f"_step_state returns terminations of dtype {terminated.dtype}, expected bool: observations, task-free "
                "rewards and terminations, in this order."
            )
        final_obs = np.array(states, dtype=np.float32)
        # an axis of T = 1 makes every copy a trajectory of its own, with its own task
        traj = Trajectory(*(values[:, None] for values in (self._last_observations, actions, final_obs, task_free_reward)))
        family, tasks, shape = self.task_family, self.tasks, (self.num_envs, 1)
        read_only(*traj, tasks)
        rewards = ask_hook(family.compute_reward, "compute_reward", shape, traj, tasks, self.reward_type)[:, 0]
        successes = ask_hook(family.is_success, "is_success", shape, traj, tasks)[:, 0]
        achieved = ask_hook(family.hindsight_task, "hindsight_task", tasks.shape, traj, 0)
        self._elapsed_steps += 1
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        if self.max_episode_steps is not None:
            truncated = self._elapsed_steps >= self.max_episode_steps
        done = terminated | truncated
        infos = {
            "task_id": self.task_ids,
            "is_success": successes,
            "achieved_task": achieved,
            "task_free_reward": task_free_reward.copy(),
            "final_obs": final_obs,
            "_final_obs": done,
        }
        self._last_observations = final_obs.copy()
        if done.any():
            self._begin_episodes(self._last_observations, np.flatnonzero(done))
        return self._last_observations.copy(), rewards, np.array(terminated), truncated, infos

    @property
    def tasks(self) -> FloatArray:
        """Tasks of the current episodes, shape (num_envs, task_dim), a copy."""
        self._check_begun()
        return self._tasks_of_episodes.copy()

    @property
    def task_ids(self) -> NDArray[np.int64]:
        """Indices of the current episodes' tasks in ``train_tasks``, -1 for a task given as a vector, (num_envs,), a copy."""
        self._check_begun()
        return self._ids_of_episodes.copy()

    def _check_begun(self) -> None:
        if self._last_observations is None:
            raise ResetNeeded("The envs have no tasks before their first reset: call reset() first.")
