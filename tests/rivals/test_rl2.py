"""RL2: trials, the memory of them, and what every rival does."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from helpers import ENV_ID
from helpers.carts import make_cart
from helpers.envs import times_three
from sb3_htr import evaluate_adaptation
from sb3_htr.adaptation.adaptation import Step
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.rivals.rl2 import RL2, TrialAdaptation
from sb3_htr.rivals.trial_policy import TrialLstmPolicy
from sb3_htr.rivals.trials import TrialVecEnv

N_STEPS = 20
vec_envs = pytest.mark.parametrize("vec_env_class", [None, DummyVecEnv], ids=["batched", "single"])


def tiny_rl2(env: Any = None, **kwargs: Any) -> RL2:
    """An RL2 that trains in a moment, 80 steps a rollout."""
    env = make_task_vec_env(ENV_ID, 2, seed=0) if env is None else env
    settings: dict[str, Any] = {"n_episodes_per_trial": 2, "n_trials_per_rollout": 1, "n_epochs": 1, "seed": 0}
    settings["policy_kwargs"] = {"lstm_hidden_size": 4, "net_arch": [4]}
    return RL2("MlpLstmPolicy", env, **{**settings, **kwargs})


@vec_envs
def test_a_trial_is_several_episodes_on_one_task(vec_env_class: Any) -> None:
    inner = make_task_vec_env(ENV_ID, 3, seed=0, vec_env_class=vec_env_class)
    env, rng = TrialVecEnv(inner, n_episodes=2), np.random.default_rng(0)
    obs = env.reset()
    assert isinstance(obs, np.ndarray) and obs.shape == (3, 2 + 2 + 1 + 1)
    np.testing.assert_array_equal(obs[:, 2:], [[0, 0, 0, 1]] * 3)
    tasks, all_dones = [], []
    for step in range(1, 4 * N_STEPS + 1):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        tasks.append(inner.get_attr("task_id"))
        obs, rewards, dones, infos = env.step(actions)
        assert isinstance(obs, np.ndarray)
        all_dones.append(dones)
        seen = np.stack([info["terminal_observation"] for info in infos]) if dones.any() else obs
        np.testing.assert_allclose(seen[:, 2:4], actions, atol=1e-6)
        np.testing.assert_allclose(seen[:, 4], rewards)
        assert (seen[:, 5] == (step % N_STEPS == 0)).all(), "whether an episode begins"
        if dones.any():
            np.testing.assert_array_equal(obs[:, 2:], [[0, 0, 0, 1]] * 3)
            assert not any(info["TimeLimit.truncated"] for info in infos), "what follows is another trial"
    assert np.flatnonzero(np.any(all_dones, axis=1)).tolist() == [2 * N_STEPS - 1, 4 * N_STEPS - 1]
    first, second = np.array(tasks[: 2 * N_STEPS]), np.array(tasks[2 * N_STEPS :])
    assert (first == first[0]).all() and (second == second[0]).all() and (first[0] != second[0]).any()


class InTuples(VecEnvWrapper):
    """Has its infos in a tuple, as SB3's SubprocVecEnv has."""

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        infos_in_a_tuple: Any = tuple(infos)
        return obs, rewards, dones, infos_in_a_tuple


def test_infos_may_be_in_a_tuple() -> None:
    model = tiny_rl2(InTuples(make_task_vec_env(ENV_ID, 2, seed=0)))
    assert model.learn(160).num_timesteps == 160


def test_the_policy_sees_at_meta_test_what_it_saw_in_training() -> None:
    model = tiny_rl2()
    trials, plain = (make_task_vec_env(ENV_ID, 2, seed=0, env_kwargs={"goal_distance": 0.2}) for _ in range(2))
    trial_env = TrialVecEnv(trials, n_episodes=2)
    expected, obs = trial_env.reset(), plain.reset()
    plain.set_options([{"task_id": task} for task in trials.get_attr("task_id")])
    obs = plain.reset()
    adaptation = TrialAdaptation(model.policy, 2, n_episodes_per_trial=2)
    state: Any = None
    begins = np.ones(2, dtype=bool)
    for step in range(2 * N_STEPS):
        assert isinstance(obs, np.ndarray) and isinstance(expected, np.ndarray)
        if step:
            np.testing.assert_allclose(adaptation._last.beside(obs), expected, atol=1e-6)
        in_training, state = model.policy.predict(expected, state, begins, deterministic=True)
        actions = adaptation.act(obs)
        np.testing.assert_allclose(model.policy.unscale_action(actions), in_training, atol=1e-5)
        expected, _, _, _ = trial_env.step(in_training)
        next_obs, rewards, dones, infos = plain.step(in_training)
        adaptation.observe(Step(obs, actions, rewards, next_obs, dones, infos))  # type: ignore[arg-type]
        obs, begins = next_obs, np.zeros(2, dtype=bool)


