"""Probabilistic context encoder: q(z | c) as a product of independent Gaussian factors (PEARL, section 4)."""

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_htr.common.linear import with_fast_linear

# Smallest variance of a factor, as in PEARL's reference implementation
MIN_VARIANCE = 1e-7


def product_of_gaussians(mean: th.Tensor, variance: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Products of Gaussian factors, of several groups at once.

    :param mean: (n, latent_dim), those of the first group first
    :param variance: (n, latent_dim), positive
    :param lengths: (M,) int64, number of factors of each group
    :return: mean and variance (M, latent_dim); those of N(0, 1) where a group has no factors
    """
    precision = 1.0 / variance
    total = _sum_groups(precision, lengths)
    empty = total == 0
    posterior_variance = 1.0 / total.masked_fill(empty, 1.0)
    return posterior_variance * _sum_groups(precision * mean, lengths), posterior_variance


def _sum_groups(values: th.Tensor, lengths: th.Tensor) -> th.Tensor:
    return th.segment_reduce(values, "sum", lengths=lengths, axis=0, unsafe=True)


def kl_to_prior(mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """
    :param mean: (..., latent_dim)
    :param variance: (..., latent_dim)
    :return: (...,), KL divergence of N(mean, variance) from the prior N(0, I), in nats
    """
    return 0.5 * (variance + mean.square() - 1.0 - variance.log()).sum(dim=-1)


class ContextEncoder(nn.Module):
    """
    Maps a set of transitions (o, a, r) to a Gaussian posterior over the task variable z, whatever their order.

    :param context_dim: length of a context row, obs_dim + action_dim + 1
    :param latent_dim: dimension of z
    :param net_arch: hidden units per layer
    :param activation_fn: activation between layers
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self, context_dim: int, latent_dim: int, net_arch: list[int], activation_fn: type[nn.Module] = nn.ReLU
    ) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.factors = with_fast_linear(nn.Sequential(*create_mlp(context_dim, 2 * latent_dim, net_arch, activation_fn)))

    def forward(self, context: th.Tensor, lengths: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param context: (n, context_dim), the contexts of several tasks, one after another
        :param lengths: (M,) int64, number of rows of each
        :return: mean and variance of the posteriors, (M, latent_dim) each
        """
        mean, raw = self.factors(context).chunk(2, dim=-1)
        return product_of_gaussians(mean, F.softplus(raw).clamp(min=MIN_VARIANCE), lengths)
