"""Meta-test: the known mistakes of PEARL implementations, and the promises of the explorers."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import ENV_ID
from stable_baselines3.common.evaluation import evaluate_policy

from htr_envs import PointRobotFamily
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.evaluation import record_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.adaptation import MAX_SETBACKS, Adaptation
from sb3_htr.pearl.exploration import Explorer, LatentPrior
from sb3_htr.pearl.task_bank import TaskBank

MakePEARL = Callable[..., PEARL]
ROLLOUT = 4 * 3 * 20


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "search"])
def test_meta_evaluation_works_before_any_training(tiny_pearl: MakePEARL, explorer: str) -> None:
    returns, successes = evaluate_adaptation(tiny_pearl(), ENV_ID, n_episodes=3, explorer=explorer)
    assert returns.shape == successes.shape == (20, 3)
    assert ((returns > 0) == successes).all()


def test_the_number_of_envs_does_not_matter(tiny_pearl: MakePEARL) -> None:
    """Tasks are adapted to side by side or one after the other; with a plan and without noise, the result is the same."""
    model = tiny_pearl().learn(2 * ROLLOUT)
    model.policy.latent_prior.set_plan(th.randn(5, 3), 5)
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
    env = gym.make(ENV_ID)
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


def test_search_follows_the_plan_until_a_reward_then_the_posterior(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    plan = th.arange(12.0).reshape(4, 3)
    policy.latent_prior.set_plan(plan, 4)
    adaptation = Adaptation(policy, 2, Explorer.SEARCH, 0, th.Generator().manual_seed(0))
    z = play(adaptation, [[0, 0], [0, 1], [0, 0]])
    for episode in range(4):
        np.testing.assert_array_equal(z[episode][0], plan[episode % 4])
    np.testing.assert_array_equal(z[1][1], plan[1])
    assert not (z[2][1] == plan.numpy()).all(axis=1).any(), "the second env was rewarded, so it uses the posterior"


def test_search_settles_on_the_best_episode_after_setbacks(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    policy.latent_prior.set_plan(th.randn(4, 3), 4)
    adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, th.Generator().manual_seed(0))
    z = play(adaptation, [[0.0], [5.0], *[[1.0] for _ in range(MAX_SETBACKS)], [5.0], [5.0]])
    for episode in range(2, 2 + MAX_SETBACKS):
        assert (z[episode] != z[1]).any()
    for settled in z[2 + MAX_SETBACKS :]:
        np.testing.assert_array_equal(settled, z[1])


def test_the_posterior_of_search_sees_the_best_episode_only(tiny_pearl: MakePEARL) -> None:
    """The misses before it, whatever they were, make no difference."""
    policy = tiny_pearl().policy
    policy.latent_prior.set_plan(th.zeros(4, 3), 4)
    ends = []
    for length_of_miss in (2, 7):
        adaptation = Adaptation(policy, 1, Explorer.SEARCH, 0, th.Generator().manual_seed(0))
        play(adaptation, [[0]], length_of_miss)
        adaptation.generator = th.Generator().manual_seed(1)
        ends.append(play(adaptation, [[1]])[-1])
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-5)


def test_prior_explores_for_a_fixed_number_of_episodes(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    adaptation = Adaptation(policy, 1, Explorer.PRIOR, 3, th.Generator().manual_seed(0))
    exploring = []
    for returns in ([1.0], [0.0], [0.0], [0.0]):
        exploring.append(bool(adaptation.exploring()[0]))
        play(adaptation, [returns])
    assert exploring == [True, True, True, False]


def test_aggregate_is_as_wide_as_it_says() -> None:
    prior = LatentPrior(2, aggregate_scale=1.5)
    means = th.randn(5000, 2, generator=th.Generator().manual_seed(0)) @ th.tensor([[2.0, 0], [1, 0.5]]) + 3
    prior.set_aggregate(means)
    z = prior.sample(Explorer.AGGREGATE, th.zeros(20_000, dtype=th.int64), th.Generator().manual_seed(1))
    th.testing.assert_close(z.mean(dim=0), means.mean(dim=0), atol=0.1, rtol=0)
    th.testing.assert_close(z.T.cov(), 1.5**2 * means.T.cov(), atol=0.3, rtol=0.1)


def test_search_plan_finds_every_task_that_was_ever_reached(tiny_pearl: MakePEARL) -> None:
    """Played back, the episodes of the plan solve all solved training tasks, in few visits."""
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3}))
    model.learn(4 * ROLLOUT)
    bank, buffer = model.task_bank, model.replay_buffer
    assert isinstance(bank, TaskBank) and buffer is not None and len(bank.solved) > 20
    context, mask = bank.search_plan(buffer, 32)
    assert (context[..., -1] * mask > 0).any(axis=1).all(), "each context holds the reward of its task"
    solved = bank.task_family.train_tasks[bank.solved]
    position = context[..., :2] + 0.1 * context[..., 2:4]
    distance = np.linalg.norm(position[:, :, None] - solved, axis=-1)
    found = (distance < 0.2 - 1e-5).any(axis=1)
    first = np.where(found.any(axis=0), found.argmax(axis=0), 99)
    assert first.max() < 32 and first.mean() < 6
    # A visit never goes first where another task would reveal more
    assert found[0].sum() > len(solved) / 5


def test_the_frozen_agent_acts_with_what_is_known_to_work(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    policy.latent_prior.set_plan(th.randn(4, 3), 4)
    adaptation = Adaptation(policy, 2, Explorer.SEARCH, 0, th.Generator().manual_seed(0))
    z = play(adaptation, [[0.0, 0.0], [5.0, 0.0], [1.0, 2.0]])
    np.testing.assert_array_equal(adaptation.frozen_z()[0], z[1][0])  # its posterior was worse
    np.testing.assert_array_equal(adaptation.frozen_z()[1], adaptation.z[1])  # its posterior is not tried yet