def test_episodes_beyond_a_trial_repeat_its_last_one() -> None:
    adaptation, rng = TrialAdaptation(tiny_rl2().policy, 2, n_episodes_per_trial=2), np.random.default_rng(0)
    memories = []
    for step in range(5 * 3):
        if step % 3 == 0:
            memories.append((adaptation._memory.copy(), adaptation._last.columns.copy()))
        obs = rng.normal(size=(2, 2)).astype(np.float32)
        actions = adaptation.act(obs)
        dones = np.full(2, step % 3 == 2)
        adaptation.observe(Step(obs, actions, rng.normal(size=2), obs, dones, [{"is_success": False}] * 2))
    for memory, last in memories[2:]:
        np.testing.assert_array_equal(memory, memories[1][0])
        np.testing.assert_array_equal(last, memories[1][1])
    assert not np.allclose(memories[0][0], memories[1][0])


def test_it_learns_and_is_the_same_after_save_and_load(tmp_path: Any) -> None:
    model = tiny_rl2()
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(160)
    assert any(not th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    model.save(tmp_path / "model")
    loaded = RL2.load(tmp_path / "model")
    assert loaded.n_episodes_per_trial == 2
    ours, theirs = (evaluate_adaptation(agent, ENV_ID, "validation", 3, seed=4) for agent in (model, loaded))
    np.testing.assert_array_equal(ours, theirs)
    loaded.set_env(make_task_vec_env(ENV_ID, 2))
    loaded.learn(80, reset_num_timesteps=False)
    assert loaded.num_timesteps == 240
    with pytest.raises(ValueError, match="this env are rollouts of 20 steps, but those of the model have 40"):
        loaded.set_env(make_task_vec_env(ENV_ID, 2, env_kwargs={"max_episode_steps": 10}))


def test_a_rollout_is_whole_trials_and_a_minibatch_some_of_them() -> None:
    model = tiny_rl2(n_episodes_per_trial=3, n_trials_per_rollout=2)
    assert model.n_steps == 2 * 3 * N_STEPS and model.batch_size == 4 * 3 * N_STEPS
    assert model.gamma == 1 - 1 / (3 * N_STEPS), "the discount reaches over a trial"
    assert tiny_rl2(n_episodes_per_trial=5).gamma == 0.99 and tiny_rl2(gamma=0.9).gamma == 0.9


@pytest.mark.parametrize(
    ("settings", "n_steps"),
    [({}, 40), ({"n_trials_per_rollout": 2}, 80), ({"n_episodes_per_trial": 3}, 60), ({"max_episode_steps": 10}, 20)],
)
def test_a_rollout_follows_from_what_load_is_given(settings: dict[str, Any], n_steps: int, tmp_path: Any) -> None:
    tiny_rl2().save(tmp_path / "model")
    env_kwargs = {name: settings.pop(name) for name in ("max_episode_steps",) if name in settings}
    loaded = RL2.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 2, env_kwargs=env_kwargs), **settings)
    assert loaded.n_steps == loaded.rollout_buffer.buffer_size == n_steps
    assert loaded.batch_size == 160 and loaded.gamma == 1 - 1 / 40, "settings of the file"
    assert loaded.learn(4 * n_steps).num_timesteps == 4 * n_steps, "two rollouts of two envs"


def test_settings_that_follow_from_a_trial_do_so_where_an_env_comes_after_load(tmp_path: Any) -> None:
    tiny_rl2(gamma=0.9, batch_size=40).save(tmp_path / "model")
    loaded = RL2.load(tmp_path / "model", gamma=None, batch_size=None)
    assert loaded.gamma == 1 - 1 / 40 and loaded.batch_size == 160
    loaded.set_env(make_task_vec_env(ENV_ID, 2))
    assert loaded.learn(160).num_timesteps == 160


