"""The contract of a task family, and the single environment built on it.

A *task* is a float vector (a goal position, a target speed). A :class:`TaskFamily` knows the tasks and the rewards, a
:class:`TaskEnv` knows the dynamics. The two are apart because a replay buffer needs the rewards of any experience under any
task, long after the environment has moved on: the family is a small object that it can pickle and call without an env.
``htr_envs.check_task_env`` tests every promise made here.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from htr_envs.meta_env import FloatArray as FloatArray
from htr_envs.meta_env import HasTaskFamily, MetaEnv, TaskDistribution

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


def l2_distance(positions: FloatArray, others: FloatArray) -> FloatArray:
    """Euclidean distance between positions, the same bits for any batch shape.

    :param positions: shape (..., dim).
    :param others: shape (..., dim); leading axes broadcast.
    :return: shape (...), float32.
    :raises ValueError: if they have not as many numbers.
    """
    if others.shape[-1] != positions.shape[-1]:
        n = positions.shape[-1]
        raise ValueError(f"Positions of {n} numbers have no distance from others of shape {others.shape}: pass (..., {n}).")
    # column by column, which is three times as fast; not np.linalg.norm: its sum may be ordered by memory layout
    first, *rest = (np.square(positions[..., i] - others[..., i]) for i in range(others.shape[-1]))
    result: FloatArray = np.sqrt(sum(rest, first), dtype=np.float32)
    return result


class TaskFamily(TaskDistribution):
    """A distribution of tasks with their rewards: small, picklable, stateless.

    All methods are pure and vectorized: they change neither their arguments nor the family, and leading axes of the
    trajectory and of the task broadcast against each other.

    :param task_space: the box that every task lies in, hindsight tasks included, shape (task_dim,).
    :param train_tasks: tasks to meta-train on, shape (n, task_dim).
    :param validation_tasks: tasks to choose hyper-parameters and checkpoints on, shape (n, task_dim).
    :param test_tasks: tasks to report results on, shape (n, task_dim).
    :raises ValueError: if an array has the wrong shape, leaves ``task_space``, or shares a task with another.
    """

    @abstractmethod
    def compute_reward(self, traj: Trajectory, task: NDArray[Any], reward_type: str = "sparse") -> FloatArray:
        """Reward of every step under a task, the task-free part included.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param task: the task, shape (..., task_dim); its leading axes broadcast with those of ``traj``.
        :param reward_type: ``"sparse"`` is the true reward; its task part is positive where a step is a success and 0 where
            it is none, so that nothing about the task leaks. ``"dense"`` is the proxy reward of the oracle baseline.
        :return: rewards, shape (..., T), float32.
        :raises ValueError: if the reward type is unknown.
        """

    @abstractmethod
    def is_success(self, traj: Trajectory, task: NDArray[Any]) -> BoolArray:
        """Whether every step solves a task.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param task: the task, shape (..., task_dim); its leading axes broadcast with those of ``traj``.
        :return: successes, shape (..., T).
        """

    @abstractmethod
    def hindsight_task(self, traj: Trajectory, index: Any) -> FloatArray:
        """The task that the next state of one step solves.

        :param traj: the steps, arrays of shape (..., T, dim).
        :param index: which step, an int or an int array that broadcasts with the leading axes of ``traj``.
        :return: tasks in ``task_space``, shape (..., task_dim), float32, sharing no memory with ``traj``.
        """


def ask_hook(hook: Callable[..., Any], name: str, expected: tuple[int, ...], traj: Trajectory, *args: Any) -> Any:
    """What a reward hook returns for trajectories of one step.

    :param hook: of the task family.
    :param name: of the hook.
    :param expected: shape of what it should return.
    :param traj: read-only, as the next hook is told of the same.
    :param args: what else the hook is given.
    :return: what it returned.
    :raises ValueError: if that has another shape, of which rewards or tasks would go wrong later, far from the hook, or if it
        writes into what it is given.
    """
    try:
        values = hook(traj, *args)
    except ValueError as error:
        if "read-only" not in str(error):
            raise
        raise ValueError(
            f"{name} of the task family writes into the trajectory or task that it is given: let it make new arrays."
        ) from error
    if not isinstance(values, np.ndarray | np.generic) or values.shape != expected:
        what = f"shape {values.shape}" if isinstance(values, np.ndarray | np.generic) else f"a {type(values).__name__}"
        kind = "one task for each trajectory" if name == "hindsight_task" else "one value for each step"
        raise ValueError(
            f"{name} of the task family returned {what} for trajectories of one step, expected an array of shape "
            f"{expected}: {kind}."
        )
    return values


def read_only(*arrays: NDArray[Any]) -> None:
    """Have hooks compute new arrays.

    :param arrays: which nobody is to write into.
    """
    for array in arrays:
        array.setflags(write=False)


class HasRewardHooks(HasTaskFamily):
    """An env's rewards are those of its family."""

    task_family: TaskFamily
    reward_type: str

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str | None = None) -> FloatArray:
        """:meth:`TaskFamily.compute_reward`, by default of the env's own reward type.

        :raises ValueError: if the task has not as many numbers as those of the task space, or the reward type is unknown.
        """
        tasks, of_env = np.asarray(task, dtype=np.float32), self.reward_type
        expected = self.task_family.train_tasks.shape[1:]
        if tasks.shape[-1:] != expected:
            raise ValueError(f"The task has shape {tasks.shape}, expected (..., {expected[0]}): pass tasks of the task space.")
        return self.task_family.compute_reward(traj, tasks, of_env if reward_type is None else reward_type)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        """:meth:`TaskFamily.hindsight_task`."""
        return self.task_family.hindsight_task(traj, np.asarray(index))


