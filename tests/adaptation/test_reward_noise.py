"""What a sensor adds to rewards is not taken for a success, and nothing else is taken for noise."""

import warnings
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_htr.adaptation.reward_noise import MIN_STEPS, RewardNoise
from sb3_htr.adaptation.reward_watch import RewardWatch

THRESHOLD, WORTH = 0.3, 0.9
Cost: TypeAlias = Callable[[np.random.Generator, int], np.ndarray]


def estimate(beside: np.ndarray, unrewarded: np.ndarray | None = None) -> np.ndarray:
    """From steps (n, n_envs)."""
    noise = RewardNoise(beside.shape[1], THRESHOLD)
    for step, counts in zip(beside, np.ones_like(beside, dtype=bool) if unrewarded is None else unrewarded, strict=True):
        noise.observe(step, counts)
    return noise.deviation


@given(scale=st.floats(0.1, 0.5), offset=st.floats(-0.5, 0.5), seed=st.integers(0, 2**31))
def test_noise_is_estimated_beside_an_offset_of_each_env_alone(scale: float, offset: float, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=(1000, 2))
    noisy, calm = estimate(offset + noise * [scale, 0])
    assert abs(noisy - scale) < 0.25 * scale + THRESHOLD / 10
    assert calm == 0


@given(offset=st.floats(-0.5, 0.5), penalty=st.floats(-50, -0.1), share=st.floats(0, 1))
def test_a_penalty_is_no_noise(offset: float, penalty: float, share: float) -> None:
    steps = np.full((1000, 1), offset)
    steps[: int(share * 1000)] += penalty
    assert estimate(np.random.default_rng(0).permutation(steps)) == 0


def test_successes_and_the_first_steps_do_not_count() -> None:
    rng = np.random.default_rng(0)
    steps = np.where(np.arange(200)[:, None] % 3, rng.normal(0.9, 0.2, size=(200, 1)), 0)
    assert estimate(steps, steps == 0) == 0 < estimate(steps)
    assert estimate(rng.normal(size=(MIN_STEPS - 1, 3))).tolist() == [0, 0, 0]
    assert (estimate(rng.normal(size=(MIN_STEPS, 3))) > 0).all()


def told(watch: RewardWatch, beside: np.ndarray) -> np.ndarray:
    """Which of the steps (n, n_envs) of an episode are rewarded."""
    dones = np.zeros(beside.shape[1], dtype=bool)
    return np.stack([watch.rewarded(step, dones) for step in beside])


@pytest.mark.parametrize("scale", [0.15, 0.2])
def test_what_is_noise_is_not_rewarded_and_what_is_none_is(scale: float) -> None:
    rng, watch = np.random.default_rng(0), RewardWatch(4, THRESHOLD, WORTH)
    without = told(watch, rng.normal(scale=scale, size=(400, 4)))
    assert without[100:].mean() < 0.001 < 0.02 < (rng.normal(scale=scale, size=100_000) > THRESHOLD).mean()
    assert told(watch, WORTH + rng.normal(scale=scale, size=(50, 4))).mean() > 0.6


def test_successes_that_noise_makes_small_do_not_hide_the_others() -> None:
    """However long an agent stays where it succeeds."""
    rng, watch = np.random.default_rng(0), RewardWatch(10, THRESHOLD, WORTH)
    told(watch, rng.normal(scale=0.2, size=(800, 10)))
    is_there = np.arange(3000) % 3 > 0
    steps = WORTH * is_there[:, None] + rng.normal(scale=0.2, size=(3000, 10))
    assert told(watch, steps)[is_there][-500:].mean() > 0.65


@pytest.mark.parametrize("cost", [lambda rng, n: rng.uniform(0, 0.6, (n, 1)), lambda rng, n: rng.normal(0.4, 0.15, (n, 1))])
def test_where_steps_cost_more_than_in_training_a_success_is_told_by_what_they_cost(cost: Cost) -> None:
    """It need not be above what costs vary by, but above what steps return without it."""
    rng, watch = np.random.default_rng(0), RewardWatch(1, THRESHOLD, WORTH)
    assert told(watch, -cost(rng, 400)).mean() < 0.001
    assert told(watch, WORTH - cost(rng, 100)).mean() > 0.55


def test_without_noise_the_threshold_is_that_of_training() -> None:
    steps = np.random.default_rng(0).choice([0.0, -0.01, 0.01, 0.29, 0.31, 0.9], size=(500, 3))
    np.testing.assert_array_equal(told(RewardWatch(3, THRESHOLD, WORTH), steps), steps > THRESHOLD)


@pytest.mark.parametrize("scale", [0.15, 0.25, 0.5, 2.0])
def test_noise_is_told_also_where_the_threshold_is_small(scale: float) -> None:
    """As where a success pays next to nothing at the rim of a goal, and much in its middle."""
    rng, watch = np.random.default_rng(0), RewardWatch(10, 0.05, 10 * scale)
    assert told(watch, rng.normal(scale=scale, size=(800, 10)))[200:].mean() < 0.01
    assert told(watch, 6 * scale + rng.normal(scale=scale, size=(50, 10))).mean() > 0.9


@pytest.mark.parametrize("scale", [0.7, 1.6])
def test_noise_that_hides_successes_is_warned_of(scale: float) -> None:
    steps = np.random.default_rng(0).normal(size=(100, 2)) * [0.2, scale]
    with pytest.warns(UserWarning, match=r"standard deviation of \d\.\d+, among which a success of up to 0\.9 can") as caught:
        told(RewardWatch(2, THRESHOLD, WORTH), steps)
    assert len([warning for warning in caught if "deviation" in str(warning.message)]) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        told(RewardWatch(1, THRESHOLD, WORTH), steps[:, :1])
