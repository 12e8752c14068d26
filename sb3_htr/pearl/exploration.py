"""Which z to try while a task's reward has not been found yet."""

from enum import Enum

import numpy as np
import torch as th
from torch import nn

from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class Explorer(Enum):
    """How z is drawn in exploration episodes."""

    # z ~ N(0, I), PEARL's plain protocol
    PRIOR = "prior"
    # z ~ Gaussian fitted to the posterior means of meta-training, wider than those
    AGGREGATE = "aggregate"
    # z from the search plan, one after the other
    PLAN = "plan"


class LatentPrior(nn.Module):
    """
    What meta-training knows about z before a task gave any reward. Saved with the policy, not trained by gradient.

    The aggregate posterior (mean and covariance of the posterior means of recent meta-batches) replaces N(0, I), from which
    it differs while the KL term is weak. The search plan is an ordered list of z that visits, one after the other, the
    places where the training tasks are solved: see :class:`TaskBank`.

    :param latent_dim: dimension of z
    :param plan_size: largest number of steps of the search plan
    :param scale: standard deviations of the aggregate are multiplied by this, to reach beyond what was visited so far
    """

    mean: th.Tensor
    cholesky: th.Tensor
    plan: th.Tensor
    plan_length: th.Tensor

    def __init__(self, latent_dim: int, plan_size: int = 32, scale: float = 1.5) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.plan_size = plan_size
        self.scale = scale
        self.register_buffer("mean", th.zeros(latent_dim))
        self.register_buffer("cholesky", th.eye(latent_dim))
        self.register_buffer("plan", th.zeros(plan_size, latent_dim))
        self.register_buffer("plan_length", th.zeros((), dtype=th.int64))

    def fit(self, means: th.Tensor) -> None:
        """
        :param means: (n, latent_dim), posterior means of recent meta-batches
        """
        centred = means - means.mean(dim=0)
        covariance = centred.T @ centred / len(means) + 1e-6 * th.eye(self.latent_dim, device=means.device)
        self.mean.copy_(means.mean(dim=0))
        self.cholesky.copy_(th.linalg.cholesky(covariance))

    def set_plan(self, plan: th.Tensor) -> None:
        """
        :param plan: (n, latent_dim), only the first ``plan_size`` are kept
        """
        plan = plan[: self.plan_size]
        self.plan[: len(plan)] = plan
        self.plan_length.fill_(len(plan))

    def sample(self, explorer: Explorer, attempt: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """
        :param explorer: how to draw
        :param attempt: (n,) int64, number of exploration episodes that each task had before
        :param generator: source of randomness
        :return: (n, latent_dim)
        """
        noise = th.randn(len(attempt), self.latent_dim, generator=generator, device=self.mean.device)
        if explorer is Explorer.PRIOR:
            return noise
        wide = self.mean + self.scale * noise @ self.cholesky.T
        if explorer is Explorer.AGGREGATE or self.plan_length == 0:
            return wide
        return self.plan[attempt % self.plan_length]


class TaskBank:
    """
    For each training task the best episode, of whatever task, that meta-training has collected so far.

    :param task_family: reward hook and training tasks
    """

    def __init__(self, task_family: TaskFamily) -> None:
        self.task_family = task_family
        n_tasks = len(task_family.train_tasks)
        self.best_return = np.zeros(n_tasks, dtype=np.float32)
        self.episodes: list[np.ndarray | None] = [None] * n_tasks

    @property
    def solved(self) -> np.ndarray:
        """(n_tasks,) bool, the training tasks that some episode would have solved."""
        return np.array([episode is not None for episode in self.episodes])

    def update(self, buffer: MultiTaskReplayBuffer, episodes: np.ndarray) -> None:
        """
        :param buffer: names the columns of the episodes
        :param episodes: (n, T, row_dim), new episodes, padded with repetitions of their last step
        """
        traj = buffer.trajectory(episodes[:, None])
        tasks = self.task_family.train_tasks
        reward = self.task_family.compute_reward(traj, tasks, reward_type="sparse") - traj.task_free_reward
        returns = reward.sum(axis=-1)
        best = returns.argmax(axis=0)
        for task in np.flatnonzero(returns.max(axis=0) > self.best_return):
            self.best_return[task] = returns[best[task], task]
            self.episodes[task] = episodes[best[task]]

    def search_plan(self, buffer: MultiTaskReplayBuffer) -> tuple[np.ndarray, np.ndarray]:
        """
        Greedy set cover: the fewest places to visit so that every solved training task would have given its reward.

        :param buffer: names the columns of the episodes
        :return: training tasks in the order of the search (n,), and their best episodes (n, T, row_dim) with the rewards of
            those tasks
        """
        solved = np.flatnonzero(self.solved)
        if len(solved) == 0:
            return solved, np.zeros((0, 0, 0), dtype=np.float32)
        episodes = np.stack([self.episodes[task] for task in solved])  # type: ignore[misc]
        tasks = self.task_family.train_tasks[solved]
        covers = self.task_family.is_success(buffer.trajectory(episodes[:, None]), tasks).any(axis=-1)
        order, left = [], np.ones(len(solved), dtype=bool)
        while left.any():
            # among equals the task that its own episode solves best
            gain = covers[:, left].sum(axis=1) + 1e-3 * self.best_return[solved] / self.best_return.max()
            order.append(int(gain.argmax()))
            left &= ~covers[order[-1]]
        plan = episodes[order].copy()
        traj = buffer.trajectory(plan)
        plan[..., buffer.reward_column] = self.task_family.compute_reward(traj, tasks[order], reward_type="sparse")
        return solved[order], plan
