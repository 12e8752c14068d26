"""Which z to try while nothing is known about a task."""

from enum import Enum

import torch as th
from torch import nn

from sb3_htr.pearl.task_belief import KnownTasks


class Explorer(Enum):
    """
    How an adaptation draws z before it uses the posterior, and when it starts to use it.
    """

    #: z ~ N(0, I) for a fixed number of episodes, then the posterior over all episodes: the protocol of PEARL
    PRIOR = "prior"
    #: z ~ a Gaussian around what was visited so far, until an episode is rewarded, then the posterior over the best episode
    AGGREGATE = "aggregate"
    #: z of the training task that the unknown one is most likely to be found with, given the misses so far, until an episode
    #: is rewarded; then by turns z of the training task that promises most, and the posterior over the best episode
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
    covariance of the posterior means of recent meta-batches, and the *known tasks*: z of solved training tasks, and what
    acting with each of them leads to under each other (:class:`sb3_htr.pearl.task_belief.KnownTasks`).

    :param latent_dim: dimension of z
    :param max_known_tasks: largest number of known tasks
    :param aggregate_scale: standard deviations of the aggregate are multiplied by this, so that exploration reaches beyond
        what was visited so far. 1.5 by measurement: at 1.0 the search of the Point Robot stops growing early
    """

    mean: th.Tensor
    cholesky: th.Tensor
    known_z: th.Tensor
    known_returns: th.Tensor
    known_first_success: th.Tensor
    n_known_tasks: th.Tensor

    def __init__(self, latent_dim: int, max_known_tasks: int = 128, aggregate_scale: float = 1.5) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.aggregate_scale = aggregate_scale
        self.register_buffer("mean", th.zeros(latent_dim))
        self.register_buffer("cholesky", th.eye(latent_dim))
        self.register_buffer("known_z", th.zeros(max_known_tasks, latent_dim))
        self.register_buffer("known_returns", th.zeros(max_known_tasks, max_known_tasks))
        self.register_buffer("known_first_success", th.zeros(max_known_tasks, max_known_tasks))
        self.register_buffer("n_known_tasks", th.zeros((), dtype=th.int64))

    @property
    def max_known_tasks(self) -> int:
        """Largest number of known tasks."""
        return len(self.known_z)

    def set_aggregate(self, means: th.Tensor) -> None:
        """
        :param means: (n, latent_dim), posterior means of recent meta-batches
        """
        self.mean.copy_(means.mean(dim=0))
        centred = means - self.mean
        jitter = 1e-6 * th.eye(self.latent_dim, device=means.device)
        self.cholesky.copy_(th.linalg.cholesky(centred.T @ centred / len(means) + jitter))

    def set_known_tasks(self, known: KnownTasks) -> None:
        """
        :param known: at most ``max_known_tasks`` tasks
        """
        n = len(known.z)
        self.known_z[:n] = th.as_tensor(known.z)
        self.known_returns[:n, :n] = th.as_tensor(known.returns)
        self.known_first_success[:n, :n] = th.as_tensor(known.first_success)
        self.n_known_tasks.fill_(n)

    def known_tasks(self) -> KnownTasks:
        """
        :return: the known tasks
        """
        n = int(self.n_known_tasks)
        arrays = (self.known_z[:n], self.known_returns[:n, :n], self.known_first_success[:n, :n])
        return KnownTasks(*(array.cpu().numpy() for array in arrays))

    def sample(self, explorer: Explorer, n: int, generator: th.Generator | None = None) -> th.Tensor:
        """
        :param explorer: PRIOR draws from N(0, I), the others from the aggregate
        :param n: number of draws
        :param generator: source of randomness
        :return: (n, latent_dim)
        """
        noise = th.randn(n, self.latent_dim, generator=generator).to(self.mean.device)
        if explorer is Explorer.PRIOR:
            return noise
        return self.mean + self.aggregate_scale * noise @ self.cholesky.T
