"""Meta-test: the known mistakes of PEARL implementations, and the promises of the explorers."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ENV_ID
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.evaluation import evaluate_policy

from htr_envs import PointRobotFamily
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.adaptation.adaptation import MAX_SETBACKS, Adaptation
from sb3_htr.adaptation.context import evenly_spread
from sb3_htr.pearl.exploration import Explorer, LatentPrior
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.adaptation.task_bank import TaskBank
from sb3_htr.adaptation.explorers.task_belief import KnownTasks, TaskBelief

MakePEARL = Callable[..., PEARL]
ROLLOUT = 4 * 3 * 20


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "search"])
def test_meta_evaluation_works_before_any_training(tiny_pearl: MakePEARL, explorer: str) -> None:
    returns, successes = evaluate_adaptation(tiny_pearl(), ENV_ID, n_episodes=3, explorer=explorer)
    assert returns.shape == successes.shape == (20, 3)
    assert ((returns > 0) == successes).all()


def test_the_number_of_envs_does_not_matter(tiny_pearl: MakePEARL) -> None:
    """Tasks are adapted to side by side or one after the other; while nothing is found, the result is the same."""
    model = tiny_pearl().learn(2 * ROLLOUT)
    known_tasks(model.policy)
    tasks = PointRobotFamily().test_tasks[:5]
    results = [record_adaptation(model, make_task_vec_env(ENV_ID, n), tasks, n_episodes=3) for n in (1, 2, 5)]
    for result in results[1:]:
        found = results[0].successes.any(axis=1) | result.successes.any(axis=1)
        np.testing.assert_allclose(result.returns[~found], results[0].returns[~found])
        np.testing.assert_allclose(result.achieved[~found], results[0].achieved[~found], atol=1e-5)


def test_context_comes_from_the_adaptation_alone(tiny_pearl: MakePEARL) -> None:
    """garage took it from the replay buffer: whatever is stored there must change nothing."""
    model = tiny_pearl(explorer="prior").learn(2 * ROLLOUT)
    before = evaluate_adaptation(model, ENV_ID, n_episodes=4)
    assert model.replay_buffer is not None
    model.replay_buffer.episodes.rows[:] = 1e3
    after = evaluate_adaptation(model, ENV_ID, n_episodes=4)
    model.replay_buffer = None
    without = evaluate_adaptation(model, ENV_ID, n_episodes=4)
    for result in (after, without):
        for x, y in zip(before, result, strict=True):
            np.testing.assert_array_equal(x, y)


def test_tasks_do_not_share_context(tiny_pearl: MakePEARL) -> None:
    """A task's adaptation is the same whichever tasks are adapted to beside it."""
    model = tiny_pearl(explorer="prior")
    tasks = PointRobotFamily().test_tasks[:3].copy()
    before = record_adaptation(model, ENV_ID, tasks, n_episodes=4)
    tasks[1:] = [[9.0, 9.0], [0.0, 0.1]]
    after = record_adaptation(model, ENV_ID, tasks, n_episodes=4)
    np.testing.assert_array_equal(before.achieved[0], after.achieved[0])
    assert (before.achieved[2] != after.achieved[2]).any(), "a rewarded task must lead elsewhere"


