"""Tasks that meta-training has solved, each with the best episode known for it."""

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_htr.common.checks import tells_rewards
from sb3_htr.common.random_state import get_generator_state, set_generator_state, stream
from sb3_htr.common.task_reward import ROUNDING
from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.htr.groups import evenly_spread
from sb3_htr.htr.transitions import Transitions

# Training tasks that are in the bank; of more, evenly spread ones. The cost of an episode is flat from there on
MAX_TRAIN_TASKS = 128
# Hindsight tasks, and how many of a full bank are newcomers, of which nobody has said yet how likely they are
MAX_HINDSIGHT_TASKS, MAX_NEWCOMERS = 256, 32
# Steps of each new episode that may become hindsight tasks
N_CANDIDATES = 8
# Episodes rewarded under all tasks at a time, and steps of them, to bound memory
CHUNK, CHUNK_STEPS = 128, 12_800
# What is saved
ARRAYS = ("tasks", "best_return", "length", "likelihood", "episodes")


class SolvedTasks(NamedTuple):
    """
    The n tasks of a bank that some episode has solved.

    :param rows: (n_rows, width) transitions, those of the first task first, with the rewards of their task
    :param lengths: (n,) int64, how many of them are of each task
    :param success: (n_rows,) bool, whether each solves its task
    :param returns: (n,) returns of the whole episodes, without the task-free part
    :param is_train: (n,) bool, training tasks; the others are hindsight tasks
    """

    rows: np.ndarray
    lengths: np.ndarray
    success: np.ndarray
    returns: np.ndarray
    is_train: np.ndarray