class TaskEnv(HasRewardHooks, MetaEnv):
    """An environment whose reward depends on a task that the observation never shows.

    A subclass sets ``observation_space`` and ``action_space`` and writes the dynamics in ``_reset_state`` and ``_step_state``;
    tasks, rewards and infos are done here. The dynamics, terminations included, must not depend on the task.

    Tasks are chosen as in :class:`MetaEnv`. The info of ``reset`` has ``task_id``. The info of ``step`` has

    - ``task_id``: int, index into ``train_tasks``, -1 for a task given as a vector;
    - ``is_success``: bool, whether this step solves the task;
    - ``achieved_task``: array (task_dim,), the task that the next state solves;
    - ``task_free_reward``: float, the part of the reward that depends on no task.

    :param task_family: tasks and rewards.
    :param reward_type: reward of ``step``, ``"sparse"`` (the true one) or ``"dense"`` (the proxy).
    :raises ValueError: if the reward type is unknown.
    """

    def __init__(self, task_family: TaskFamily, reward_type: str = "sparse") -> None:
        check_reward_type(reward_type)
        super().__init__(task_family)
        self.reward_type = reward_type

    @abstractmethod
    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        """Move the dynamics by one step.

        :param action: the agent's action, shape (act_dim,), float32, not clipped.
        :return: next observation (obs_dim,), task-free reward, whether the episode terminates.
        """

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Do one step; the time limit is left to the TimeLimit wrapper.

        :param action: the action, shape (act_dim,).
        :return: next observation (obs_dim,), reward, terminated, False, info.
        :raises ValueError: if the action has the wrong shape, or is not finite; or for what ``_step_state`` may not return.
        :raises gymnasium.error.ResetNeeded: before the first reset.
        """
        before = self._last_observation
        action, observation, task_free_reward, terminated = self._checked_step(action)
        after = self._last_observation
        assert before is not None and after is not None
        # one reward function for step and for relabelling: compute_reward gives step's rewards again, bit for bit
        traj = Trajectory(before[None], action[None], after[None], np.array([task_free_reward], np.float32))
        task = self.task
        read_only(*traj, task)
        reward = ask_hook(self.compute_reward, "compute_reward", (1,), traj, task)
        info = {
            "task_id": self.task_id,
            "is_success": bool(ask_hook(self.task_family.is_success, "is_success", (1,), traj, task)[0]),
            "achieved_task": ask_hook(self.hindsight_task, "hindsight_task", task.shape, traj, 0),
            "task_free_reward": float(traj.task_free_reward[0]),
        }
        return observation, float(reward[0]), bool(terminated), False, info
