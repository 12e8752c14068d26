"""The best episode known for each training task, and the search plan made of them."""

import numpy as np

from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer

# Chance that an episode finds a task that it should find. Below 1, the plan comes back to places where it has been.
DETECTION_PROBABILITY = 0.8
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
        traj = buffer.trajectory(episodes[:, None])
        reward = self.task_family.compute_reward(traj, self.task_family.train_tasks) - traj.task_free_reward
        valid = np.arange(episodes.shape[1]) < length[:, None]
        returns = (reward * valid[:, None]).sum(axis=-1)
        best = returns.argmax(axis=0)
        # A little more, because the rewards are a difference of float32
        better = np.flatnonzero(returns.max(axis=0) > self.best_return + 1e-5)
        self.best_return[better] = returns[best[better], better]
        self.length[better] = length[best[better]]
        self.episodes[better] = episodes[best[better]]

    @property
    def solved(self) -> np.ndarray:
        """(n_solved,) int, the training tasks that some episode would have solved."""
        return np.flatnonzero(self.length)

    def search_plan(self, buffer: MultiTaskReplayBuffer, size: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Order training tasks such that visiting them in this order finds an unknown task soon.

        A greedy search under the belief that the unknown task is like one of the solved training tasks: each visit goes where
        most belief is found, and thereafter the belief in what it should have found shrinks.

        :param buffer: names the columns of the episodes
        :param size: largest number of visits
        :return: contexts (n, T, obs_dim + action_dim + 1) of the visited tasks, rows (o, a, r), and their mask (n, T)
        """
        solved = self.solved
        episodes, tasks = self.episodes[solved], self.task_family.train_tasks[solved]
        valid = np.arange(episodes.shape[1]) < self.length[solved, None]
        success = self.task_family.is_success(buffer.trajectory(episodes[:, None]), tasks)
        finds = np.any(success & valid[:, None], axis=-1)
        # Among equals, the task that its own episode solves best: its z is the most certain
        preference = 1e-6 * self.best_return[solved] / self.best_return.max(initial=1e-9)
        # A task that few others resemble stands for more of the task space than one of many alike
        belief = 1 / np.maximum(finds.sum(axis=0), 1)
        order: list[int] = []
        for _ in range(min(size, len(solved))):
            gain = finds @ belief + preference
            gain[order] = -np.inf
            order.append(int(gain.argmax()))
            belief[finds[order[-1]]] *= 1 - DETECTION_PROBABILITY
        context = episodes[order, :, : buffer.context_dim]
        traj = buffer.trajectory(episodes[order])
        context[..., -1] = self.task_family.compute_reward(traj, tasks[order])
        return context, valid[order].astype(np.float32)
