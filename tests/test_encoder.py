"""The posterior over z, against torch.distributions."""

import torch as th
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Independent, Normal, kl_divergence

from sb3_htr.pearl.encoder import ContextEncoder, kl_to_prior, product_of_gaussians

sizes = st.integers(1, 6)
seeds = st.integers(0, 2**31)


def random_factors(seed: int, *shape: int) -> tuple[th.Tensor, th.Tensor]:
    generator = th.Generator().manual_seed(seed)
    mean = th.randn(*shape, generator=generator, dtype=th.float64)
    return mean, 0.1 + th.rand(*shape, generator=generator, dtype=th.float64)


@given(seeds, sizes, sizes)
def test_product_has_the_density_of_the_product(seed: int, n_factors: int, latent_dim: int) -> None:
    mean, variance = random_factors(seed, n_factors, latent_dim)
    product_mean, product_variance = product_of_gaussians(mean, variance, th.ones(n_factors))
    product = Normal(product_mean, product_variance.sqrt())
    points = th.linspace(-2, 2, 7, dtype=th.float64)[:, None].expand(-1, latent_dim)
    log_density = Normal(mean, variance.sqrt()).log_prob(points[:, None]).sum(dim=1)
    difference = product.log_prob(points) - log_density
    # Equal up to a constant that normalizes
    th.testing.assert_close(difference, difference[:1].expand_as(difference), rtol=1e-6, atol=1e-6)


@given(seeds, sizes, sizes)
def test_weights_count_duplicates_and_leave_out(seed: int, n_factors: int, latent_dim: int) -> None:
    mean, variance = random_factors(seed, n_factors, latent_dim)
    weight = th.arange(n_factors, dtype=th.float64)
    repeated = th.repeat_interleave(th.arange(n_factors), weight.long())
    expected = product_of_gaussians(mean[repeated], variance[repeated], th.ones(len(repeated), dtype=th.float64))
    for actual, wanted in zip(product_of_gaussians(mean, variance, weight), expected, strict=True):
        th.testing.assert_close(actual, wanted)


def test_empty_context_is_the_prior() -> None:
    mean, variance = product_of_gaussians(th.randn(2, 3, 4), th.rand(2, 3, 4) + 0.1, th.zeros(2, 3))
    assert (mean == 0).all() and (variance == 1).all()


@given(seeds, sizes, sizes)
def test_kl_is_that_of_torch(seed: int, n: int, latent_dim: int) -> None:
    mean, variance = random_factors(seed, n, latent_dim)
    prior = Independent(Normal(th.zeros_like(mean), th.ones_like(mean)), 1)
    expected = kl_divergence(Independent(Normal(mean, variance.sqrt()), 1), prior)
    th.testing.assert_close(kl_to_prior(mean, variance), expected)


@given(seeds)
def test_encoder_ignores_order_and_padding(seed: int) -> None:
    th.manual_seed(seed)
    encoder = ContextEncoder(5, 2, [8])
    context, mask = th.randn(3, 6, 5), th.tensor([1.0, 1, 1, 1, 0, 0]).expand(3, -1)
    expected = encoder(context[:, :4], th.ones(3, 4))
    order = th.randperm(6)
    for actual, wanted in zip(encoder(context[:, order], mask[:, order]), expected, strict=True):
        th.testing.assert_close(actual, wanted, rtol=1e-4, atol=1e-5)
