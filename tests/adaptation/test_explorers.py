"""Which z is acted with: the promises of the explorers."""

import copy
import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID, MakePEARL, with_policy
from helpers.adaptations import begin, know_tasks, play, step, walk
from sb3_htr import PEARL
from sb3_htr.adaptation import Aggregate, Belief, LearnedPrior
from sb3_htr.adaptation.explorers import Explorer
from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.type_aliases import Context
from sb3_htr.common.vec_env import make_task_vec_env, reset_to_tasks
from sb3_htr.experiments.ablations import ABLATIONS
from sb3_htr.zoo.run.agents import agent_for

SETBACKS = Aggregate().max_setbacks


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "belief", "learned-prior"])
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


class Stopped(gym.Wrapper[Any, Any, Any, Any]):
    """Has a zone that ends episodes, unlike those of training."""

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or bool(np.hypot(*(obs - 0.5)) < 0.25), truncated, info


def test_a_stop_on_the_way_does_not_end_all_searches(tmp_path: Path) -> None:
    """Where it is on the way to the task that promises most."""
    model = agent_for(ENV_ID, str(tmp_path)).load()
    assert isinstance(model, PEARL)
    for task in ([-1.0, 0.05], [0.0, 1.0], [1.0, 0.05]):
        returns = model.adapt(Stopped(gym.make(ENV_ID)), n_episodes=12, task=task, explorer="belief").returns
        assert returns[0] == 0 < returns[-1], "the stop is met, and then the task"


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "belief", "learned-prior"])
def test_an_adaptation_goes_on_from_its_recorded_steps(explorer: str, tmp_path: Path) -> None:
    """As docs/real_robot.md says of a process that has ended."""
    model = agent_for(ENV_ID, str(tmp_path)).load()
    assert isinstance(model, PEARL)
    env = make_task_vec_env(ENV_ID, 2, seed=0)
    obs = reset_to_tasks(env, get_task_family(env).test_tasks[[3, 60]])
    ours = model.start_adaptation(2, explorer, th.Generator().manual_seed(1))
    steps = adaptation_steps(env, ours, 8, model.policy.unscale_action, ours.act, obs)
    recorded = list(itertools.islice(steps, 7 * 20 + 9))
    assert ours.n_episodes.tolist() == [7, 7] and (explorer != "belief" or (ours.best_return > 0).all())
    again = model.start_adaptation(2, explorer, th.Generator().manual_seed(1))
    for each in recorded:
        np.testing.assert_array_equal(again.act(each.observations), each.actions)
        again.observe(each)
    np.testing.assert_array_equal(again.exploring(), ours.exploring())
    now = recorded[-1].next_observations
    np.testing.assert_array_equal(again.act(now), ours.act(now))
    np.testing.assert_array_equal(again.explorer.final_z(), ours.explorer.final_z())
    kept = copy.deepcopy(again)
    for each in recorded[:30]:
        again.act(each.observations)
        again.observe(each)
    np.testing.assert_array_equal(kept.act(now), ours.act(now), "a copy is as it was")


def test_where_nothing_happened_yet_there_is_nothing_to_infer(tiny_pearl: MakePEARL) -> None:
    adaptation = begin(tiny_pearl(), "prior", 2)
    adaptation.infer(np.arange(2), keep=True)
    unknown = adaptation.posterior()
    play(adaptation, [[1.0, 2.0]])
    known = adaptation.posterior()
    adaptation.infer(np.arange(2), keep=True)
    np.testing.assert_array_equal(adaptation.posterior(), known)
    adaptation.infer(np.arange(2), keep=False)
    np.testing.assert_array_equal(adaptation.posterior(), unknown)
    assert (known[0] != unknown[0]).all()


