"""Which z to try while nothing is known about a task."""

from enum import Enum

import torch as th
from torch import nn


class Explorer(Enum):
    """
    How an adaptation draws z before it uses the posterior, and when it starts to use it.
    """

    #: z ~ N(0, I) for a fixed number of episodes, then the posterior over all episodes: the protocol of PEARL
    PRIOR = "prior"
    #: z ~ a Gaussian around what was visited so far, until an episode is rewarded, then the posterior over the best episode
    AGGREGATE = "aggregate"
    #: z from the search plan, in its order, until an episode is rewarded, then the posterior over the best episode
    SEARCH = "search"


def to_explorer(explorer: Explorer | str) -> Explorer:
    """
    :param explorer: a member of :class:`Explorer` or its name
    :return: the member
    :raises ValueError: for an unknown name
    """
    try:
        return Explorer(explorer)
    except ValueError:
        raise ValueError(f"explorer is {explorer!r}, expected one of {[e.value for e in Explorer]}.") from None


class LatentPrior(nn.Module):
    """
    What meta-training knows about z before a task gave any reward; saved with the policy, not trained by gradients.

    While the KL term is weak, posterior means are far from N(0, I). Two things are kept instead: the *aggregate*, mean and
    covariance of the posterior means of recent meta-batches, and the *search plan*, a list of z that solve training tasks,
    ordered such that few episodes visit the places of many tasks (:class:`sb3_htr.pearl.task_bank.TaskBank`).

    :param latent_dim: dimension of z
    :param plan_size: largest length of the search plan
    :param aggregate_scale: standard deviations of the aggregate are multiplied by this, so that exploration reaches beyond
        what was visited so far. 1.5 by measurement: at 1.0 the search of the Point Robot stops growing early
    """

    mean: th.Tensor
    cholesky: th.Tensor
    plan: th.Tensor
    plan_length: th.Tensor
    plan_n_tasks: th.Tensor

    def __init__(self, latent_dim: int, plan_size: int = 32, aggregate_scale: float = 1.5) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.aggregate_scale = aggregate_scale
        self.register_buffer("mean", th.zeros(latent_dim))
        self.register_buffer("cholesky", th.eye(latent_dim))
        self.register_buffer("plan", th.zeros(plan_size, latent_dim))
        self.register_buffer("plan_length", th.zeros((), dtype=th.int64))
        self.register_buffer("plan_n_tasks", th.zeros((), dtype=th.int64))

    @property
    def plan_size(self) -> int:
        """Largest length of the search plan."""
        return len(self.plan)

    def set_aggregate(self, means: th.Tensor) -> None:
        """
        :param means: (n, latent_dim), posterior means of recent meta-batches
        """
        self.mean.copy_(means.mean(dim=0))
        centred = means - self.mean
        jitter = 1e-6 * th.eye(self.latent_dim, device=means.device)
        self.cholesky.copy_(th.linalg.cholesky(centred.T @ centred / len(means) + jitter))

    def set_plan(self, plan: th.Tensor, n_tasks: int) -> None:
        """
        :param plan: (n, latent_dim), n at most ``plan_size``
        :param n_tasks: number of training tasks that it covers
        """
        self.plan[: len(plan)] = plan
        self.plan_length.fill_(len(plan))
        self.plan_n_tasks.fill_(n_tasks)

    def sample(self, explorer: Explorer, attempt: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """
        :param explorer: how to draw; without a plan, SEARCH draws as AGGREGATE
        :param attempt: (n,) int64, number of exploration episodes that were made before
        :param generator: source of randomness
        :return: (n, latent_dim)
        """
        device = self.mean.device
        noise = th.randn(len(attempt), self.latent_dim, generator=generator).to(device)
        if explorer is Explorer.PRIOR:
            return noise
        if explorer is Explorer.SEARCH and self.plan_length > 0:
            return self.plan[attempt.to(device) % self.plan_length]
        return self.mean + self.aggregate_scale * noise @ self.cholesky.T
