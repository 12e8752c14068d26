"""PEARL without relabelling learns tasks that may change anything: no hook, no successes, observations of float64."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit

from helpers import TINY, MakePEARL, parameters
from helpers.broken_envs import LineEnv
from helpers.carts import CartEnv, make_cart
from sb3_htr import PEARL, evaluate_adaptation, load_untrusted
from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.common.vec_env import make_task_vec_env

PLAIN: dict[str, Any] = {
    "explorer": {"name": "prior", "n_exploration_episodes": 1},
    "train_explorer": {"name": "prior", "n_exploration_episodes": 1},
    "replay_buffer_kwargs": {"relabel_probability": 0.0},
    "n_tasks_per_rollout": 2,
}
gym.register("Cart-v0", entry_point="helpers.carts:CartEnv", max_episode_steps=10)


def test_it_trains_adapts_and_goes_on(tiny_pearl: MakePEARL, tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    model = tiny_pearl(make_cart(), **PLAIN)
    model.learn(200)
    assert model._n_updates > 0 and model.replay_buffer is not None and model.task_bank is not None
    assert set(np.flatnonzero(model.replay_buffer.n_episodes)) == {0, 1}
    data = model.replay_buffer.sample(4, context_size=4, n_labelled=8)
    assert data.labels is None and not data.relabelled.any()
    assert model.task_bank.n_solved == 0 and model.knowledge.n_particles == 0
    assert "rollout/train_tasks_reached" not in model.logger.name_to_value

    agent = model.adapt(make_cart(), n_episodes=3, task=np.array([3.0]))
    assert (agent.returns != 0).all() and not agent.successes.any(), "a large reward is no success"
    returns, successes = evaluate_adaptation(model, make_cart(), n_episodes=3)
    assert returns.shape == (1, 3) and not successes.any()
    assert record_adaptation(model, make_task_vec_env("Cart-v0", 2), n_episodes=2).achieved.shape[-1] == 0
    assert not [warning for warning in recwarn if "No reward was found" in str(warning.message)]

    model.save(tmp_path / "model")
    for loaded in (PEARL.load(tmp_path / "model"), load_untrusted(tmp_path / "model.zip", make_cart())):
        again, _ = evaluate_adaptation(loaded, make_cart(), n_episodes=3)
        np.testing.assert_array_equal(again, returns)
        with pytest.raises(ValueError, match="The explorer 'belief' goes by successes"):
            loaded.adapt(make_cart(), explorer="belief")

    resumed = tiny_pearl(make_cart(), **PLAIN)
    state = copy.deepcopy(model.state_dict())
    for trained in (model, resumed):
        trained.load_state_dict(copy.deepcopy(state))
        trained.learn(100, reset_num_timesteps=False)
    for name, value in parameters(model).items():
        th.testing.assert_close(parameters(resumed)[name], value, rtol=0, atol=0, msg=name)


def test_rewards_that_no_family_tells_may_be_any(tiny_pearl: MakePEARL) -> None:
    """What stands between them and the replay is a part of the env, but for what is not saved with the model."""
    env = make_cart()
    env.unwrapped.reward_type = "dense"  # type: ignore[attr-defined]
    scaled = gym.wrappers.TransformReward(env, lambda reward: 100 * float(reward))
    model = tiny_pearl(scaled, **PLAIN).learn(100)
    assert model.replay_buffer is not None
    rows = model.replay_buffer.episodes.take(np.arange(model.replay_buffer.size()))
    columns = model.replay_buffer.transitions
    np.testing.assert_allclose(rows[:, columns.reward], 100 * rows[:, columns.next_observation][:, 0], rtol=1e-5)
    with pytest.raises(ValueError, match="NormalizeReward stands between the env and what is learned from"):
        tiny_pearl(gym.wrappers.NormalizeReward(make_cart()), **PLAIN)


class Wired(CartEnv):
    """Has attributes of usual names, which the base class must not have taken."""

    def _observation(self) -> Any:
        return [self.x]

    def _current(self) -> float:
        return 2.0

    def _given(self, action: Any) -> float:
        return float(action[0])

    def _reset_state(self) -> Any:
        super()._reset_state()
        return self._observation()

    def _step_state(self, action: Any) -> Any:
        self.x += self._current() * self._given(action)
        return self._observation(), self.x, False


def test_methods_of_ones_own_meet_none_of_the_base_class() -> None:
    env = TimeLimit(Wired(), 10)
    obs, _ = env.reset(seed=0)
    for _ in range(3):
        after = env.step(np.array([0.5], dtype=np.float32))[0]
        np.testing.assert_allclose(after, obs + 1.0)
        obs = after


def test_the_posterior_is_that_of_the_rewards(tiny_pearl: MakePEARL) -> None:
    """The explorer of rollouts draws from it, though no reward is a success."""
    model = tiny_pearl(make_cart(), **PLAIN).learn(100)
    adaptation = model.start_adaptation(1, is_training=True)
    before = adaptation.posterior()[0]
    env = model.get_env()
    assert env is not None
    obs = np.asarray(env.reset())
    list(adaptation_steps(env, adaptation, 1, model.policy.unscale_action, adaptation.act, obs))
    assert (adaptation.posterior()[0] != before).any() and not adaptation.explorer.exploring().any()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"replay_buffer_kwargs": {}}, "task_family has no compute_reward.*'relabel_probability': 0.*explorer='prior'"),
        ({"replay_buffer_kwargs": {"relabel_probability": 0, "rl_reward_type": "dense"}}, "task_family has no compute_reward"),
        ({"explorer": "belief"}, "The explorer 'belief' goes by successes, .*: pass explorer='prior'"),
        ({"explorer": "learned-prior"}, "The explorer 'learned-prior' goes by successes"),
        ({"train_explorer": "aggregate"}, "The explorer 'aggregate' goes by successes.* train_explorer='prior'"),
    ],
)
def test_what_needs_successes_is_refused(tiny_pearl: MakePEARL, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_pearl(make_cart(), **{**PLAIN, **changed})


@pytest.mark.parametrize("task", [np.inf, -np.inf, np.nan])
def test_no_task_is_infinite(task: float) -> None:
    """A space without bounds holds it."""
    env = CartEnv()
    env.task_family.task_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(ValueError, match=r"The task \[.*\] is not in Box.*: pass a vector of the task space"):
        env.reset(options={"task": [task]})


class DoubleEnv(LineEnv):
    """Its observations are those of a line, in float64."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Box(-5.0, 5.0, (2,), np.float64)

    def observe(self) -> Any:
        return super().observe().astype(np.float64)


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_float64_observations_teach_what_float32_does(tmp_path: Path) -> None:
    models, agents = [], []
    for env_class in (LineEnv, DoubleEnv):
        model = PEARL("MlpPolicy", TimeLimit(env_class(), 10), **TINY).learn(240)
        env = TimeLimit(env_class(), 10)
        env.reset(seed=0)
        agents.append(model.adapt(env, n_episodes=3, task=0, explorer="prior"))
        models.append(model)
    single, double = models
    assert type(copy.deepcopy(double).env) is type(double.env), "a copy rounds, too"
    assert single.observation_space == double.observation_space
    for name, value in parameters(single).items():
        th.testing.assert_close(parameters(double)[name], value, rtol=0, atol=0, msg=name)
    np.testing.assert_array_equal(agents[0].returns, agents[1].returns)
    obs = DoubleEnv().observe()
    assert obs.dtype == np.float64
    actions = [agent.predict(x, deterministic=True)[0] for agent in agents for x in (obs, obs.astype(np.float32))]
    for action in actions[1:]:
        np.testing.assert_array_equal(action, actions[0])
    # Each model takes the other's env
    ours, theirs = (
        evaluate_adaptation(model, TimeLimit(env_class(), 10), n_episodes=2)[0]
        for model, env_class in ((single, DoubleEnv), (double, LineEnv))
    )
    np.testing.assert_array_equal(ours, theirs)
    double.save(tmp_path / "model")
    assert PEARL.load(tmp_path / "model", env=TimeLimit(DoubleEnv(), 10)).observation_space.dtype == np.float32
