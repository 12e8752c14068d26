"""Probabilistic context encoder: q(z | c) as a product of independent Gaussian factors (PEARL, section 4)."""

from typing import TypeVar

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_htr.common.linear import with_fast_layers
from sb3_htr.common.segments import segment_sum
from sb3_htr.common.settings import check_class, register

SomeModule = TypeVar("SomeModule", bound=nn.Module)

# Smallest variance of a factor, as in PEARL's reference implementation
MIN_VARIANCE = 1e-7


def kl_to_prior(mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """
    :param mean: (..., latent_dim)
    :param variance: (..., latent_dim)
    :return: (...,), KL divergence of N(mean, variance) from the prior N(0, I), in nats
    """
    return 0.5 * (variance + mean.square() - 1.0 - variance.log()).sum(dim=-1)


class ContextEncoder(nn.Module):
    """
    Maps a set of transitions (o, a, r), or (o, a, r, o'), to a Gaussian posterior over the task variable z, in any order.

    The posterior is a product of Gaussians, one factor for each transition: its mean, and its variance after a softplus, are
    outputs of the network. What was taken in of a task is the sum of the factors' precisions and that of their precisions
    times means, (n_tasks, 2 * latent_dim).

    An encoder of another kind has the same three methods, see :class:`sb3_htr.adaptation.policy.Encoder`, and the same
    constructor: ``policy_kwargs={"encoder_class": MyEncoder}``. For ``cuda_graph``, it waits for no value that it computes,
    such as the longest of the lengths, and is finite for rows of zeros.

    :param context_dim: length of a context row, obs_dim + action_dim + 1, and obs_dim more where o' is in it
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
        self.factors = with_fast_layers(nn.Sequential(*create_mlp(context_dim, 2 * latent_dim, net_arch, activation_fn)))

    def empty(self, n_tasks: int) -> th.Tensor:
        """
        :param n_tasks: number of tasks
        :return: (n_tasks, 2 * latent_dim), nothing taken in yet
        """
        return next(self.parameters()).new_zeros(n_tasks, 2 * self.latent_dim)

    def extend(self, state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        """
        :param state: (n_tasks, 2 * latent_dim), what was taken in before
        :param rows: (n, context_dim), those of the first task first
        :param lengths: (n_tasks,) int64, number of rows of each task
        :return: (n_tasks, 2 * latent_dim), with these rows taken in
        """
        mean, raw = self.factors(rows).chunk(2, dim=-1)
        # Of a slice of columns, softplus takes eight times as long
        precision = self._precision(raw.contiguous())
        factors = th.cat([precision, precision * mean], dim=1)
        return state + segment_sum(factors, lengths)

    def _precision(self, raw: th.Tensor) -> th.Tensor:
        """Of factors, (n, latent_dim), from what the network says of it."""
        return 1.0 / F.softplus(raw).clamp(min=MIN_VARIANCE)

    def posterior(self, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param state: (n_tasks, 2 * latent_dim), what was taken in
        :return: mean and variance (n_tasks, latent_dim), those of the prior N(0, I) where nothing was taken in
        """
        precision, precision_mean = state.chunk(2, dim=-1)
        variance = 1.0 / precision.masked_fill(precision == 0, 1.0)
        return variance * precision_mean, variance


class PriorFactorEncoder(ContextEncoder):
    """
    The same with the prior N(0, I) as one more factor of the product. The softplus is of a factor's precision here, and not of
    its variance, so that a factor can be nothing.

    Bayes' rule has this factor, PEARL's product has not: there, every transition narrows the posterior, and that of a hundred
    misses is as narrow as that of a success. Here, what says nothing of the task changes nothing, however much of it there is.
    """

    def posterior(self, state: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        precision, precision_mean = state.chunk(2, dim=-1)
        variance = 1.0 / (1.0 + precision)
        return variance * precision_mean, variance

    def _precision(self, raw: th.Tensor) -> th.Tensor:
        return F.softplus(raw)


#: Encoders by the names that YAML files have for them
ENCODERS: dict[str, type[ContextEncoder]] = {encoder.__name__: encoder for encoder in (ContextEncoder, PriorFactorEncoder)}


def register_encoder(kind: type[SomeModule]) -> type[SomeModule]:
    """
    Let settings and YAML files name an encoder of one's own, by the name of its class. In a module that ``--gym-packages``
    names, it is at hand in all commands, and they read models that were saved with its name.

    :param kind: a class of modules whose constructor takes what that of :class:`ContextEncoder` does, with ``empty``,
        ``extend`` and ``posterior``
    :return: the class, so that this can decorate it
    :raises ValueError: for what is no such class, or has the name of another encoder
    """
    to_encoder_class(kind)  # type: ignore[arg-type]
    return register("encoder_class", kind, nn.Module, ENCODERS)


def to_encoder_class(encoder: type[ContextEncoder] | str) -> type[ContextEncoder]:
    """
    :param encoder: a class of modules that has what :class:`sb3_htr.adaptation.policy.Encoder` names, or the name of one here
    :return: the class
    :raises ValueError: for an unknown name, or what is no such class
    """
    if isinstance(encoder, str):
        if encoder not in ENCODERS:
            raise ValueError(f"encoder_class is {encoder!r}, expected one of {sorted(ENCODERS)}, or a class.")
        return ENCODERS[encoder]
    check_class("encoder_class", encoder, nn.Module)
    if missing := [method for method in ("empty", "extend", "posterior") if not hasattr(encoder, method)]:
        raise ValueError(f"encoder_class {encoder.__name__} has no {', '.join(missing)}: expected what ContextEncoder has.")
    return encoder
