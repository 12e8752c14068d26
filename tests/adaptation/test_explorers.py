"""Which z is acted with: the promises of the explorers."""

from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import MakePEARL
from helpers.adaptations import begin, know_tasks, play, step
from sb3_htr.adaptation import Aggregate, Search
from sb3_htr.adaptation.explorers.task_belief import TaskBelief
from sb3_htr.adaptation.knowledge import KnownTasks
from sb3_htr.common.type_aliases import Context

SETBACKS = Search().max_setbacks


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "search"])
def test_the_given_explorer_is_settings_and_each_adaptation_has_its_own(tiny_pearl: MakePEARL, explorer: str) -> None:
    """Two adaptations at once, of one object, do not meet."""
    model = tiny_pearl(explorer=explorer)
    know_tasks(model)
    before = dict(vars(model.explorer))
    alone = play(begin(model, model.explorer, 2), [[0, 0], [0, 5], [0, 4], [3, 4]])
    ours, other = begin(model, model.explorer, 2), begin(model, model.explorer, 2)
    play(other, [[5, 5], [1, 0]])
    np.testing.assert_array_equal(play(ours, [[0, 0], [0, 5], [0, 4], [3, 4]]), alone)
    assert ours.explorer is not model.explorer is not other.explorer and vars(model.explorer) == before


# --- prior


@pytest.mark.parametrize("n_exploration_episodes", [0, 1, 3])
def test_prior_explores_for_a_fixed_number_of_episodes(tiny_pearl: MakePEARL, n_exploration_episodes: int) -> None:
    model = tiny_pearl()
    adaptation = begin(model, {"name": "prior", "n_exploration_episodes": n_exploration_episodes})
    exploring = []
    for returns in ([1.0], [0.0], [0.0], [0.0]):
        exploring.append(bool(adaptation.explorer.exploring()[0]))
        play(adaptation, [returns])
    assert exploring == [i < n_exploration_episodes for i in range(4)]


