"""Intervals are as wide as what was drawn varies: runs, evaluation seeds, tasks."""

import numpy as np
import pytest
from rliable import library, metrics

from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval

VALUES = np.random.default_rng(0).normal(size=40)


def test_of_one_score_per_run_it_is_that_of_rliable() -> None:
    np.random.seed(0)
    estimate, interval = library.get_interval_estimates(
        {"": VALUES[:10, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4000
    )
    expected = [estimate[""][0], *interval[""][:, 0]]
    np.testing.assert_allclose(iqm_interval(VALUES[:10]), expected, atol=0.12)
    assert iqm_interval(np.array([0.0, 10, 10, 10, 100]))[0] == 10


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["runs", "evaluation seeds", "tasks"])
def test_each_source_of_chance_widens_the_interval(axis: int) -> None:
    shape = [10, 10, 10]
    flat = np.full(shape, 3.0)
    assert iqm_interval(flat) == pytest.approx((3, 3, 3))
    along = np.arange(10.0).reshape([10 if i == axis else 1 for i in range(3)])
    estimate, low, high = iqm_interval(np.broadcast_to(along, shape))
    assert estimate == pytest.approx(4.5)
    # One of ten tasks is one for all runs; each run has evaluation seeds of its own, whose chances even out
    half_width = {0: 2.0, 1: 0.7, 2: 1.8}[axis]
    assert 4.5 - low == pytest.approx(high - 4.5, abs=0.3) and high - low == pytest.approx(2 * half_width, rel=0.25)


def test_a_task_that_is_hard_for_both_is_no_difference() -> None:
    tasks = np.broadcast_to(10 * VALUES, (5, 3, 40))
    estimate, low, high = iqm_difference(tasks + 1, tasks)
    assert (estimate, low, high) == pytest.approx((1, 1, 1))
    low, high = iqm_difference(np.array([11.0, 12, 13, 12, 12]), np.array([1.0, 2, 3, 2, 2]))[1:]
    assert 8 <= low < 10 < high <= 12


def test_the_best_and_the_worst_count_for_nothing() -> None:
    assert iqm_interval(np.array([0.0, *[10] * 38, 1000])) == (10, 10, 10)