def test_no_test_task_enters_the_replay_buffer(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    size = model.replay_buffer.size()
    evaluate_adaptation(model, ENV_ID, n_episodes=2)
    assert model.replay_buffer.size() == size
    family = model.replay_buffer.task_family
    train = {tuple(task) for task in family.train_tasks}
    assert not train & {tuple(task) for task in (*family.test_tasks, *family.validation_tasks)}
    # Had an env been given a test task, the buffer would refuse its steps
    env = gym.make(ENV_ID)
    _, info = env.reset(options={"task": family.test_tasks[0]})
    with pytest.raises(ValueError, match="only training tasks"):
        step = np.zeros((4, 2), dtype=np.float32)
        model.replay_buffer.add(step, step, step, np.zeros(4), np.zeros(4, bool), [info] * 4)


def test_achieved_tasks_are_the_path(tiny_pearl: MakePEARL) -> None:
    record = record_adaptation(tiny_pearl(), ENV_ID, n_episodes=2)
    assert record.achieved.shape == (20, 2, 20, 2) and np.isfinite(record.achieved).all()
    steps = np.abs(np.diff(record.achieved, axis=2))
    assert steps.max() <= 0.1 + 1e-6


# --- adapt()


def test_adapt_gives_an_agent_for_the_task_of_the_env(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    env = gym.make(ENV_ID)
    env.reset(seed=0, options={"task": np.array([0.05, 0.05], dtype=np.float32)})  # the start solves it
    agent = model.adapt(env, n_episodes=3)
    assert agent.returns.shape == (3,) and agent.successes.all()
    mean, _ = evaluate_policy(agent, env, n_eval_episodes=2, warn=False)
    assert isinstance(mean, float) and mean > 0
    assert env.unwrapped.task_id == -1  # type: ignore[attr-defined]
    obs, _ = env.reset()
    action, state = agent.predict(obs, deterministic=True)
    assert action.shape == (2,) and state is None


def test_adapt_says_when_nothing_was_found(tiny_pearl: MakePEARL) -> None:
    with pytest.warns(UserWarning, match="No reward was found in 2 episodes"):
        agent = tiny_pearl().adapt(ENV_ID, n_episodes=2, task=np.array([9.0, 9.0]))
    assert not agent.successes.any()


def test_adapt_keeps_one_task_when_the_env_has_none(tiny_pearl: MakePEARL) -> None:
    env = gym.make(ENV_ID, goal_distance=5.0)  # out of reach, so that no untrained policy finds it by chance
    with pytest.warns(UserWarning, match="No reward"):
        tiny_pearl().adapt(env, n_episodes=1)
    tasks = {tuple(env.reset()[0]) and tuple(env.unwrapped.task) for _ in range(5)}  # type: ignore[attr-defined]
    assert len(tasks) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.adapt(ENV_ID, n_episodes=0), "n_episodes is 0, expected at least 1"),
        (lambda m: m.adapt(make_task_vec_env(ENV_ID, 2)), "the VecEnv has 2 envs"),
        (lambda m: m.adapt(ENV_ID, task=80), "80"),
        (lambda m: m.adapt(ENV_ID, explorer="x"), "explorer is 'x', expected one of"),
        (lambda m: evaluate_adaptation(m, ENV_ID, n_episodes=0), "n_episodes is 0"),
        (lambda m: evaluate_adaptation(m, ENV_ID, np.zeros((0, 2))), "at least one task"),
        (lambda m: evaluate_adaptation(m, ENV_ID, np.zeros(2)), r"expected \(n_tasks, task_dim\)"),
    ],
)
def test_bad_requests(tiny_pearl: MakePEARL, call: Callable[[PEARL], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(tiny_pearl())


# --- how z is chosen


def known_tasks(policy: PEARLPolicy, n: int = 4, first_success: float = 2) -> KnownTasks:
    """Tasks without likeness: acting as if it were one of them finds that one alone, after ``first_success`` steps."""
    identity = np.eye(n, dtype=np.float32)
    z = np.arange(n * policy.latent_dim, dtype=np.float32).reshape(n, -1)
    known = KnownTasks(z, 5 * identity, np.where(identity, first_success, np.inf).astype(np.float32))
    policy.latent_prior.set_known_tasks(known)
    return known


def play(adaptation: Adaptation, rewards: list[list[float]], length: int = 3) -> list[np.ndarray]:
    """Episodes of ``length`` steps with the given return per env; the z of each episode."""
    z = []
    for returns in rewards:
        z.append(adaptation.z.copy())
        for step in range(length):
            reward = np.array(returns) if step == 0 else np.zeros(len(returns))
            rows = np.full((len(returns), 2), 0.1 * step, dtype=np.float32)
            done = np.full(len(returns), step == length - 1)
            adaptation.observe(rows, rows, reward, np.zeros(len(returns)), done)
    return [*z, adaptation.z.copy()]


def test_search_tries_every_known_task_once_until_a_reward(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    z_known = known_tasks(policy).z
    adaptation = Adaptation(policy, 2, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    z = np.stack(play(adaptation, [[0, 0], [0, 5], [0, 4], [0, 4]])[:4])
    assert sorted(map(tuple, z[:, 0])) == sorted(map(tuple, z_known)), "the first env has seen no reward"
    visited = (z[:, 1, None] == z_known).all(axis=2).any(axis=1)
    assert visited[:2].all()
    # The reward was that of the task visited, so the best guess is another one, and then it is the posterior's turn
    assert not visited[3], "after a reward and a setback, the posterior is used"


def test_a_visit_that_fails_turns_to_another_within_the_episode(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    z_known = known_tasks(policy, n=8, first_success=3).z
    adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    first = adaptation.z.copy()
    rows, nothing = np.zeros((1, 2), dtype=np.float32), np.zeros(1)
    seen = []
    for _ in range(10):
        adaptation.observe(rows, rows, nothing, nothing, np.array([False]))
        seen.append(adaptation.z.copy())
    assert (seen[3] == first).all(), "the visit has its time, and a fifth more, and a step"
    assert (seen[4] != first).any()
    assert (seen[4] == z_known).all(axis=1).any()
    assert len(np.unique(np.concatenate(seen), axis=0)) == 3
    # A reward is a reason to stay
    adaptation.observe(rows, rows, np.ones(1), nothing, np.array([False]))
    stay = adaptation.z.copy()
    for _ in range(10):
        adaptation.observe(rows, rows, nothing, nothing, np.array([False]))
        assert (adaptation.z == stay).all()


def test_an_episode_of_several_visits_is_no_success_to_settle_on(tiny_pearl: MakePEARL) -> None:
    """Acting with its last z from the start may find nothing."""
    policy = tiny_pearl().policy
    known_tasks(policy, n=8, first_success=1)
    adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    rows, nothing = np.zeros((1, 2), dtype=np.float32), np.zeros(1)
    for step in range(6):
        adaptation.observe(rows, rows, np.array([9.0 * (step == 5)]), nothing, np.array([step == 5]))
    assert not adaptation.exploring()[0]
    z = play(adaptation, [[1.0], [0.0]])
    np.testing.assert_array_equal(adaptation.frozen_z(), z[0])


def test_search_settles_on_the_best_episode_after_setbacks(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    known_tasks(policy, n=12)
    adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    z = play(adaptation, [[0.0], [5.0], *[[1.0] for _ in range(MAX_SETBACKS)], [5.0], [5.0]])
    for episode in range(2, 2 + MAX_SETBACKS):
        assert (z[episode] != z[1]).any()
    for settled in z[2 + MAX_SETBACKS :]:
        np.testing.assert_array_equal(settled, z[1])


def test_an_episode_that_is_a_little_better_is_no_reason_to_search_on(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    known_tasks(policy, n=12)
    adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    z = play(adaptation, [[5.0 + 0.01 * i] for i in range(MAX_SETBACKS + 3)])
    # It settles on the best of them
    np.testing.assert_array_equal(z[MAX_SETBACKS + 1], z[MAX_SETBACKS])
    np.testing.assert_array_equal(z[MAX_SETBACKS + 2], z[MAX_SETBACKS])


def test_the_posterior_of_search_sees_the_best_episode_only(tiny_pearl: MakePEARL) -> None:
    """The misses before it, whatever they were, make no difference."""
    policy = tiny_pearl().policy
    ends = []
    for length_of_miss in (2, 7):
        # Without known tasks, only the posterior is used
        adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
        play(adaptation, [[0]], length_of_miss)
        adaptation.generator = th.Generator().manual_seed(1)
        ends.append(play(adaptation, [[1]])[-1])
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-5)


def test_prior_explores_for_a_fixed_number_of_episodes(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    adaptation = Adaptation(policy, 1, Explorer.PRIOR, 3, 64, th.Generator().manual_seed(0))
    exploring = []
    for returns in ([1.0], [0.0], [0.0], [0.0]):
        exploring.append(bool(adaptation.exploring()[0]))
        play(adaptation, [returns])
    assert exploring == [True, True, True, False]


def test_aggregate_is_as_wide_as_it_says() -> None:
    prior = LatentPrior(2, aggregate_scale=1.5)
    means = th.randn(5000, 2, generator=th.Generator().manual_seed(0)) @ th.tensor([[2.0, 0], [1, 0.5]]) + 3
    prior.set_aggregate(means)
    z = prior.sample(Explorer.AGGREGATE, 20_000, th.Generator().manual_seed(1))
    th.testing.assert_close(z.mean(dim=0), means.mean(dim=0), atol=0.1, rtol=0)
    th.testing.assert_close(z.T.cov(), 1.5**2 * means.T.cov(), atol=0.3, rtol=0.1)


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


def test_known_tasks_are_those_that_were_ever_reached(tiny_pearl: MakePEARL) -> None:
    """Under the reward formula, written down here once more, each best episode does what it is said to do."""
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3}))
    model.learn(4 * ROLLOUT)
    bank, buffer = model.task_bank, model.replay_buffer
    assert isinstance(bank, TaskBank) and buffer is not None and len(bank.solved) > 20
    rows, lengths, returns, first_success = bank.best_episodes(buffer, 128, 20)
    assert (lengths == 20).all()
    context = rows.reshape(len(lengths), 20, -1)
    tasks = bank.task_family.train_tasks[bank.solved]
    position = context[..., :2] + 0.1 * np.clip(context[..., 2:4], -1, 1)
    distance = np.linalg.norm(position[:, None] - tasks[:, None], axis=-1)
    reward = np.where(distance < 0.2, 1 - distance, 0)
    np.testing.assert_allclose(returns, reward.sum(axis=-1), atol=0.9)  # a step on the rim may count or not
    assert (np.diag(returns) > 0).all() and (np.diag(first_success) < 20).all()
    np.testing.assert_array_equal(np.isfinite(first_success), returns > 0)
    np.testing.assert_allclose(context[..., -1], np.einsum("iit->it", reward), atol=0.9)
    known = model.policy.latent_prior.known_tasks()
    np.testing.assert_array_equal(known.returns, returns)
    fewer = bank.best_episodes(buffer, 7, 5)
    assert [len(array) for array in fewer] == [7 * 5, 7, 7, 7]


@given(st.lists(st.integers(1, 300), min_size=1, max_size=6), st.integers(1, 40))
def test_contexts_are_spread_over_their_episodes(lengths: list[int], size: int) -> None:
    steps, taken = evenly_spread(np.array(lengths), size)
    assert taken.tolist() == [min(length, size) for length in lengths]
    for episode, length in zip(np.split(steps, np.cumsum(taken)[:-1]), lengths, strict=True):
        # As far from each other as from the ends, up to rounding
        gaps = np.diff(np.concatenate([[-1 - episode[0]], episode, [2 * length - 1 - episode[-1]]]))
        assert episode.min() >= 0 and episode.max() < length and np.ptp(gaps) <= 2
        assert length > size or (episode == np.arange(length)).all()


def test_a_long_episode_narrows_the_posterior_as_much_as_a_context_of_training(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    adaptation = Adaptation(policy, 1, Explorer.AGGREGATE, 0, 5, th.Generator().manual_seed(0))
    rows = np.random.default_rng(0).normal(size=(50, 1, 5)).astype(np.float32)
    rows[..., -1] = 1.0
    for i, row in enumerate(rows):
        adaptation.observe(row[:, :2], row[:, 2:4], row[:, 4], np.zeros(1), np.array([i == 49]))
    _, variance = policy.encoder(th.tensor(rows[[5, 15, 25, 35, 45], 0]), th.tensor([5]))
    np.testing.assert_allclose(1 / adaptation._precision, variance.detach().numpy(), rtol=1e-5)


def test_the_frozen_agent_acts_with_what_is_known_to_work(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    known_tasks(policy)
    adaptation = Adaptation(policy, 2, Explorer.SEARCH, 0, 64, th.Generator().manual_seed(0))
    z = play(adaptation, [[0.0, 0.0], [5.0, 0.0], [1.0, 0.0]])
    np.testing.assert_array_equal(adaptation.frozen_z()[0], z[1][0])
    np.testing.assert_array_equal(adaptation.frozen_z()[1], adaptation.z[1])  # nothing is known to work


def test_what_is_known_about_z_before_a_reward(tiny_pearl: Callable[..., PEARL]) -> None:
    model = tiny_pearl()
    # The aggregate of a new model is N(0, I), drawn from with 1.5 times its deviation
    for explorer, expected in (("prior", 1.0), ("aggregate", 1.5), ("search", 1.5)):
        adaptation = model.start_adaptation(4, explorer=explorer)
        np.testing.assert_allclose(adaptation.deviation(), np.full((4, 3), expected), rtol=1e-6)
        mean, deviation = adaptation.posterior()
        assert (mean == 0).all() and (deviation == 1).all() and mean.shape == (4, 3)
