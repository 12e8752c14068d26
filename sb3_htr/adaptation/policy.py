"""What adaptation asks of networks, whatever they are."""

from typing import Any, Protocol

import numpy as np
import torch as th

from sb3_htr.common.type_aliases import Context
from sb3_htr.htr.relabel.base import AdaptingPolicy


class Encoder(Protocol):
    """
    Maps context to a Gaussian posterior over the task variable z.

    What it has taken in of several tasks is one tensor with a row for each task, so that rows can be picked and replaced.
    """

    def empty(self, n_tasks: int) -> th.Tensor:
        """(n_tasks, ...), nothing taken in yet."""
        ...

    def extend(self, state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        """Take in context rows (n, context_dim), of which ``lengths`` (n_tasks,) are of each task, in the order of time."""
        ...

    def posterior(self, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and variance (n_tasks, latent_dim); those of the prior N(0, I) where nothing was taken in."""
        ...


class ContextualPolicy(AdaptingPolicy, Protocol):
    """Actor, critics, encoder and a model of rewards; :class:`sb3_htr.pearl.policies.PEARLPolicy` is one."""

    obs_dim: int
    action_dim: int
    latent_dim: int
    reward_model: Any

    @property
    def encoder(self) -> Encoder:
        """Infers z."""
        ...

    def extend_posterior(self, state: th.Tensor, context: Context) -> th.Tensor:
        """What the encoder's ``extend`` does, for transitions as they were collected."""
        ...

    def normalize(self, obs: th.Tensor) -> th.Tensor:
        """Observations as all networks see them."""
        ...

    def act(self, obs: np.ndarray, z: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """Actions (n, action_dim), scaled to [-1, 1], for observations (n, obs_dim) and task variables (n, latent_dim)."""
        ...