class TaskBank:
    """
    Training tasks, and hindsight tasks packed evenly over what was reached, each with the best of all episodes of
    meta-training, whatever task they were collected on.

    It is hindsight relabelling once more: each new episode is rewarded under all these tasks. A state that solves none of the
    hindsight tasks becomes one, so that they are as far apart as a task reaches, whatever tasks are; where more was reached
    than it has room for, it keeps those that resemble training tasks most. What it keeps of an episode is what its context
    would be. Where the family tells no successes, the bank stays empty.

    :param task_family: reward hook and training tasks
    :param transitions: columns of an episode's rows
    :param context_size: steps of an episode that are kept, evenly spread, at most
    :param seed: of the choice of candidates
    """

    def __init__(self, task_family: TaskFamily, transitions: Transitions, context_size: int, seed: int | None = None) -> None:
        self.task_family = task_family
        self.transitions = transitions
        self.context_size = context_size
        train = task_family.train_tasks.astype(np.float32)
        self.n_train = min(len(train), MAX_TRAIN_TASKS)
        self.tasks = train[np.linspace(0, len(train) - 1, self.n_train).round().astype(int)]
        # Returns without the task-free part, 0 where no episode solved the task
        self.best_return = np.zeros(self.n_train, dtype=np.float32)
        self.length = np.zeros(self.n_train, dtype=np.int64)
        self.episodes = np.zeros((self.n_train, context_size, transitions.width), dtype=np.float32)
        # How likely an unknown task is to be like each hindsight task, infinite for newcomers
        self.likelihood = np.zeros(0)
        self.seed(seed)
        #: Training tasks and transitions of the episodes since the last :meth:`update`
        self.new: list[tuple[int, np.ndarray]] = []

    def seed(self, seed: int | None) -> None:
        """
        :param seed: of the choice of candidates
        """
        self._rng = stream(seed, "bank")

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        """
        :param task: index of the training task that it was collected on
        :param episode: (length, width) float32, taken in at the next :meth:`update`
        """
        self.new.append((task, episode.copy()))

    def update(self) -> None:
        """Take in the new episodes."""
        new, self.new = [episode for _, episode in self.new], []
        if not tells_rewards(self.task_family):
            return
        size = max(min(CHUNK, CHUNK_STEPS // max(map(len, new), default=1)), 1)
        for start in range(0, len(new), size):
            chunk = new[start : start + size]
            length = np.array([len(episode) for episode in chunk])
            episodes = np.stack([np.pad(episode, ((0, length.max() - len(episode)), (0, 0))) for episode in chunk])
            self._pack(episodes, length)
            self._reward(episodes, length)

    def _pack(self, episodes: np.ndarray, length: np.ndarray) -> None:
        """Candidates that solve no hindsight task become hindsight tasks."""
        episode = np.repeat(np.arange(len(episodes)), N_CANDIDATES)
        step = (self._rng.random(len(episode)) * length[episode]).astype(np.int64)
        rows = episodes[episode, step][:, None, None]
        solved = self.task_family.is_success(self.transitions.trajectory(rows), self.tasks[self.n_train :])
        traj = self.transitions.trajectory(rows[~solved.any(axis=(1, 2))])
        candidates = self.task_family.hindsight_task(traj, 0)[:, 0]
        alike = self.task_family.is_success(traj, candidates)[..., 0]
        chosen: list[int] = []
        for i in range(len(candidates)):
            if not alike[i, chosen].any():
                chosen.append(i)
        n_free = MAX_HINDSIGHT_TASKS - (len(self.tasks) - self.n_train)
        self._append(candidates[chosen[:n_free]])
        n_newcomers = int(np.isinf(self.likelihood).sum())
        others = chosen[n_free : n_free + max(MAX_NEWCOMERS - n_newcomers, 0)]
        least = self.likelihood.argsort(kind="stable")[: len(others)]
        self.likelihood[least], at = np.inf, self.n_train + least
        self.tasks[at], self.best_return[at], self.length[at] = candidates[others], 0, 0

    def _append(self, tasks: np.ndarray) -> None:
        n = len(tasks)
        self.tasks = np.concatenate([self.tasks, tasks])
        self.best_return = np.append(self.best_return, np.zeros(n, dtype=np.float32))
        self.length = np.append(self.length, np.zeros(n, dtype=np.int64))
        self.likelihood = np.append(self.likelihood, np.full(n, np.inf))
        self.episodes = np.concatenate([self.episodes, np.zeros((n, *self.episodes.shape[1:]), dtype=np.float32)])

    def _reward(self, episodes: np.ndarray, length: np.ndarray) -> None:
        """Keep the episodes that are better than those known."""
        traj = self.transitions.trajectory(episodes[:, None])
        success = self.task_family.is_success(traj, self.tasks) & (np.arange(episodes.shape[1]) < length[:, None])[:, None]
        reward = self.task_family.compute_reward(traj, self.tasks) - traj.task_free_reward
        # 0 or clearly more: the reward without the task-free part is a difference of float32
        gains = np.where(success, reward, 0.0)
        returns = gains.sum(axis=-1, dtype=np.float32)
        best = returns.argmax(axis=0)
        better = np.flatnonzero(returns.max(axis=0) > self.best_return + ROUNDING)
        self.best_return[better] = returns[best[better], better]
        of_best = gains[best[better], better][np.arange(episodes.shape[1]) < length[best[better], None]]
        steps, taken = evenly_spread(length[best[better]], self.context_size, of_best)
        self.length[better] = taken
        kept = np.arange(self.context_size) < taken[:, None]
        within = self.episodes[better]
        within[kept] = episodes[np.repeat(best[better], taken), steps]
        self.episodes[better] = within

    def state_dict(self) -> dict[str, Any]:
        """
        :return: tasks and episodes, for :meth:`load_state_dict`
        """
        arrays = {name: th.tensor(getattr(self, name)) for name in ARRAYS}
        new = [[task, th.tensor(episode)] for task, episode in self.new]
        return {**arrays, "new": new, "random": get_generator_state(self._rng)}

    def check(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`
        :raises ValueError: if another version of the package saved it, or a model with another ``context_size``
        """
        missing = [name for name in (*ARRAYS, "new") if name not in state]
        if missing:
            raise ValueError(f"What was saved of the task bank has no {missing[0]}: load it with the version that saved it.")
        _, kept, width = state["episodes"].shape
        if (kept, width) != self.episodes.shape[1:]:
            raise ValueError(
                f"What was saved of the task bank has {kept} steps of {width} numbers from each episode, and this model has "
                f"{self.episodes.shape[1]} of {self.episodes.shape[2]}: make it with the context_size and env of that one."
            )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`
        :raises ValueError: as :meth:`check`
        """
        self.check(state)
        for name in ARRAYS:
            setattr(self, name, state[name].cpu().numpy().copy())
        self.new = [(task, episode.cpu().numpy().copy()) for task, episode in state["new"]]
        set_generator_state(self._rng, state["random"])

    def rank(self, likelihood: np.ndarray) -> None:
        """
        Say which hindsight tasks make room for others: first those that nothing solves, then the least likely.

        :param likelihood: (n_solved,) finite, how likely an unknown task is to be like each of the solved ones
        """
        of_all = np.full(len(self.tasks), np.finfo(np.float64).min)
        of_all[self.length > 0] = likelihood
        self.likelihood = of_all[self.n_train :]

    @property
    def n_solved(self) -> int:
        """Number of tasks that some episode would have solved."""
        return int((self.length > 0).sum())

    @property
    def n_train_solved(self) -> int:
        """Number of training tasks that some episode would have solved."""
        return int((self.length[: self.n_train] > 0).sum())

    def solved(self) -> SolvedTasks:
        """
        :return: the tasks that some episode would have solved
        """
        chosen = np.flatnonzero(self.length)
        lengths = self.length[chosen]
        rows = self.episodes[chosen][np.arange(self.context_size) < lengths[:, None]]
        tasks = np.repeat(self.tasks[chosen], lengths, axis=0)
        traj = self.transitions.trajectory(rows[:, None])
        rows[:, self.transitions.reward] = self.task_family.compute_reward(traj, tasks)[:, 0]
        success = self.task_family.is_success(traj, tasks)[:, 0]
        return SolvedTasks(rows, lengths, success, self.best_return[chosen], chosen < self.n_train)
