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
    product_mean, product_variance = product_of_gaussians(mean, variance, th.tensor([n_factors]))
    product = Normal(product_mean, product_variance.sqrt())
    points = th.linspace(-2, 2, 7, dtype=th.float64)[:, None].expand(-1, latent_dim)
    log_density = Normal(mean, variance.sqrt()).log_prob(points[:, None]).sum(dim=1)
    difference = product.log_prob(points) - log_density
    # Equal up to a constant that normalizes
    th.testing.assert_close(difference, difference[:1].expand_as(difference), rtol=1e-6, atol=1e-6)


@given(seeds, st.lists(st.integers(0, 4), min_size=1, max_size=5), sizes)
def test_groups_are_products_of_their_own(seed: int, lengths: list[int], latent_dim: int) -> None:
    """An empty group is the prior N(0, 1)."""
    mean, variance = random_factors(seed, sum(lengths), latent_dim)
    together = product_of_gaussians(mean, variance, th.tensor(lengths))
    groups = zip(mean.split(lengths), variance.split(lengths), strict=True)
    for i, (group_mean, group_variance) in enumerate(groups):
        precision = (1 / group_variance).sum(dim=0) if lengths[i] else th.ones(latent_dim, dtype=th.float64)
        th.testing.assert_close(together[0][i], (group_mean / group_variance).sum(dim=0) / precision)
        th.testing.assert_close(together[1][i], 1 / precision)


def test_gradients_of_the_product() -> None:
    mean, variance = random_factors(0, 5, 2)
    inputs = mean.requires_grad_(), variance.requires_grad_()
    assert th.autograd.gradcheck(lambda m, v: product_of_gaussians(m, v, th.tensor([3, 0, 2])), inputs)


@given(seeds, sizes, sizes)
def test_kl_is_that_of_torch(seed: int, n: int, latent_dim: int) -> None:
    mean, variance = random_factors(seed, n, latent_dim)
    prior = Independent(Normal(th.zeros_like(mean), th.ones_like(mean)), 1)
    expected = kl_divergence(Independent(Normal(mean, variance.sqrt()), 1), prior)
    th.testing.assert_close(kl_to_prior(mean, variance), expected)


@given(seeds)
def test_encoder_ignores_order(seed: int) -> None:
    th.manual_seed(seed)
    encoder = ContextEncoder(5, 2, [8])
    context, lengths = th.randn(9, 5), th.tensor([3, 6])
    order = th.cat([th.randperm(3), 3 + th.randperm(6)])
    for actual, wanted in zip(encoder(context[order], lengths), encoder(context, lengths), strict=True):
        th.testing.assert_close(actual, wanted, rtol=1e-4, atol=1e-5)
