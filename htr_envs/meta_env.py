"""Tasks, and the single environment that is given them.

A *task* is a float vector (a goal position, a target speed, masses of limbs). What is here makes no promise about what a task
changes. Where it changes the reward alone, and the reward is known as a function of a step, experience can be relabelled: that
is ``htr_envs.TaskFamily`` and ``htr_envs.TaskEnv``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float32]


def _float_array(name: str, tasks: ArrayLike) -> FloatArray:
    try:
        return np.array(tasks, dtype=np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is no array of numbers: pass rows of equal length, shape (n, task_dim).") from None


class TaskDistribution(ABC):
    """A distribution of tasks and three fixed sets of them: small, picklable, stateless.

    :param task_space: the box that every task lies in, shape (task_dim,); kept with bounds of float32, as tasks have it.
    :param train_tasks: tasks to meta-train on, shape (n, task_dim).
    :param validation_tasks: tasks to choose hyper-parameters and checkpoints on, shape (n, task_dim).
    :param test_tasks: tasks to report results on, shape (n, task_dim).
    :raises ValueError: if the space is no box of one axis, or an array is not made of numbers, has the wrong shape, leaves the
        space, or shares a task with another.
    """

    def __init__(
        self, task_space: spaces.Box, train_tasks: ArrayLike, validation_tasks: ArrayLike, test_tasks: ArrayLike
    ) -> None:
        if not isinstance(task_space, spaces.Box) or len(task_space.shape) != 1:
            raise ValueError(f"task_space is {task_space}, expected a Box of one axis, shape (task_dim,): tasks are vectors.")
        # Tasks are float32, and one on a bound must not fall out by rounding
        low, high = task_space.low.astype(np.float32), task_space.high.astype(np.float32)
        self.task_space = spaces.Box(low, high, dtype=np.float32)
        self.train_tasks = _float_array("train_tasks", train_tasks)
        self.validation_tasks = _float_array("validation_tasks", validation_tasks)
        self.test_tasks = _float_array("test_tasks", test_tasks)
        self._freeze()
        seen: set[bytes] = set()
        for name, tasks in self._task_sets().items():
            if tasks.ndim != 2 or len(tasks) == 0:
                raise ValueError(f"{name} has shape {tasks.shape}, expected (n, task_dim): pass at least one task.")
            if tasks.shape[1:] != task_space.shape:
                raise ValueError(
                    f"{name} has shape {tasks.shape}, expected (n, {task_space.shape[0]}): a row is a task of {task_space}."
                )
            if not np.isfinite(tasks).all():
                raise ValueError(f"{name} has NaN or infinity, expected finite numbers.")
            if not all(self.task_space.contains(task) for task in tasks):
                raise ValueError(f"{name} holds a task that is not in {task_space}: widen the space or move it.")
            # adding 0.0 turns -0.0 into 0.0, the same task with other bytes
            keys = {(task + 0.0).tobytes() for task in tasks}
            if len(keys) < len(tasks):
                raise ValueError(f"{name} holds a task twice: the tasks of a set must differ.")
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

    def task_vectors(self, tasks: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
        """Check task vectors that a user gave and copy them.

        :param tasks: one task or several.
        :param shape: the shape that they must have, (..., task_dim).
        :return: the tasks, float32.
        :raises ValueError: if they are not finite numbers, have another shape, or lie outside ``task_space``.
        """
        try:
            vectors = np.array(tasks, dtype=np.float32)
        except (TypeError, ValueError):
            raise ValueError(f"The task {tasks!r} is not made of numbers: pass a float vector of shape {shape}.") from None
        if vectors.shape != shape:
            raise ValueError(f"The task has shape {vectors.shape}, expected {shape}: pass a vector of the task space.")
        # a space without bounds holds infinity
        if not np.all(np.isfinite(vectors) & (vectors >= self.task_space.low) & (vectors <= self.task_space.high)):
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
        if indices.size and not np.issubdtype(indices.dtype, np.integer):
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


def check_seed(seed: int | None) -> None:
    """Refuse one that gymnasium would, before anything is taken.

    :raises gymnasium.error.Error: for a seed that is none.
    """
    if seed is not None:
        seeding.np_random(seed)


def checked_action(action: ArrayLike, space: spaces.Space[Any]) -> NDArray[np.float32]:
    """A float32 copy of an action, or of one for each env.

    :raises ValueError: if it is not made of numbers, has another shape than those of the space, or a number that is not
        finite.
    """
    try:
        checked = np.array(action, dtype=np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"The action is {action!r}, expected numbers of shape {space.shape}: pass a float array.") from None
    if checked.shape != space.shape:
        raise ValueError(f"The action has shape {checked.shape}, expected {space.shape}: pass one of the action space.")
    if not np.isfinite(checked).all():
        raise ValueError(f"The action is {checked}, expected finite numbers: look for where it comes from.")
    return checked


class HasTaskFamily:
    """An env's tasks are those of its family."""

    task_family: TaskDistribution

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


