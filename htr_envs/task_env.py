"""The contract of a task family, and the single environment built on it.

A *task* is a float vector (a goal position, a target speed). A :class:`TaskFamily` knows the tasks and the rewards, a
:class:`TaskEnv` knows the dynamics. The two are apart because a replay buffer needs the rewards of any experience under any
task, long after the environment has moved on: the family is a small object that it can pickle and call without an env.
``htr_envs.check_task_env`` tests every promise made here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

REWARD_TYPES = ("sparse", "dense")


class Trajectory(NamedTuple):
    """Steps of experience, without their rewards, under any number of leading axes.

    Functions that take a trajectory accept any object with these four attributes. A reward depends on its own step alone, so
    any selection of steps in any order is a valid trajectory too.
    """

    observations: FloatArray
    """What the agent saw before the step, shape (..., T, obs_dim)."""
    actions: FloatArray
    """What the agent did, shape (..., T, act_dim)."""
    next_observations: FloatArray
    """What the agent saw after the step (the last one of an episode, not the reset that follows), shape (..., T, obs_dim)."""
    task_free_reward: FloatArray
    """The part of the reward that depends on no task, such as a control cost, shape (..., T)."""


def check_reward_type(reward_type: str) -> None:
    """Refuse a reward type that no family knows.

    :param reward_type: ``"sparse"`` or ``"dense"``.
    :raises ValueError: if it is neither.
    """
    if reward_type not in REWARD_TYPES:
        raise ValueError(f"reward_type is {reward_type!r}, but only 'sparse' and 'dense' exist: pass one of these two.")


def at_step(values: FloatArray, index: ArrayLike) -> FloatArray:
    """Pick one step of each trajectory; what a ``hindsight_task`` needs.

    :param values: one row per step, shape (..., T, dim).
    :param index: which step, an int or an int array that broadcasts with the leading axes of ``values``.
    :return: the rows, shape (..., dim), float32, sharing no memory with ``values``.
    """
    values, steps = np.asarray(values, dtype=np.float32), np.asarray(index)
    if steps.ndim == 0:
        return values[..., int(steps), :].copy()
    leading = np.broadcast_shapes(steps.shape, values.shape[:-2])
    values = np.broadcast_to(values, leading + values.shape[-2:])
    indices = np.broadcast_to(steps, leading)[..., None, None]
    return np.take_along_axis(values, indices, axis=-2)[..., 0, :]


def draw_task_sets(
    n_train_tasks: int,
    n_validation_tasks: int,
    n_test_tasks: int,
    task_seed: int,
    held_out: tuple[float, float] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Training, validation and test tasks along one number from 0 to 1, of which tasks are distributed uniformly.

    Training tasks are 80 % of an even grid, 0 and 1 in it, as in PEARL's reference implementation. Validation and test tasks
    are drawn, one uniformly from each of as many equal parts, so that they are balanced: never on a grid, and so never the
    training tasks of another seed. Each of the three has a source of randomness of its own.

    :param n_train_tasks: how many training tasks.
    :param n_validation_tasks: how many validation tasks.
    :param n_test_tasks: how many test tasks.
    :param task_seed: seed of all three, apart from the seed of a run.
    :param held_out: an interval that training tasks avoid and the others lie in, None for no such split.
    :return: numbers of training, validation and test tasks, one axis each.
    :raises ValueError: if a number of tasks is smaller than 1, or the interval is none in [0, 1].
    """
    if min(n_train_tasks, n_test_tasks, n_validation_tasks) < 1:
        raise ValueError(
            f"n_train_tasks, n_test_tasks, n_validation_tasks are {n_train_tasks}, {n_test_tasks}, {n_validation_tasks}: "
            "each must be at least 1."
        )
    low, high = (0.0, 1.0) if held_out is None else held_out
    if not 0.0 <= low < high <= 1.0 or held_out == (0.0, 1.0):
        raise ValueError(f"The interval held out of training is {low:g} to {high:g} of the range, expected a part of it.")
    # numpy never changes RandomState's stream, as it may Generator's: the tasks stay the same for good
    grid = np.linspace(0.0, 1.0, n_train_tasks + max(n_train_tasks // 4, 1))
    np.random.RandomState(task_seed).shuffle(grid)
    train = grid[:n_train_tasks]
    if held_out is not None:
        train = train * (1.0 - (high - low))
        train = np.where(train < low, train, train + (high - low))

    def draw(n: int, purpose: int) -> NDArray[np.float64]:
        random_state = np.random.RandomState([task_seed, purpose])
        values = low + (high - low) * (np.arange(n) + random_state.uniform(size=n)) / n
        random_state.shuffle(values)
        return values

    return train, draw(n_validation_tasks, 1), draw(n_test_tasks, 2)


class TaskFamily(ABC):
    """A distribution of tasks with their rewards: small, picklable, stateless.

    All methods are pure and vectorized: they change neither their arguments nor the family, and leading axes of the
    trajectory and of the task broadcast against each other.

    :param task_space: the box that every task lies in, hindsight tasks included, shape (task_dim,).
    :param train_tasks: tasks to meta-train on, shape (n, task_dim).
    :param validation_tasks: tasks to choose hyper-parameters and checkpoints on, shape (n, task_dim).
    :param test_tasks: tasks to report results on, shape (n, task_dim).
    :raises ValueError: if an array has the wrong shape, leaves ``task_space``, or shares a task with another.
    """

    def __init__(
        self, task_space: spaces.Box, train_tasks: ArrayLike, validation_tasks: ArrayLike, test_tasks: ArrayLike
    ) -> None:
        self.task_space = task_space
        self.train_tasks: FloatArray = np.array(train_tasks, dtype=np.float32)
        self.validation_tasks: FloatArray = np.array(validation_tasks, dtype=np.float32)
        self.test_tasks: FloatArray = np.array(test_tasks, dtype=np.float32)
        self._freeze()
        seen: set[bytes] = set()
        for name, tasks in self._task_sets().items():
            if tasks.ndim != 2 or len(tasks) == 0:
                raise ValueError(f"{name} has shape {tasks.shape}, expected (n, task_dim): pass at least one task.")
            if not all(task_space.contains(task) for task in tasks):
                raise ValueError(f"{name} holds a task that is not in {task_space}: widen the space or move it.")
            # adding 0.0 turns -0.0 into 0.0, the same task with other bytes
            keys = {(task + 0.0).tobytes() for task in tasks}
            if keys & seen:
                raise ValueError(f"{name} shares a task with another set: train, validation and test tasks must be disjoint.")
            seen |= keys

    def _task_sets(self) -> dict[str, FloatArray]:
        return {
            "train_tasks": self.train_tasks,
            "validation_tasks": self.validation_tasks,
            "test_tasks": self.test_tasks,
        }

    def _freeze(self) -> None:
        for tasks in self._task_sets().values():
            tasks.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._freeze()  # pickling forgets that an array is read-only

    @abstractmethod
    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw new tasks from the distribution that the fixed task sets stand for.

        :param n: how many tasks.
        :param rng: the only source of randomness.
        :return: tasks, shape (n, task_dim).
        """

    @abstractmethod
    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        """Reward of every step under a task, the task-free part included.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param task: the task, shape (..., task_dim); its leading axes broadcast with those of ``traj``.
        :param reward_type: ``"sparse"`` is the true reward; its task part is positive where a step is a success and 0 where
            it is none, so that nothing about the task leaks. ``"dense"`` is the proxy reward of the oracle baseline.
        :return: rewards, shape (..., T), float32.
        :raises ValueError: if the reward type is unknown.
        """

    @abstractmethod
    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        """Whether every step solves a task.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param task: the task, shape (..., task_dim); its leading axes broadcast with those of ``traj``.
        :return: successes, shape (..., T).
        """

    @abstractmethod
    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The task that the next state of one step solves.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param index: which step, an int or an int array that broadcasts with the leading axes of ``traj``.
        :return: tasks in ``task_space``, shape (..., task_dim), float32, sharing no memory with ``traj``.
        """

    def task_vectors(self, tasks: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
        """Check task vectors that a user gave and copy them.

        :param tasks: one task or several.
        :param shape: the shape that they must have, (..., task_dim).
        :return: the tasks, float32.
        :raises ValueError: if they are not numbers, have another shape, or lie outside ``task_space``.
        """
        try:
            vectors = np.array(tasks, dtype=np.float32)
        except (TypeError, ValueError):
            raise ValueError(f"The task {tasks!r} is not made of numbers: pass a float vector of shape {shape}.") from None
        if vectors.shape != shape:
            raise ValueError(f"The task has shape {vectors.shape}, expected {shape}: pass a vector of the task space.")
        # written so that nan, which compares with nothing, is refused too
        if not np.all((vectors >= self.task_space.low) & (vectors <= self.task_space.high)):
            raise ValueError(f"The task {vectors.tolist()} is not in {self.task_space}: pass a vector of the task space.")
        return vectors

    def task_indices(self, ids: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.int64]:
        """Check ids of training tasks that a user gave and copy them.

        :param ids: one id or several, indices into ``train_tasks``.
        :param shape: the shape that they must have.
        :return: the ids, int64.
        :raises ValueError: if they are no integers, have another shape, or are out of range.
        """
        indices = np.asarray(ids)
        n = len(self.train_tasks)
        if not np.issubdtype(indices.dtype, np.integer):
            raise ValueError(f"The task id {ids!r} is no integer: pass an index into train_tasks, from 0 to {n - 1}.")
        if indices.shape != shape:
            raise ValueError(f"The task id has shape {indices.shape}, expected {shape}: pass one id for each env.")
        if np.any((indices < 0) | (indices >= n)):
            raise ValueError(f"The task id {ids!r} is out of range: there are {n} training tasks, so pass 0 to {n - 1}.")
        return indices.astype(np.int64)


def task_from_options(options: dict[str, Any] | None) -> tuple[str, Any] | None:
    """Read the options of a reset.

    :param options: ``{"task_id": ...}``, ``{"task": ...}``, or nothing.
    :return: the key and its value, or None where no task is given.
    :raises ValueError: if there is an unknown key, or more than one.
    """
    if not options:
        return None
    unknown = sorted(str(key) for key in options if key not in ("task_id", "task"))
    if unknown:
        raise ValueError(f"Unknown reset options {unknown}: only 'task_id' and 'task' exist, remove the others.")
    if len(options) > 1:
        raise ValueError("The reset options hold both 'task_id' and 'task': pass only one of them.")
    return next(iter(options.items()))


class TaskEnv(gym.Env[FloatArray, FloatArray], ABC):
    """An environment whose reward depends on a task that the observation never shows.

    A subclass sets ``observation_space`` and ``action_space`` and writes the dynamics in ``_reset_state`` and ``_step_state``;
    tasks, rewards and infos are done here. The dynamics, terminations included, must not depend on the task.

    The task of an episode is chosen at its reset. A task once given, by ``set_task`` or by the reset's options, stays over
    later resets until it is changed; an env that was given none draws a random training task at each reset.

    The info of ``reset`` has ``task_id``. The info of ``step`` has

    - ``task_id``: int, index into ``train_tasks``, -1 for a task given as a vector;
    - ``is_success``: bool, whether this step solves the task;
    - ``achieved_task``: array (task_dim,), the task that the next state solves;
    - ``task_free_reward``: float, the part of the reward that depends on no task.

    :param task_family: tasks and rewards.
    :param reward_type: reward of ``step``, ``"sparse"`` (the true one) or ``"dense"`` (the proxy).
    :raises ValueError: if the reward type is unknown.
    """

    observation_space: spaces.Box  # type: ignore[assignment]
    action_space: spaces.Box  # type: ignore[assignment]

    def __init__(self, task_family: TaskFamily, reward_type: str = "sparse") -> None:
        check_reward_type(reward_type)
        self.task_family = task_family
        self.reward_type = reward_type
        self._given: tuple[int, FloatArray] | None = None
        self._current: tuple[int, FloatArray] | None = None
        self._observation: FloatArray | None = None

    @abstractmethod
    def _reset_state(self) -> FloatArray:
        """Put the dynamics in a start state, drawn with ``self.np_random``.

        :return: first observation, shape (obs_dim,), float32.
        """

    @abstractmethod
    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        """Move the dynamics by one step.

        :param action: the agent's action, shape (act_dim,), float32, not clipped.
        :return: next observation (obs_dim,), task-free reward, whether the episode terminates.
        """

    def set_task(self, task: ArrayLike | None) -> None:
        """Choose the task of the episodes from the next reset on.

        :param task: an index into ``train_tasks``, a vector of ``task_space``, or None to draw a training task at each reset.
        :raises ValueError: if the id is out of range or the vector is not in the task space.
        """
        if task is None:
            self._given = None
        elif np.ndim(task) == 0:
            self._give("task_id", task)
        else:
            self._give("task", task)

    def _give(self, key: str, value: Any) -> None:
        if key == "task_id":
            task_id = int(self.task_family.task_indices(value, ()))
            self._given = (task_id, self.train_tasks[task_id])
        else:
            assert self.task_space.shape is not None
            self._given = (-1, self.task_family.task_vectors(value, self.task_space.shape))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode.

        :param seed: seed of the env's generator, None to go on with it.
        :param options: ``{"task_id": i}`` (index into ``train_tasks``) or ``{"task": vector}``; like ``set_task`` before.
        :return: first observation (obs_dim,), float32, and an info with ``task_id``.
        :raises ValueError: if an option is unknown or its task is invalid.
        """
        chosen = task_from_options(options)
        super().reset(seed=seed)
        if chosen is not None:
            self._give(*chosen)
        # drawn even if it is not used: a seed then gives the same starts whichever way the task was chosen
        drawn = int(self.np_random.integers(len(self.train_tasks)))
        self._current = (drawn, self.train_tasks[drawn]) if self._given is None else self._given
        self._observation = np.array(self._reset_state(), dtype=np.float32)
        return self._observation.copy(), {"task_id": self.task_id}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Do one step; the time limit is left to the TimeLimit wrapper.

        :param action: the action, shape (act_dim,).
        :return: next observation (obs_dim,), reward, terminated, False, info.
        :raises ValueError: if the action has the wrong shape.
        :raises gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._observation is None:
            raise ResetNeeded("step was called before the first reset: call env.reset() first.")
        action = np.array(action, dtype=np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"The action has shape {action.shape}, expected {self.action_space.shape}: pass one action.")
        state, task_free_reward, terminated = self._step_state(action)
        observation = np.array(state, dtype=np.float32)
        # one reward function for step and for relabelling: compute_reward gives step's rewards again, bit for bit
        traj = Trajectory(self._observation[None], action[None], observation[None], np.array([task_free_reward], np.float32))
        self._observation = observation
        reward = float(self.compute_reward(traj, self.task)[0])
        info = {
            "task_id": self.task_id,
            "is_success": bool(self.task_family.is_success(traj, self.task)[0]),
            "achieved_task": self.hindsight_task(traj, 0),
            "task_free_reward": float(traj.task_free_reward[0]),
        }
        return observation.copy(), reward, bool(terminated), False, info

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str | None = None) -> FloatArray:
        """Reward of every step of a trajectory under a task; see :meth:`TaskFamily.compute_reward`.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param task: the task, shape (..., task_dim).
        :param reward_type: ``"sparse"``, ``"dense"``, or None for the env's own.
        :return: rewards, shape (..., T), float32.
        :raises ValueError: if the reward type is unknown.
        """
        return self.task_family.compute_reward(traj, task, self.reward_type if reward_type is None else reward_type)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """The task that the next state of step ``index`` solves; see :meth:`TaskFamily.hindsight_task`.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param index: which step, an int or an int array that broadcasts with the leading axes of ``traj``.
        :return: tasks, shape (..., task_dim), float32.
        """
        return self.task_family.hindsight_task(traj, index)

    def _current_task(self) -> tuple[int, FloatArray]:
        if self._current is None:
            raise ResetNeeded("The env has no task before its first reset: call env.reset() first.")
        return self._current

    @property
    def task(self) -> FloatArray:
        """Task of the current episode, shape (task_dim,), a copy."""
        return self._current_task()[1].copy()

    @property
    def task_id(self) -> int:
        """Index of the current episode's task in ``train_tasks``, -1 for a task given as a vector."""
        return self._current_task()[0]

    @property
    def task_space(self) -> spaces.Box:
        """The box that every task lies in."""
        return self.task_family.task_space

    @property
    def train_tasks(self) -> FloatArray:
        """Tasks to meta-train on, shape (n, task_dim), read-only."""
        return self.task_family.train_tasks

    @property
    def validation_tasks(self) -> FloatArray:
        """Tasks to choose hyper-parameters and checkpoints on, shape (n, task_dim), read-only."""
        return self.task_family.validation_tasks

    @property
    def test_tasks(self) -> FloatArray:
        """Tasks to report results on, shape (n, task_dim), read-only."""
        return self.task_family.test_tasks