def test_a_reward_of_the_task_is_what_the_model_does_not_call_task_free(tiny_pearl: MakePEARL) -> None:
    """The model sees observations as it learnt by them."""
    model = tiny_pearl()
    model.policy.update_normalizer(np.array([[0.0, 0.0], [8.0, 2.0]]))
    model.knowledge.threshold.fill_(-100.0)
    adaptation = begin(model, "prior")
    taken = step([[3.0, 0.5]], [1.0], True)
    adaptation.observe(taken)
    with th.no_grad():
        normal = model.policy.normalize(th.from_numpy(taken.observations))
        free = model.policy.reward_model.task_free(normal, th.from_numpy(taken.actions), normal)
    np.testing.assert_allclose(adaptation.task_reward, 1 - free.numpy(), rtol=1e-5)
    adaptation.observe(taken._replace(rewards=np.array([-9.0])))
    np.testing.assert_allclose(adaptation.best_return, 1 - free.numpy(), rtol=1e-5, err_msg="that of the better episode")


@pytest.fixture(scope="module")
def known() -> Any:
    """Models that know so many tasks, made once."""
    model = PEARL("MlpPolicy", ENV_ID, policy_kwargs={"latent_dim": 3, "net_arch": [16]}, seed=0)

    def with_tasks(n: int) -> PEARL:
        know_tasks(model, n)
        return model

    return with_tasks


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
        expected = model.policy.infer(Context(obs, obs, rewards, obs, th.tensor([9])))
    mean, deviation = adaptation.posterior()
    np.testing.assert_allclose(mean, expected[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(deviation, expected[1].sqrt(), rtol=1e-4)


def test_an_adaptation_infers_from_what_its_steps_led_to(tiny_pearl: MakePEARL) -> None:
    """Where the policy asks for it; over several episodes, which end elsewhere than the next one begins."""
    model = tiny_pearl(policy_kwargs=with_policy(use_next_obs_in_context=True))
    adaptation = begin(model, "prior")
    obs, next_obs = np.random.default_rng(0).uniform(-1, 1, (2, 6, 1, 2)).astype(np.float32)
    for i in range(6):
        adaptation.observe(step(obs[i], [0.0], i % 3 == 2)._replace(next_observations=next_obs[i]))
    before, after = (th.from_numpy(x[:, 0]) for x in (obs, next_obs))
    with th.no_grad():
        mean, _ = model.policy.infer(Context(before, before, th.zeros(6), after, th.tensor([6])))
        other, _ = model.policy.infer(Context(before, before, th.zeros(6), before, th.tensor([6])))
    np.testing.assert_allclose(adaptation.posterior()[0], mean, rtol=1e-4, atol=1e-6)
    assert not np.allclose(mean, other, rtol=0.01)


def test_what_exploration_alone_found_is_in_the_final_z(tiny_pearl: MakePEARL) -> None:
    """Also where there are fewer episodes than it explores in."""
    model = tiny_pearl()
    adaptation = begin(model, "prior")
    np.testing.assert_array_equal(adaptation.explorer.final_z(), adaptation.explorer.z, "nothing was tried yet")
    play(adaptation, [[1.0], [0.0], [2.0]])
    drawn = np.stack([adaptation.explorer.final_z()[0] for _ in range(200)])
    mean, deviation = adaptation.posterior()
    np.testing.assert_allclose(drawn.mean(axis=0), mean[0], atol=0.3 * deviation.max())
    np.testing.assert_allclose(drawn.std(axis=0), deviation[0], rtol=0.3)

    know_tasks(model, 6)
    adaptation = begin(model, "learned-prior", n_envs=200)
    _, rewards = walk(adaptation, np.full(200, 2.0), n_episodes=3)
    found = (rewards > 0).any(axis=(1, 2))
    assert adaptation.explorer.exploring().all() and (adaptation.explorer.z[found, 0] == 2).mean() < 0.5
    assert (adaptation.explorer.final_z()[found, 0] == 2).mean() > 0.9


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
    rows = np.random.default_rng(0).uniform(-1, 1, size=(50, 1, 4)).astype(np.float32)
    for i, row in enumerate(rows):
        adaptation.observe(step(row[:, :2], [1.0], i == 49, actions=row[:, 2:]))
    obs, actions = (th.tensor(rows[[9, 19, 29, 39, 49], 0, columns]) for columns in (slice(0, 2), slice(2, 4)))
    with th.no_grad():
        _, variance = model.policy.infer(Context(obs, actions, th.ones(5), obs, th.tensor([5])))
    np.testing.assert_allclose(adaptation.posterior()[1], variance.sqrt(), rtol=1e-5)


def test_a_goal_that_was_passed_between_two_steps_of_a_context_is_in_it(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    adaptation = begin(model, "aggregate", context_size=5)
    rows = np.random.default_rng(0).uniform(-1, 1, size=(50, 1, 4)).astype(np.float32)
    for i, row in enumerate(rows):
        adaptation.observe(step(row[:, :2], [5.0 * (i in (22, 23)) + (i == 23)], i == 49, actions=row[:, 2:]))
    kept = [9, 23, 29, 39, 49]
    obs, actions = (th.tensor(rows[kept, 0, columns]) for columns in (slice(0, 2), slice(2, 4)))
    with th.no_grad():
        mean, _ = model.policy.infer(Context(obs, actions, th.tensor([0.0, 6, 0, 0, 0]), obs, th.tensor([5])))
    np.testing.assert_allclose(adaptation.posterior()[0], mean, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("max_setbacks", [2, 4])
def test_it_settles_on_the_best_episode_after_setbacks(tiny_pearl: MakePEARL, max_setbacks: int) -> None:
    model = tiny_pearl()
    explorer = Aggregate(max_setbacks=max_setbacks)
    z = play(begin(model, explorer), [[0.0], [5.0], *[[1.0] for _ in range(max_setbacks)], [5.0], [5.0]])
    for episode in range(2, 2 + max_setbacks):
        assert (z[episode] != z[1]).any()
    for settled in z[2 + max_setbacks :]:
        np.testing.assert_array_equal(settled, z[1])


@pytest.mark.parametrize(("clearly_better", "settles"), [(1.02, True), (1.0, False)])
def test_an_episode_that_is_a_little_better_is_no_reason_to_search_on(
    tiny_pearl: MakePEARL, clearly_better: float, settles: bool
) -> None:
    explorer = Aggregate(clearly_better=clearly_better)
    z = play(begin(tiny_pearl(), explorer), [[5.0 + 0.01 * i] for i in range(SETBACKS + 3)])
    # It settles on the best of them
    for later in (1, 2):
        assert (z[SETBACKS + later] == z[SETBACKS]).all() == settles


def test_the_posterior_of_aggregate_sees_the_best_episode_only(tiny_pearl: MakePEARL) -> None:
    """The misses before it, whatever they were, make no difference."""
    model = tiny_pearl()
    ends = []
    for length_of_miss in (2, 7):
        adaptation = begin(model, "aggregate")
        play(adaptation, [[0]], length_of_miss)
        adaptation.generator = th.Generator().manual_seed(1)
        ends.append(play(adaptation, [[1]])[-1])
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-5)


# --- belief


@given(
    rewards=st.lists(st.sampled_from([0.0, 0.4, 1.0, 5.0, 5.5, 90.0]), min_size=1, max_size=30),
    n=st.integers(1, 6),
    doubt=st.sampled_from([1e-6, 0.02, 0.5]),
    temperature=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_the_belief_follows_bayes_rule(known: Any, rewards: list[float], n: int, doubt: float, temperature: float) -> None:
    """Step by step, with its formula written down once more."""
    model = known(n)
    adaptation = begin(model, {"name": "learned-prior", "doubt": doubt, "temperature": temperature})
    explorer = adaptation.explorer
    assert isinstance(explorer, LearnedPrior)
    deviation = model.policy.reward_model.deviation.item()
    expected = np.zeros(n)
    for i, reward in enumerate(rewards):
        place = i % (n + 1)
        adaptation.observe(step([[place, 0.0]], [reward], i % 4 == 3))
        chance = np.clip(1 / (1 + np.exp(-(20.0 - 40.0 * np.abs(place - np.arange(n))))), doubt, 1 - doubt)
        counts = reward > 0.5
        surprise = min(0.5 * ((reward - 5.0) / deviation) ** 2, -np.log(doubt))
        expected += temperature * ((np.log(chance) - surprise) if counts else np.log(1 - chance))
    weights = explorer.weights(np.arange(1))[0].numpy()
    assert np.isfinite(weights).all() and weights.sum() == pytest.approx(1, abs=1e-5)
    likelihood = np.exp(expected - expected.max())
    np.testing.assert_allclose(weights, likelihood / likelihood.sum(), atol=1e-3)


def test_it_goes_where_a_reward_may_still_be_and_stays_where_one_was(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 9)
    task = np.arange(9.0)
    places, rewards = walk(begin(model, "belief", 9), task, n_episodes=10, length=6)
    first = (rewards.reshape(9, -1) > 0).argmax(axis=1)
    assert (rewards.reshape(9, -1) > 0).any(axis=1).all() and first.max() < 20, "no place is visited in vain for long"
    visited = np.diff(places.reshape(9, -1), axis=1) != 0
    assert visited[:, :5].any(), "it turns elsewhere within an episode"
    assert (rewards[:, -3:] == 5.0).all() and (np.ptp(places[:, -3:], axis=(1, 2)) == 0).all()


@pytest.mark.parametrize(
    ("values", "chosen"),
    [
        ([1.0, 4.0, 3.0, 2.0], 1),
        # What is worth no more than unrewarded steps is not gone for, however much less the others are worth
        ([-1.0, -9.0, 0.5, -9.0], 2),
        # Of a dense proxy: all are costs, and the least is best
        ([-9.0, -7.0, -8.0, -3.0], 3),
    ],
)
def test_of_what_is_as_likely_it_goes_for_what_the_critics_value_most(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch, values: list[float], chosen: int
) -> None:
    model = tiny_pearl()
    known = know_tasks(model)

    def of_tasks(obs: Any, z: th.Tensor) -> th.Tensor:
        return th.tensor(values)[z[..., 0].long()]

    monkeypatch.setattr(model.policy, "values", of_tasks)
    adaptation = begin(model, "belief")
    adaptation.act(np.zeros((1, 2), dtype=np.float32))
    np.testing.assert_array_equal(adaptation.z, known[[chosen]])


def test_what_was_learnt_in_one_env_stays_there(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 5)
    both = walk(begin(model, "belief", 2), np.array([3.0, 1.0]), 4)
    alone = walk(begin(model, "belief", 1), np.array([3.0]), 4)
    np.testing.assert_array_equal(both[0][:1], alone[0])


def test_a_shorter_episode_beside_it_changes_nothing(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 9)

    def search(lengths: np.ndarray) -> list[float]:
        adaptation, places = begin(model, "belief", len(lengths)), []
        for i in range(1, 141):
            adaptation.explorer.look(np.zeros((len(lengths), 2), dtype=np.float32))
            place = adaptation.z[:, 0].copy()
            adaptation.observe(step(np.stack([place, place], axis=1), np.zeros(len(lengths)), i % lengths == 0))
            places.append(float(place[0]))
        return places

    alone = search(np.array([200]))
    assert (np.diff(alone) != 0).all(), "in a first episode, z is chosen at each step"
    assert search(np.array([200, 80])) == alone


def test_z_is_chosen_forty_times_in_an_episode_of_known_length(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 9)
    adaptation, places = begin(model, "belief"), list[float]()
    for i in range(480):
        adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
        places.append(float(adaptation.z[0, 0]))
        adaptation.observe(step([[places[-1], 0.0]], [0.0], i in (199, 399, 439, 479)))
    turns = np.flatnonzero(np.diff(places[200:])) + 1
    assert len(turns) > 20 and (turns % 5 == 0).all(), "after short ones, too"


def test_it_repeats_the_best_episode_unless_another_task_promises_more(tiny_pearl: MakePEARL) -> None:
    """Particle 1 is said to return 20 under task 0, and does not."""
    model = tiny_pearl()
    z = know_tasks(model, 3)
    model.knowledge.returns[1, 0] = 20.0
    adaptation = begin(model, "belief")
    places, rewards = walk(adaptation, np.array([0.0]), n_episodes=6)
    found = int((rewards[0].sum(axis=1) > 0).argmax())
    assert 1.0 in places[0, found + 1 :], "the one that promises more is tried"
    assert (places[0, -1] == 0).all() and rewards[0, -1].sum() > 0, "and then no more"
    np.testing.assert_array_equal(adaptation.explorer.final_z(), z[:1])


def test_an_episode_of_several_z_is_none_to_repeat(tiny_pearl: MakePEARL) -> None:
    """Acting with its last z from the start may find nothing."""
    model = tiny_pearl()
    know_tasks(model, 8)
    adaptation = begin(model, "belief")
    for i in range(6):
        adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
        place = adaptation.z[0, 0]
        adaptation.observe(step([[place, 0.0]], [9.0 * (i == 5)], i == 5))
    explorer = adaptation.explorer
    assert isinstance(explorer, Belief) and not explorer.exploring()[0] and explorer._best_z_return[0] == 0
    # What the encoder says of it returns a crumb: the belief knows better
    at = place
    play(adaptation, [[1.0], [0.0]])
    assert explorer._best_z_return[0] == 1 and explorer.final_z()[0, 0] == at
    play(adaptation, [[0.0], [5.0]])
    np.testing.assert_array_equal(explorer.final_z(), explorer._best_z)
    assert explorer._best_z_return[0] == 5, "more than half of what was found"


def test_what_several_z_found_is_searched_for_until_one_z_repeats_it(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 8)
    adaptation = begin(model, "belief")

    def episode(reward_at_the_end: float) -> set[float]:
        places = []
        for i in range(6):
            adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
            places.append(float(adaptation.z[0, 0]))
            adaptation.observe(step([[places[-1], 0.0]], [reward_at_the_end * (i == 5)], i == 5))
        return set(places)

    assert len(episode(9.0)) > 1, "the reward is found"
    assert len(episode(0.0)) == 1, "what the posterior says of it fails"
    assert len(episode(0.0)) > 1, "so the search goes on, within an episode"
    assert len(episode(0.0)) == 1, "and every other one has a single z: the reward may come late"
    assert len(episode(0.0)) > 1
    assert len(episode(4.5)) == 1, "half of what was found"
    assert [len(episode(0.0)) for _ in range(4)] == [1] * 4, "until one of these is rewarded"


def test_the_posterior_of_a_better_episode_is_tried_once(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 3)
    adaptation = begin(model, "belief")
    z = play(adaptation, [[5.0], [1.0], [1.0]])
    mean, _ = adaptation.posterior()
    np.testing.assert_array_equal(z[1], mean)
    assert (z[2] != mean).any() and (z[3] != mean).any()


@pytest.mark.parametrize(
    ("explorer", "worth", "growth", "turns"),
    [
        ("belief", 1.0, 1.0, True),
        ("belief", 1.0, 1 / 0.9, False),
        # Which promises nothing that could be kept
        ("belief", -1.0, 1.0, False),
        (ABLATIONS["belief, no giving up"], 1.0, 1.0, False),
    ],
)
def test_an_episode_whose_value_does_not_grow_searches_on(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch, explorer: str | Explorer, worth: float, growth: float, turns: bool
) -> None:
    """
    A z that was good may lead nowhere from where this one begins. On the way to a reward, values grow by 1 / gamma, less that
    of unrewarded steps.
    """
    model = tiny_pearl(gamma=0.9)
    know_tasks(model, 8)
    model.knowledge.task_free_value.fill_(-7.0)
    values = [worth]
    monkeypatch.setattr(model.policy, "values", lambda obs, z: th.full(z.shape[:2], values[0] - 7.0))
    adaptation = begin(model, explorer)
    found = play(adaptation, [[5.0], [5.0], [5.0]])[-1]
    z = []
    for i in range(20):
        adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
        z.append(adaptation.z[0].copy())
        adaptation.observe(step([[found[0, 0], 0.0]], [0.0], i == 19))
        values[0] *= growth
    assert (np.asarray(z) != z[0]).any() == turns
    assert (np.asarray(z[:7]) == z[0]).all(), "0.9 ** 6 of a promise is more than half of it"
    np.testing.assert_array_equal(adaptation.explorer.final_z()[0], z[0])


@pytest.mark.parametrize("explorer", ["belief", ABLATIONS["belief, no giving up"]])
def test_every_other_episode_searches_whether_one_between_was_given_up_or_not(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch, explorer: str | Explorer
) -> None:
    model = tiny_pearl(gamma=0.9)
    know_tasks(model, 8)
    values = [1.0]
    monkeypatch.setattr(model.policy, "values", lambda obs, z: th.full(z.shape[:2], values[0]))
    adaptation, searching = begin(model, explorer), []
    for episode in range(7):
        for i in range(6):
            adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
            if i == 0:
                assert isinstance(adaptation.explorer, Belief)
                searching.append(bool(adaptation.explorer._searching[0]))
            found = 9.0 * (episode == 0 and i == 5)
            adaptation.observe(step([[adaptation.z[0, 0], 0.0]], [found], i == 5))
            values[0] *= 0.6
        values[0] = 1.0
    assert searching == [True, False] * 3 + [True]


@pytest.mark.parametrize("explorer", ["belief", "aggregate", "prior", "learned-prior"])
def test_nothing_but_observations_actions_and_rewards_is_used(tiny_pearl: MakePEARL, explorer: str) -> None:
    """What infos say makes no difference, and neither does whether they say anything."""
    model = tiny_pearl()
    know_tasks(model)
    ends = []
    lies: list[dict[str, Any]] = [{}, {"task_free_reward": 5.0, "is_success": True, "task_id": 7}]
    for info in lies:
        adaptation = begin(model, explorer)
        for i in range(12):
            adaptation.explorer.look(np.zeros((1, 2), dtype=np.float32))
            given = step([[0.1 * i, 0.0]], [5.0 * (i == 4)], i % 3 == 2)
            adaptation.observe(given._replace(infos=[info]))
        ends.append(adaptation.z.copy())
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize("explorer", ["belief", "learned-prior"])
def test_before_any_task_is_known_z_is_from_the_prior(tiny_pearl: MakePEARL, explorer: str) -> None:
    z = begin(tiny_pearl(), explorer, n_envs=3).explorer
    z.look(np.zeros((3, 2), dtype=np.float32))
    assert np.isfinite(z.z).all() and np.abs(z.z).max() > 0.1
    assert np.isfinite(z.deviation()).all() and 0.5 < z.deviation().mean() < 1.5


# --- learned prior


def test_the_learned_prior_draws_training_tasks_and_then_from_the_posterior(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 6)
    model.knowledge.is_train[4:6] = False
    adaptation = begin(model, LearnedPrior(n_exploration_episodes=5, hindsight_share=0), n_envs=200)
    places, rewards = walk(adaptation, np.full(200, 2.0), n_episodes=8)
    assert (places == places[..., :1]).all(), "one z an episode"
    assert set(places[:, :5].flat) == {0, 1, 2, 3}, "draws with repetition, whatever was found"
    seen = (rewards[:, :5] > 0).any(axis=(1, 2))
    assert 0.7 < seen.mean() < 1 and (places[seen, 5:] == 2).mean() > 0.9
    assert (places[~seen, 5:] == 2).mean() > 0.6, "its misses count, too"
    assert not adaptation.explorer.exploring().any()
    mean, _ = adaptation.posterior()
    assert len(np.unique(mean, axis=0)) > 1, "the encoder's posterior, too, is over all episodes"


def test_the_learned_prior_may_be_wrong(tiny_pearl: MakePEARL) -> None:
    """A task that is none of training: a small share of the prior is for it, which misses make large."""
    model = tiny_pearl()
    know_tasks(model, 6)
    model.knowledge.is_train[4:6] = False
    solved = []
    for share in (0.0, 0.03, 1.0):
        adaptation = begin(model, LearnedPrior(hindsight_share=share), n_envs=200)
        places, rewards = walk(adaptation, np.full(200, 5.0), n_episodes=20)
        assert (places[:, :5] >= 4).mean() == pytest.approx(share, abs=0.02)
        solved.append((rewards[:, -1] > 0).any(axis=1).mean())
    assert solved[0] == 0 and min(solved[1:]) > 0.9
    with pytest.raises(ValueError, match="hindsight_share is 2, expected a number from 0 to 1"):
        LearnedPrior(hindsight_share=2)


def test_what_is_known_about_z_before_a_reward(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    # The aggregate of a new model is N(0, I)
    settings: list[tuple[Any, float]] = [("prior", 1.0), ("aggregate", 1.5), (Aggregate(scale=3.0), 3.0)]
    for explorer, expected in settings:
        adaptation = model.start_adaptation(4, explorer=explorer)
        np.testing.assert_allclose(adaptation.explorer.deviation(), np.full((4, 3), expected), rtol=1e-6)
        mean, deviation = adaptation.posterior()
        assert (mean == 0).all() and (deviation == 1).all() and mean.shape == (4, 3)


def sure_of_the_first(model: Any, n: int = 4) -> np.ndarray:
    known = know_tasks(model, n)
    model.knowledge.log_prior[:n] = th.tensor([0.0, *[-4.0] * (n - 1)])
    return known


def test_it_goes_for_what_is_likely_though_the_critics_value_another_a_little_more(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_pearl()
    known = sure_of_the_first(model)
    monkeypatch.setattr(model.policy, "values", lambda obs, z: 1 + 0.1 * z[..., 0])
    adaptation = begin(model, "belief")
    adaptation.act(np.zeros((1, 2), dtype=np.float32))
    np.testing.assert_array_equal(adaptation.z, known[:1])


@pytest.mark.parametrize("reward", [0.5, 5.0])
def test_two_searches_that_end_in_vain_tell_against_their_aim_whatever_it_pays(tiny_pearl: MakePEARL, reward: float) -> None:
    model = tiny_pearl()
    sure_of_the_first(model)
    model.knowledge.gain *= reward / 5
    adaptation = begin(model, Belief(temperature=0.0))
    explorer = adaptation.explorer
    assert isinstance(explorer, Belief)
    for doubts in (1, 0.005 / 0.995):
        play(adaptation, [[0.0]])
        weights = explorer.weights(np.arange(1))[0]
        assert (weights[0] / weights[1]).item() == pytest.approx(np.exp(4) * doubts, rel=1e-4)


def test_it_goes_for_the_episode_that_earns_most_under_the_likely_task(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which may be that of another task."""
    model = tiny_pearl()
    known = sure_of_the_first(model)
    monkeypatch.setattr(model.policy, "values", lambda obs, z: th.ones(z.shape[:2]))
    model.knowledge.gain[1, 0] = model.knowledge.returns[1, 0] = 20.0
    adaptation = begin(model, "belief")
    adaptation.act(np.zeros((1, 2), dtype=np.float32))
    np.testing.assert_array_equal(adaptation.z, known[1:2])
    assert isinstance(adaptation.explorer, Belief)
    adaptation.explorer._best_return[:] = 9.0  # found with several z
    np.testing.assert_array_equal(adaptation.explorer.final_z(), known[1:2])


@pytest.mark.filterwarnings("ignore:Each step returned")
def test_what_promises_a_little_more_than_the_best_episode_is_not_tried(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 3)
    model.knowledge.returns[1, 0] = 5 * 3 * 1.01
    places, rewards = walk(begin(model, "belief"), np.array([0.0]), n_episodes=8)
    found = int((rewards[0].sum(axis=1) == 15).argmax())
    assert rewards[0, found].sum() == 15 and 1.0 not in places[0, found + 1 :]


def test_an_episode_that_is_a_little_better_is_no_new_word_of_the_encoder(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 3)
    adaptation, words = begin(model, "belief"), []
    for returns in (5.0, 5.05, 6.0):
        play(adaptation, [[returns]])
        words.append(adaptation.posterior()[0])
    assert (words[1] == words[0]).all() and (words[2] != words[0]).any()


def test_the_share_of_hindsight_tasks_is_what_it_says(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    know_tasks(model, 6)
    model.knowledge.is_train[4:6] = False
    z = begin(model, LearnedPrior(hindsight_share=0.3), n_envs=4000).z
    assert (z[:, 0] >= 4).mean() == pytest.approx(0.3, abs=0.03)


def test_each_setback_widens_the_posterior_by_its_deviation(tiny_pearl: MakePEARL) -> None:
    n = 4000
    adaptation = begin(tiny_pearl(), "aggregate", n_envs=n)
    z = play(adaptation, [[5.0] * n, [1.0] * n, [1.0] * n])
    deviation = adaptation.posterior()[1][0]
    for setbacks in (0, 1, 2):
        np.testing.assert_allclose(z[1 + setbacks].std(axis=0), (1 + setbacks) * deviation, rtol=0.1)