class MetaEnv(HasTaskFamily, gym.Env[FloatArray, FloatArray], ABC):
    """An environment that is given tasks, which may change its rewards, dynamics and terminations.

    PEARL learns it without relabelling. A subclass sets ``observation_space`` and ``action_space`` and writes ``_reset_state``
    and ``_step_state``, which may ask for ``self.task``. The first observation must not tell the task.

    The task of an episode is chosen at its reset. A task once given, by ``set_task`` or by the reset's options, stays over
    later resets until it is changed; an env that was given none draws a random training task at each reset.

    The infos of ``reset`` and ``step`` have ``task_id``: int, index into ``train_tasks``, -1 for a task given as a vector.

    :param task_family: the tasks.
    """

    # Boxes; gymnasium does not know of its own envs, which a subclass may have inside, that theirs are
    observation_space: Any
    action_space: Any

    def __init__(self, task_family: TaskDistribution) -> None:
        self.task_family = task_family
        self._given_task: tuple[int, FloatArray] | None = None
        self._task_of_episode: tuple[int, FloatArray] | None = None
        # The latest one, in float32, in which it is stored and learnt from, whatever the space has
        self._last_observation: FloatArray | None = None

    @abstractmethod
    def _reset_state(self) -> FloatArray:
        """Put the dynamics in a start state, drawn with ``self.np_random``.

        :return: first observation, shape (obs_dim,).
        """

    @abstractmethod
    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        """Move the dynamics by one step.

        :param action: the agent's action, shape (act_dim,), float32, not clipped.
        :return: next observation (obs_dim,), reward, whether the episode terminates.
        """

    def set_task(self, task: ArrayLike | None) -> None:
        """Choose the task of the episodes from the next reset on.

        :param task: an index into ``train_tasks``, a vector of ``task_space``, or None to draw a training task at each reset.
        :raises ValueError: if the id is out of range or the vector is not in the task space.
        """
        if task is None:
            self._given_task = None
        elif np.ndim(task) == 0:
            self._give_task("task_id", task)
        else:
            self._give_task("task", task)

    def _give_task(self, key: str, value: Any) -> None:
        if key == "task_id":
            task_id = int(self.task_family.task_indices(value, ()))
            self._given_task = (task_id, self.train_tasks[task_id])
        else:
            assert self.task_space.shape is not None
            self._given_task = (-1, self.task_family.task_vectors(value, self.task_space.shape))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Start an episode.

        :param seed: seed of the env's generator, None to go on with it.
        :param options: ``{"task_id": i}`` (index into ``train_tasks``) or ``{"task": vector}``; like ``set_task`` before.
        :return: first observation (obs_dim,) and an info with ``task_id``.
        :raises ValueError: if an option is unknown or its task is invalid.
        """
        chosen = task_from_options(options)
        check_seed(seed)
        if chosen is not None:
            self._give_task(*chosen)
        super().reset(seed=seed)  # not before: a reset that is refused changes nothing
        # drawn even if it is not used: a seed then gives the same starts whichever way the task was chosen
        drawn = int(self.np_random.integers(len(self.train_tasks)))
        self._task_of_episode = (drawn, self.train_tasks[drawn]) if self._given_task is None else self._given_task
        return self._remember_observation(self._reset_state()), {"task_id": self.task_id}

    def _remember_observation(self, state: ArrayLike) -> FloatArray:
        if state is None or isinstance(state, tuple) or np.shape(state) != self.observation_space.shape:
            given = f"a {type(state).__name__}" if state is None or isinstance(state, tuple) else f"shape {np.shape(state)}"
            raise ValueError(
                "_reset_state returns an observation; _step_state an observation, a reward and whether the episode "
                f"terminates. Expected an observation of shape {self.observation_space.shape}, got {given}."
            )
        dtype = self.observation_space.dtype
        observation: FloatArray = np.array(state, dtype=dtype)
        if dtype.kind != "f" and not np.array_equal(observation, state):
            raise ValueError(
                f"The observation {np.asarray(state)} would be cut to {dtype}, which the observation space is of: give the "
                "env a Box of float32."
            )
        self._last_observation = observation.astype(np.float32)
        return observation

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Do one step; the time limit is left to the TimeLimit wrapper.

        :param action: the action, shape (act_dim,).
        :return: next observation (obs_dim,), reward, terminated, False, info.
        :raises ValueError: if the action has the wrong shape, or is not finite; or for what ``_step_state`` may not return.
        :raises gymnasium.error.ResetNeeded: before the first reset.
        """
        _, observation, reward, terminated = self._checked_step(action)
        return observation, float(reward), bool(terminated), False, {"task_id": self.task_id}

    def render(self) -> Any:
        """Draw the env, which is for a subclass to write.

        :return: a picture; None without a render mode.
        """
        return None if self.render_mode is None else super().render()

    def _checked_step(self, action: FloatArray) -> tuple[FloatArray, FloatArray, float, bool]:
        """Check the action and move the dynamics.

        :param action: what the agent gave.
        :return: the action as float32, next observation, reward and termination of ``_step_state``.
        """
        if self._last_observation is None:
            raise ResetNeeded("step was called before the first reset: call env.reset() first.")
        action = checked_action(action, self.action_space)
        stepped = self._step_state(action.copy())  # which may be written into; rewards are of what was given
        if not isinstance(stepped, tuple | list) or len(stepped) != 3:
            got = f"{len(stepped)} values" if isinstance(stepped, tuple | list) else f"a {type(stepped).__name__}"
            raise ValueError(
                f"_step_state must return an observation, a reward and whether the episode terminates, got {got}."
            )
        state, reward, terminated = stepped
        if reward is None or np.ndim(reward):
            what = "that is None" if reward is None else f"of shape {np.shape(reward)}"
            raise ValueError(f"_step_state returned a reward {what}, expected a number.")
        if not isinstance(terminated, (bool, np.bool_)):
            raise ValueError(
                f"_step_state returned {terminated!r} for whether the episode terminates, expected True or False: return an "
                "observation, a reward and that, in this order."
            )
        return action, self._remember_observation(state), reward, terminated

    def _current_task(self) -> tuple[int, FloatArray]:
        if self._task_of_episode is None:
            raise ResetNeeded("The env has no task before its first reset: call env.reset() first.")
        return self._task_of_episode

    @property
    def task(self) -> FloatArray:
        """Task of the current episode, shape (task_dim,), a copy."""
        return self._current_task()[1].copy()

    @property
    def task_id(self) -> int:
        """Index of the current episode's task in ``train_tasks``, -1 for a task given as a vector."""
        return self._current_task()[0]
