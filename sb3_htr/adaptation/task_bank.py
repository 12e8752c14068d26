"""The best episode known for each training task."""

from typing import Any

import numpy as np
import torch as th

from sb3_htr.adaptation.context import evenly_spread
from sb3_htr.common.type_aliases import Context, TaskFamily
from sb3_htr.htr.transitions import Transitions

# Training tasks that episodes are kept for; of more, evenly spread ones. The cost of an episode is flat from there on
MAX_TASKS = 128
# Episodes rewarded under all tasks at a time, to bound memory
CHUNK = 256


class TaskBank:
    """
    For each training task, the best of all episodes of meta-training, whatever task they were collected on.

    It is hindsight relabelling once more: each new episode is rewarded under the training tasks.

    :param task_family: reward hook and training tasks
    :param transitions: columns of an episode's rows
    """

    def __init__(self, task_family: TaskFamily, transitions: Transitions) -> None:
        self.task_family = task_family
        self.transitions = transitions
        n_tasks = min(len(task_family.train_tasks), MAX_TASKS)
        self.tasks = task_family.train_tasks[np.linspace(0, len(task_family.train_tasks) - 1, n_tasks).round().astype(int)]
        # Returns without the task-free part, 0 where no episode solved the task
        self.best_return = np.zeros(n_tasks, dtype=np.float32)
        self.length = np.zeros(n_tasks, dtype=np.int64)
        self.episodes = np.zeros((n_tasks, 0, transitions.width), dtype=np.float32)
        #: Training tasks and transitions of the episodes since the last :meth:`update`
        self.new: list[tuple[int, np.ndarray]] = []

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        """
        :param task: index of the training task that it was collected on
        :param episode: (length, width) float32, taken in at the next :meth:`update`
        """
        self.new.append((task, episode.copy()))

    def update(self) -> None:
        """Reward the new episodes under all tasks."""
        new, self.new = [episode for _, episode in self.new], []
        for start in range(0, len(new), CHUNK):
            self._update(new[start : start + CHUNK])

    def _update(self, new: list[np.ndarray]) -> None:
        length = np.array([len(episode) for episode in new])
        longest = max(int(length.max()), self.episodes.shape[1])
        episodes = np.stack([_padded(episode, longest) for episode in new])
        if longest > self.episodes.shape[1]:
            self.episodes = np.stack([_padded(episode, longest) for episode in self.episodes])
        valid = np.arange(longest) < length[:, None]
        _, returns = self._outcome(episodes, valid, self.tasks)
        best = returns.argmax(axis=0)
        # A little more, because of rounding
        better = np.flatnonzero(returns.max(axis=0) > self.best_return + 1e-5)
        self.best_return[better] = returns[best[better], better]
        self.length[better] = length[best[better]]
        self.episodes[better] = episodes[best[better]]

    def state_dict(self) -> dict[str, Any]:
        """
        :return: the best episodes, for :meth:`load_state_dict`
        """
        arrays = {"best_return": self.best_return, "length": self.length, "episodes": self.episodes}
        return {name: th.tensor(array) for name, array in arrays.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`
        """
        self.best_return, self.length, self.episodes = (
            state[name].cpu().numpy().copy() for name in ("best_return", "length", "episodes")
        )

    @property
    def solved(self) -> np.ndarray:
        """(n_solved,) int, the tasks that some episode would have solved."""
        return np.flatnonzero(self.length)

    def best_episodes(self, context_size: int, device: th.device) -> tuple[Context, np.ndarray, np.ndarray]:
        """
        What an unknown task may be like: the n solved tasks, each with its best episode.

        :param context_size: steps of an episode that become its context, evenly spread, at most
        :param device: where the contexts are put
        :return: contexts of the tasks; and of episode i under task j the return without the task-free part (n, n) and the
            number of steps before the first success (n, n), infinite without one
        """
        solved, columns = self.solved, self.transitions
        episodes, tasks = self.episodes[solved], self.tasks[solved]
        valid = np.arange(episodes.shape[1]) < self.length[solved, None]
        rewards = self.task_family.compute_reward(columns.trajectory(episodes), tasks)
        steps, lengths = evenly_spread(self.length[solved], context_size)
        at = np.repeat(np.arange(len(solved)), lengths), steps
        arrays = (episodes[at][:, columns.observation], episodes[at][:, columns.action], rewards[at], lengths)
        success, returns = self._outcome(episodes, valid, tasks)
        first_success = np.where(success.any(axis=-1), success.argmax(axis=-1), np.inf)
        return Context(*(th.as_tensor(array, device=device) for array in arrays)), returns, first_success.astype(np.float32)

    def _outcome(self, episodes: np.ndarray, valid: np.ndarray, tasks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Successes (n, m, T) and returns without the task-free part (n, m) of n episodes under m tasks."""
        traj = self.transitions.trajectory(episodes[:, None])
        success = self.task_family.is_success(traj, tasks) & valid[:, None]
        reward = self.task_family.compute_reward(traj, tasks) - traj.task_free_reward
        # 0 or clearly more: the reward without the task-free part is a difference of float32
        return success, np.where(success, reward, 0.0).sum(axis=-1, dtype=np.float32)


def _padded(episode: np.ndarray, length: int) -> np.ndarray:
    return np.pad(episode, ((0, length - len(episode)), (0, 0)))