def test_the_posterior_of_prior_is_over_all_episodes(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    adaptation = begin(model, "prior")
    play(adaptation, [[1.0], [0.0], [2.0]])
    obs = th.tensor([[0.0], [0.1], [0.2]]).tile(3, 2)
    rewards = th.tensor([1.0, 0, 0, 0, 0, 0, 2, 0, 0])
    with th.no_grad():
        expected = model.policy.infer(Context(obs, obs, rewards, th.tensor([9])))
    mean, deviation = adaptation.posterior()
    np.testing.assert_allclose(mean, expected[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(deviation, expected[1].sqrt(), rtol=1e-4)


# --- aggregate


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_aggregate_is_as_wide_as_it_says(tiny_pearl: MakePEARL, scale: float) -> None:
    model = tiny_pearl()
    means = th.randn(5000, 3, generator=th.Generator().manual_seed(0)) @ th.tensor([[2.0, 0, 0], [1, 0.5, 0], [0, 0, 1]]) + 3
    model.knowledge.set_aggregate(means)
    z = th.from_numpy(begin(model, Aggregate(scale=scale), n_envs=20_000).z)
    th.testing.assert_close(z.mean(dim=0), means.mean(dim=0), atol=0.1, rtol=0)
    th.testing.assert_close(z.T.cov(), scale**2 * means.T.cov(), atol=0.3, rtol=0.1)


def test_a_long_episode_narrows_the_posterior_as_much_as_a_context_of_training(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    adaptation = begin(model, "aggregate", context_size=5)
    rows = np.random.default_rng(0).normal(size=(50, 1, 4)).astype(np.float32)
    for i, row in enumerate(rows):
        adaptation.observe(step(row[:, :2], [1.0], i == 49, actions=row[:, 2:]))
    obs, actions = (th.tensor(rows[[5, 15, 25, 35, 45], 0, columns]) for columns in (slice(0, 2), slice(2, 4)))
    with th.no_grad():
        _, variance = model.policy.infer(Context(obs, actions, th.ones(5), th.tensor([5])))
    np.testing.assert_allclose(adaptation.posterior()[1], variance.sqrt(), rtol=1e-5)


# --- search


def test_search_tries_every_known_task_once_until_a_reward(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    z_known = know_tasks(model)
    z = np.stack(play(begin(model, "search", 2), [[0, 0], [0, 5], [0, 4], [0, 4]])[:4])
    assert sorted(map(tuple, z[:, 0])) == sorted(map(tuple, z_known)), "the first env has seen no reward"
    visited = (z[:, 1, None] == z_known).all(axis=2).any(axis=1)
    assert visited[:2].all()
    # The reward was that of the task visited, so the best guess is another one, and then it is the posterior's turn
    assert not visited[3], "after a reward and a setback, the posterior is used"


def test_a_visit_that_fails_turns_to_another_within_the_episode(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    z_known = know_tasks(model, n=8, first_success=3)
    adaptation = begin(model, "search")
    first = adaptation.z.copy()
    nothing, reward = (step(np.zeros((1, 2)), [value], False) for value in (0.0, 1.0))
    seen = []
    for _ in range(10):
        adaptation.observe(nothing)
        seen.append(adaptation.z.copy())
    assert (seen[3] == first).all(), "the visit has its time, and a fifth more, and a step"
    assert (seen[4] != first).any()
    assert (seen[4] == z_known).all(axis=1).any()
    assert len(np.unique(np.concatenate(seen), axis=0)) == 3
    # A reward is a reason to stay
    adaptation.observe(reward)
    stay = adaptation.z.copy()
    for _ in range(10):
        adaptation.observe(nothing)
        assert (adaptation.z == stay).all()


def test_an_episode_of_several_visits_is_no_success_to_settle_on(tiny_pearl: MakePEARL) -> None:
    """Acting with its last z from the start may find nothing."""
    model = tiny_pearl()
    know_tasks(model, n=8, first_success=1)
    adaptation = begin(model, "search")
    for i in range(6):
        adaptation.observe(step(np.zeros((1, 2)), [9.0 * (i == 5)], i == 5))
    assert not adaptation.explorer.exploring()[0]
    z = play(adaptation, [[1.0], [0.0]])
    np.testing.assert_array_equal(adaptation.explorer.final_z(), z[0])


@pytest.mark.parametrize("explorer", [Search(), Search(max_setbacks=2), Aggregate()])
def test_it_settles_on_the_best_episode_after_setbacks(tiny_pearl: MakePEARL, explorer: Aggregate) -> None:
    model, n = tiny_pearl(), explorer.max_setbacks
    know_tasks(model, n=12)
    z = play(begin(model, explorer), [[0.0], [5.0], *[[1.0] for _ in range(n)], [5.0], [5.0]])
    for episode in range(2, 2 + n):
        assert (z[episode] != z[1]).any()
    for settled in z[2 + n :]:
        np.testing.assert_array_equal(settled, z[1])


@pytest.mark.parametrize(("clearly_better", "settles"), [(1.02, True), (1.0, False)])
def test_an_episode_that_is_a_little_better_is_no_reason_to_search_on(
    tiny_pearl: MakePEARL, clearly_better: float, settles: bool
) -> None:
    model = tiny_pearl()
    know_tasks(model, n=12)
    explorer = Search(clearly_better=clearly_better)
    z = play(begin(model, explorer), [[5.0 + 0.01 * i] for i in range(SETBACKS + 3)])
    # It settles on the best of them
    for later in (1, 2):
        assert (z[SETBACKS + later] == z[SETBACKS]).all() == settles


def test_the_posterior_of_search_sees_the_best_episode_only(tiny_pearl: MakePEARL) -> None:
    """The misses before it, whatever they were, make no difference."""
    model = tiny_pearl()
    ends = []
    for length_of_miss in (2, 7):
        # Without known tasks, only the posterior is used
        adaptation = begin(model, "search")
        play(adaptation, [[0]], length_of_miss)
        adaptation.generator = th.Generator().manual_seed(1)
        ends.append(play(adaptation, [[1]])[-1])
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-5)


def test_the_frozen_agent_acts_with_what_is_known_to_work(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model)
    adaptation = begin(model, "search", 2)
    z = play(adaptation, [[0.0, 0.0], [5.0, 0.0], [1.0, 0.0]])
    final = adaptation.explorer.final_z()
    np.testing.assert_array_equal(final[0], z[1][0])
    np.testing.assert_array_equal(final[1], adaptation.z[1])  # nothing is known to work


def test_what_is_known_about_z_before_a_reward(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    # The aggregate of a new model is N(0, I)
    settings: list[tuple[Any, float]] = [("prior", 1.0), ("aggregate", 1.5), ("search", 1.5), (Search(scale=3.0), 3.0)]
    for explorer, expected in settings:
        adaptation = model.start_adaptation(4, explorer=explorer)
        np.testing.assert_allclose(adaptation.explorer.deviation(), np.full((4, 3), expected), rtol=1e-6)
        mean, deviation = adaptation.posterior()
        assert (mean == 0).all() and (deviation == 1).all() and mean.shape == (4, 3)


# --- the belief of search


def test_search_finds_a_task_like_those_known_within_few_visits() -> None:
    """Tasks on a line of which a visit finds its neighbours: the search skips what was ruled out, and no task escapes it."""
    place = np.arange(40)
    finds = np.abs(place[:, None] - place) <= 2
    known = KnownTasks(
        place[:, None].astype(np.float32), np.where(finds, 5.0, 0.0), np.where(finds, 3.0, np.inf)
    )  # fmt: skip
    belief, envs = TaskBelief(known, len(place)), place
    first = np.zeros(len(place))
    for visit in range(1, 14):
        task = belief.to_find(envs)
        hit = finds[task, envs]
        first[hit & (first == 0)] = visit
        belief.missed(envs[~hit], task[~hit], np.full((~hit).sum(), 20))
        belief.found(envs[hit], task[hit], np.full(hit.sum(), 5.0))
    assert (first > 0).all()
    assert first.mean() < 6.5, "40 places, 5 with a visit: 4.5 on average were perfect"


def test_belief_tells_two_sides_of_a_grazed_goal_apart() -> None:
    """Both neighbours of a visit return the same; an earlier miss decides."""
    place = np.arange(9.0)
    distance = np.abs(place[:, None] - place)
    returns = np.where(distance <= 2, 6.0 - 2 * distance, 0.0)
    known = KnownTasks(place[:, None].astype(np.float32), returns, np.where(returns > 0, 3.0, np.inf))
    belief = TaskBelief(known, 1)
    env = np.zeros(1, dtype=np.int64)
    belief.missed(env, np.array([2]), np.array([20]))  # rules 0 to 4 out
    belief.found(env, np.array([4]), np.array([2.0]))  # 2 or 6
    assert belief.to_exploit(env)[0] == 6


@given(n=st.integers(1, 6), seed=st.integers(0, 2**16))
def test_beliefs_stay_probabilities(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    returns = np.where(rng.random((n, n)) < 0.5, 0.0, 10 * rng.random((n, n))) + np.eye(n)
    first = np.where(returns > 0, rng.integers(0, 20, (n, n)), np.inf)
    belief = TaskBelief(KnownTasks(rng.normal(size=(n, 3)).astype(np.float32), returns, first), 2)
    envs = np.arange(2)
    for _ in range(60):
        task = belief.to_find(envs) if rng.random() < 0.5 else belief.to_exploit(envs)
        if rng.random() < 0.5:
            belief.missed(envs, task, rng.integers(0, 30, 2))
        else:
            belief.found(envs, task, np.where(rng.random(2) < 0.3, np.nan, 20 * rng.random(2)))
        assert (task < n).all() and np.isfinite(belief.belief).all()
        np.testing.assert_allclose(belief.belief.sum(axis=1), 1)
