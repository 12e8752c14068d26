"""The posterior over z, against torch.distributions."""

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.distributions import Independent, Normal, kl_divergence
from torch.nn import functional as F

from sb3_htr.pearl.encoder import MIN_VARIANCE, ContextEncoder, PriorFactorEncoder, kl_to_prior

CONTEXT_DIM = 4
sizes = st.integers(1, 6)
seeds = st.integers(0, 2**31)


def random_encoder(seed: int, latent_dim: int) -> ContextEncoder:
    th.manual_seed(seed)
    return ContextEncoder(CONTEXT_DIM, latent_dim, [8], nn.Tanh).double()


def factors(encoder: ContextEncoder, rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Mean and variance of the factor that each row is."""
    mean, raw = encoder.factors(rows).chunk(2, dim=-1)
    return mean, F.softplus(raw).clamp(min=MIN_VARIANCE)


def posterior(encoder: ContextEncoder, rows: th.Tensor, lengths: list[int]) -> tuple[th.Tensor, th.Tensor]:
    return encoder.posterior(encoder.extend(encoder.empty(len(lengths)), rows, th.tensor(lengths)))


@given(seeds, sizes, sizes)
def test_the_posterior_has_the_density_of_the_product_of_its_factors(seed: int, n: int, latent_dim: int) -> None:
    encoder, rows = random_encoder(seed, latent_dim), th.randn(n, CONTEXT_DIM, dtype=th.float64)
    mean, variance = posterior(encoder, rows, [n])
    points = th.linspace(-2, 2, 7, dtype=th.float64)[:, None].expand(-1, latent_dim)
    factor_mean, factor_variance = factors(encoder, rows)
    log_density = Normal(factor_mean, factor_variance.sqrt()).log_prob(points[:, None]).sum(dim=1)
    difference = Normal(mean, variance.sqrt()).log_prob(points) - log_density
    # Equal up to a constant that normalizes
    th.testing.assert_close(difference, difference[:1].expand_as(difference), rtol=1e-6, atol=1e-6)


def test_no_row_is_surer_than_the_smallest_variance() -> None:
    encoder = ContextEncoder(CONTEXT_DIM, 1, [])
    (last,) = encoder.factors.children()
    assert isinstance(last, nn.Linear)
    with th.no_grad():
        last.weight.zero_()
        last.bias.copy_(th.tensor([0.3, -200.0]))
        mean, variance = posterior(encoder, th.randn(2, CONTEXT_DIM), [2])
    assert mean.item() == pytest.approx(0.3) and variance.item() == pytest.approx(MIN_VARIANCE / 2)


@given(seeds, st.lists(st.integers(0, 4), min_size=1, max_size=5), sizes)
def test_tasks_have_posteriors_of_their_own(seed: int, lengths: list[int], latent_dim: int) -> None:
    """That of a task of which nothing was seen is the prior N(0, I)."""
    encoder, rows = random_encoder(seed, latent_dim), th.randn(sum(lengths), CONTEXT_DIM, dtype=th.float64)
    mean, variance = posterior(encoder, rows, lengths)
    for i, task in enumerate(rows.split(lengths)):
        factor_mean, factor_variance = factors(encoder, task)
        precision = (1 / factor_variance).sum(dim=0) if lengths[i] else th.ones(latent_dim, dtype=th.float64)
        th.testing.assert_close(mean[i], (factor_mean / factor_variance).sum(dim=0) / precision)
        th.testing.assert_close(variance[i], 1 / precision)


@given(seeds, st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=5))
def test_what_comes_later_is_taken_in_as_if_it_had_come_at_once(seed: int, lengths: list[tuple[int, int]]) -> None:
    encoder = random_encoder(seed, 3)
    early, late = ([th.randn(n, CONTEXT_DIM, dtype=th.float64) for n in part] for part in zip(*lengths, strict=True))
    state = encoder.empty(len(lengths))
    for part in (early, late):
        state = encoder.extend(state, th.cat(part), th.tensor([len(rows) for rows in part]))
    together = th.cat([rows for both in zip(early, late, strict=True) for rows in both])
    for actual, wanted in zip(encoder.posterior(state), posterior(encoder, together, [sum(n) for n in lengths]), strict=True):
        th.testing.assert_close(actual, wanted)


def test_gradients_of_the_posterior() -> None:
    encoder = random_encoder(0, 2)
    rows = th.randn(5, CONTEXT_DIM, dtype=th.float64, requires_grad=True)
    assert th.autograd.gradcheck(lambda rows: posterior(encoder, rows, [3, 0, 2]), rows)
    sum(part.sum() for part in posterior(encoder, rows, [3, 0, 2])).backward()  # type: ignore[union-attr]
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in encoder.parameters())


@given(seeds, sizes, sizes)
def test_kl_is_that_of_torch(seed: int, n: int, latent_dim: int) -> None:
    generator = th.Generator().manual_seed(seed)
    mean, variance = (th.rand(n, latent_dim, generator=generator, dtype=th.float64) for _ in range(2))
    mean, variance = 4 * mean - 2, variance + 0.1
    prior = Independent(Normal(th.zeros_like(mean), th.ones_like(mean)), 1)
    expected = kl_divergence(Independent(Normal(mean, variance.sqrt()), 1), prior)
    th.testing.assert_close(kl_to_prior(mean, variance), expected)


@given(seeds)
def test_the_order_of_a_context_makes_no_difference(seed: int) -> None:
    encoder = random_encoder(seed, 2)
    context = th.randn(9, CONTEXT_DIM, dtype=th.float64)
    order = th.cat([th.randperm(3), 3 + th.randperm(6)])
    for actual, wanted in zip(posterior(encoder, context[order], [3, 6]), posterior(encoder, context, [3, 6]), strict=True):
        th.testing.assert_close(actual, wanted)


@given(seeds, st.lists(st.integers(0, 4), min_size=1, max_size=5), sizes)
def test_the_prior_can_be_a_factor_of_the_product(seed: int, lengths: list[int], latent_dim: int) -> None:
    """Of the density: that of N(0, I) times those of the rows, whatever the order in which they come."""
    th.manual_seed(seed)
    encoder = PriorFactorEncoder(CONTEXT_DIM, latent_dim, [8], nn.Tanh).double()
    rows = th.randn(sum(lengths), CONTEXT_DIM, dtype=th.float64)
    mean, variance = posterior(encoder, rows, lengths)
    points = th.linspace(-2, 2, 7, dtype=th.float64)[:, None].expand(-1, latent_dim)
    for i, task in enumerate(rows.split(lengths)):
        factor_mean, raw = encoder.factors(task).chunk(2, dim=-1)
        likelihood = Normal(factor_mean, F.softplus(raw).rsqrt()).log_prob(points[:, None]).sum(dim=1)
        difference = Normal(mean[i], variance[i].sqrt()).log_prob(points) - Normal(0, 1).log_prob(points) - likelihood
        th.testing.assert_close(difference, difference[:1].expand_as(difference), rtol=1e-6, atol=1e-6)


def test_rows_that_say_nothing_leave_the_prior_however_many_they_are() -> None:
    encoder = PriorFactorEncoder(CONTEXT_DIM, 3, [])
    with th.no_grad():
        for parameter in encoder.parameters():
            parameter.zero_()
        (last,) = encoder.factors.children()
        assert isinstance(last, nn.Linear)
        last.bias[3:] = -20.0
    mean, variance = posterior(encoder, th.randn(1000, CONTEXT_DIM), [1000])
    th.testing.assert_close(mean, th.zeros(1, 3))
    th.testing.assert_close(variance, th.ones(1, 3), rtol=1e-4, atol=0)
