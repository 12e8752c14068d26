"""What meta-training knows about z before a task gave any reward."""

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_htr.adaptation.policy import ContextualPolicy
from sb3_htr.adaptation.task_bank import TaskBank


class KnownTasks(NamedTuple):
    """
    What meta-training knows about n tasks and the episodes that solve them best.

    :param z: (n, latent_dim), z of each task
    :param returns: (n, n), ``returns[i, j]``: return of the episode of task i if task j is the true one, without the
        task-free part, 0 where it does not find it
    :param first_success: (n, n), number of steps before episode i finds task j, infinite where it does not
    """

    z: np.ndarray
    returns: np.ndarray
    first_success: np.ndarray


class LatentKnowledge(nn.Module):
    """
    What explorers start from; saved with the model, not trained by gradients.

    While the KL term is weak, posterior means are far from N(0, I). Two things are kept instead: the *aggregate*, mean and
    covariance of the posterior means of recent meta-batches, and the *known tasks*: z of solved training tasks, and what
    acting with each of them leads to under each other (:class:`KnownTasks`).

    :param latent_dim: dimension of z
    :param max_known_tasks: largest number of known tasks
    """

    mean: th.Tensor
    cholesky: th.Tensor
    known_z: th.Tensor
    known_returns: th.Tensor
    known_first_success: th.Tensor
    n_known_tasks: th.Tensor

    def __init__(self, latent_dim: int, max_known_tasks: int) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.register_buffer("mean", th.zeros(latent_dim))
        self.register_buffer("cholesky", th.eye(latent_dim))
        self.register_buffer("known_z", th.zeros(max_known_tasks, latent_dim))
        self.register_buffer("known_returns", th.zeros(max_known_tasks, max_known_tasks))
        self.register_buffer("known_first_success", th.zeros(max_known_tasks, max_known_tasks))
        self.register_buffer("n_known_tasks", th.zeros((), dtype=th.int64))

    def learn(self, policy: ContextualPolicy, means: th.Tensor, bank: TaskBank, context_size: int) -> None:
        """
        :param policy: networks as they are now
        :param means: (n, latent_dim), posterior means of recent meta-batches
        :param bank: the best episode of each training task
        :param context_size: steps of an episode that become its context, at most
        """
        self.set_aggregate(means)
        # A loaded model's known tasks are kept until this training knows as many
        if len(bank.solved) >= max(int(self.n_known_tasks), 1):
            context, returns, first_success = bank.best_episodes(context_size, policy.device)
            with th.no_grad():
                state = policy.extend_posterior(policy.encoder.empty(len(returns)), context)
                z, _ = policy.encoder.posterior(state)
            self.set_known_tasks(KnownTasks(z.cpu().numpy(), returns, first_success))

    def set_aggregate(self, means: th.Tensor) -> None:
        """
        :param means: (n, latent_dim), posterior means of recent meta-batches
        """
        self.mean.copy_(means.mean(dim=0))
        centred = (means - self.mean).double()
        covariance = centred.T @ centred / len(means)
        # However large the means are, and if they are all the same
        jitter = (1e-6 + 1e-9 * covariance.trace()) * th.eye(self.latent_dim, dtype=th.float64, device=means.device)
        self.cholesky.copy_(th.linalg.cholesky(covariance + jitter))

    def sample_aggregate(self, n: int, scale: float, generator: th.Generator | None = None) -> np.ndarray:
        """
        :param n: number of draws
        :param scale: standard deviations of the aggregate are multiplied by this
        :param generator: source of randomness
        :return: (n, latent_dim)
        """
        noise = th.randn(n, self.latent_dim, generator=generator).to(self.mean.device)
        return np.asarray((self.mean + scale * noise @ self.cholesky.T).cpu().numpy())

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
