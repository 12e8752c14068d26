"""The best episode known for each training task."""

from typing import Any

import numpy as np
import torch as th

from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.pearl.context import evenly_spread

# Episodes rewarded under all training tasks at a time, to bound memory
CHUNK = 256


class TaskBank:
    """
    For each training task, the best of all episodes of meta-training, whatever task they were collected on.

    It is hindsight relabelling once more: each new episode is rewarded under every training task.

    :param task_family: reward hook and training tasks
    """

    def __init__(self, task_family: TaskFamily) -> None:
        self.task_family = task_family
        n_tasks = len(task_family.train_tasks)
        # Returns without the task-free part, 0 where no episode solved the task
        self.best_return = np.zeros(n_tasks, dtype=np.float32)
        self.length = np.zeros(n_tasks, dtype=np.int64)
        self.episodes = np.zeros((n_tasks, 0, 0), dtype=np.float32)

    def update(self, buffer: MultiTaskReplayBuffer) -> None:
        """
        :param buffer: the episodes added to it since the last call are rewarded under every training task
        """
        new, lengths = buffer.episodes.take_new()
        for start in range(0, len(new), CHUNK):
            self._update(buffer, new[start : start + CHUNK], lengths[start : start + CHUNK])

    def _update(self, buffer: MultiTaskReplayBuffer, episodes: np.ndarray, length: np.ndarray) -> None:
        if self.episodes.size == 0:
            self.episodes = np.zeros((len(self.length), *episodes.shape[1:]), dtype=np.float32)
        valid = np.arange(episodes.shape[1]) < length[:, None]
        _, returns = self._outcome(buffer, episodes, valid, self.task_family.train_tasks)
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
        """(n_solved,) int, the training tasks that some episode would have solved."""
        return np.flatnonzero(self.length)

    def best_episodes(
        self, buffer: MultiTaskReplayBuffer, size: int, context_size: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """
        What an unknown task may be like: the solved training tasks, each with its best episode.

        :param buffer: names the columns of the episodes
        :param size: largest number of tasks; of more, evenly spread ones are taken
        :param context_size: steps of an episode that become its context, evenly spread, at most
        :return: contexts (n_rows, obs_dim + action_dim + 1), rows (o, a, r) of all episodes; how many are of each (n,); and of
            episode i under task j the return without the task-free part (n, n) and the number of steps before the first
            success (n, n), infinite without one
        """
        solved = self.solved
        solved = solved[np.linspace(0, len(solved) - 1, min(size, len(solved))).round().astype(np.int64)]
        episodes, tasks = self.episodes[solved], self.task_family.train_tasks[solved]
        valid = np.arange(episodes.shape[1]) < self.length[solved, None]
        context = episodes[..., : buffer.context_dim].copy()
        context[..., -1] = self.task_family.compute_reward(buffer.trajectory(episodes), tasks)
        steps, lengths = evenly_spread(self.length[solved], context_size)
        context = context[np.repeat(np.arange(len(solved)), lengths), steps]
        success, returns = self._outcome(buffer, episodes, valid, tasks)
        first_success = np.where(success.any(axis=-1), success.argmax(axis=-1), np.inf)
        return context, lengths, returns, first_success.astype(np.float32)

    def _outcome(
        self, buffer: MultiTaskReplayBuffer, episodes: np.ndarray, valid: np.ndarray, tasks: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Successes (n, m, T) and returns without the task-free part (n, m) of n episodes under m tasks."""
        traj = buffer.trajectory(episodes[:, None])
        success = self.task_family.is_success(traj, tasks) & valid[:, None]
        reward = self.task_family.compute_reward(traj, tasks) - traj.task_free_reward
        # 0 or clearly more: the reward without the task-free part is a difference of float32
        return success, np.where(success, reward, 0.0).sum(axis=-1, dtype=np.float32)