def test_it_sees_observations_on_one_scale_and_rewards_as_they_are(tmp_path: Any) -> None:
    model = tiny_rl2(policy_kwargs={"normalize_observations": True})
    features = model.policy.features_extractor
    rows = th.tensor([[3.0, -4.0, 0.5, -0.5, 1.0, 0.0]])
    assert features(rows).tolist() == rows.tolist(), "nothing was observed yet"
    seen = []

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            seen.append(self.locals["obs_tensor"].numpy().copy())
            return True

    model.learn(80, Watch())  # a rollout
    obs = np.concatenate(seen)
    expected = (rows[0, :2].numpy() - obs[:, :2].mean(axis=0)) / obs[:, :2].std(axis=0)
    np.testing.assert_allclose(features(rows)[0, :2].numpy(), np.clip(expected, -10, 10), rtol=1e-4)
    assert features(rows)[0, 2:].tolist() == rows[0, 2:].tolist()
    model.save(tmp_path / "model")
    loaded = RL2.load(tmp_path / "model")
    ours, theirs = (evaluate_adaptation(agent, ENV_ID, "validation", 3, seed=4) for agent in (model, loaded))
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_steps": 128}, "RL2 has no setting 'n_steps': it follows from n_trials_per_rollout"),
        ({"batch_size": 79}, "batch_size is 79, and a rollout has 80 steps, so that a minibatch would have one, whose adv"),
        ({"policy_kwargs": {"normalize_observations": "yes"}}, "normalize_observations is 'yes', expected True or False"),
        (
            {"policy_kwargs": {"normalize_observations": True, "features_extractor_class": CombinedExtractor}},
            "normalize_observations has features of its own, in the place of CombinedExtractor",
        ),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_rl2(**settings)


def test_a_minibatch_of_one_step_is_fine_where_advantages_stay_as_they_are() -> None:
    assert tiny_rl2(batch_size=79, normalize_advantage=False).learn(160).num_timesteps == 160


def test_it_has_no_explorers() -> None:
    model = tiny_rl2()
    assert model.start_adaptation(2, "own").exploring().all()
    with pytest.raises(ValueError, match="RL2 has no explorers, but the explorer is 'prior': leave it out"):
        model.start_adaptation(2, "prior")


def test_tasks_may_change_anything() -> None:
    """Also when episodes end, so that trials of one rollout are of different lengths."""
    model = tiny_rl2(DummyVecEnv([make_cart, make_cart]), n_episodes_per_trial=3).learn(120)
    returns, _ = evaluate_adaptation(model, DummyVecEnv([make_cart]), n_episodes=4)
    assert returns.shape == (1, 4) and np.isfinite(returns).all()


def test_a_trial_is_one_call_of_the_lstm_and_the_library_would_learn_the_same() -> None:
    model = tiny_rl2(n_trials_per_rollout=2)
    model.learn(160)
    data: Any = next(model.rollout_buffer.get(100))  # of 160 steps: sequences begin within trials, too
    assert data.episode_starts.any()
    calls: list[Any] = []
    for lstm in (model.policy.lstm_actor, model.policy.lstm_critic):
        assert lstm is not None
        lstm.register_forward_hook(lambda *_: calls.append(1))
    by_library = RecurrentActorCriticPolicy.evaluate_actions
    gradients = []
    for of in (TrialLstmPolicy, RecurrentActorCriticPolicy):
        model.policy.__class__ = of
        model.policy.zero_grad()
        calls.clear()
        values, log_prob, _ = by_library(model.policy, data.observations, data.actions, data.lstm_states, data.episode_starts)
        (values.flatten() + log_prob)[data.mask > 0].sum().backward()
        gradients.append([th.as_tensor(parameter.grad).clone() for parameter in model.policy.parameters()])
        assert len(calls) == 2 if of is TrialLstmPolicy else len(calls) > 2
    for ours, theirs in zip(*gradients, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


def test_an_env_that_normalizes_is_refused_before_the_training() -> None:
    """It is at meta-test, where the training would be lost."""
    for env in (
        VecNormalize(make_task_vec_env(ENV_ID, 2)),
        DummyVecEnv([lambda: gym.wrappers.NormalizeObservation(gym.make(ENV_ID))]),
    ):
        with pytest.raises(ValueError, match=r"Normalize.* stands between the env and"):
            tiny_rl2(env)


def test_the_policy_of_trials_sees_actions_scaled() -> None:
    env = TrialVecEnv(make_task_vec_env(ENV_ID, 2, seed=0, wrapper=times_three), n_episodes=2)
    env.reset()
    obs, *_ = env.step(np.array([[3.0, -1.5], [0.0, 3.0]], dtype=np.float32))
    np.testing.assert_allclose(np.asarray(obs)[:, 2:4], np.array([[1, -0.5], [0, 1]]), atol=1e-6)
