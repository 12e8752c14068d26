"""Observations on one scale: the numbers of SB3's VecNormalize, inside of the policy."""

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_htr.common.normalizer import ObservationNormalizer

batches = st.lists(st.tuples(st.integers(1, 30), st.floats(-100, 100), st.floats(0, 50)), min_size=1, max_size=6)


@given(batches, st.integers(0, 99))
def test_it_follows_what_was_observed_as_vec_normalize_does(batches: list[tuple[int, float, float]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    normalizer, theirs = ObservationNormalizer(3), RunningMeanStd(shape=(3,), epsilon=0.0)
    for n, mean, deviation in batches:
        obs = rng.normal(mean, deviation, (n, 3)).astype(np.float32)
        normalizer.update(obs)
        theirs.update(obs.astype(np.float64))
    np.testing.assert_allclose(normalizer.mean, theirs.mean, rtol=1e-12)
    np.testing.assert_allclose(normalizer.variance, theirs.var, rtol=1e-12)
    obs = rng.normal(0, 200, (50, 3)).astype(np.float32)
    expected = np.clip((obs - theirs.mean) / np.sqrt(theirs.var + 1e-8), -10, 10)
    result = normalizer(th.from_numpy(obs))
    assert result.dtype == th.float32
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-5)


def test_nothing_observed_changes_nothing_within_the_bounds_and_a_state_is_all_there_is() -> None:
    normalizer, obs = ObservationNormalizer(2), th.tensor([[0.5, -3.0], [99.0, -99.0]])
    th.testing.assert_close(normalizer(obs), th.tensor([[0.5, -3.0], [10.0, -10.0]]))
    normalizer.update(np.random.default_rng(0).normal(5, 2, (7, 2)))
    other = ObservationNormalizer(2)
    other.load_state_dict(normalizer.state_dict())
    for one in (normalizer, other):
        one.update(np.ones((3, 2)))
    assert th.equal(normalizer(obs), other(obs))
    assert not list(normalizer.parameters()), "gradients have no say in it"


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e6])
def test_an_offset_is_no_deviation(offset: float) -> None:
    normalizer, rng = ObservationNormalizer(1), np.random.default_rng(0)
    obs = (offset + rng.standard_normal((4000, 1))).astype(np.float32)
    normalizer.update(obs)
    assert normalizer(th.from_numpy(obs)).std().item() == pytest.approx(1, rel=0.01)


def test_a_large_rollout_is_not_rounded_away() -> None:
    normalizer, rng = ObservationNormalizer(1), np.random.default_rng(0)
    for _ in range(3):
        normalizer.update((1000 + 0.1 * rng.standard_normal((200_000, 1))).astype(np.float32))
    assert normalizer.mean.item() == pytest.approx(1000, abs=1e-3)
    assert normalizer.variance.item() ** 0.5 == pytest.approx(0.1, rel=0.01)
