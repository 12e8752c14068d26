"""What users of Stable-Baselines3 rely on in any algorithm."""

import copy
import pickle
import warnings
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.sac.policies import Actor

from helpers import ENV_ID, ROLLOUT, TINY, MakePEARL
from helpers import parameters as all_parameters
from helpers.envs import Rescaled
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation import MetaEvalCallback
from sb3_htr.common.checkpoint import load_latest
from sb3_htr.common.checkpoint_callback import CheckpointCallback as Checkpointing
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.rivals.rl2 import RL2


def test_parameters_can_be_read_and_set(tiny_pearl: MakePEARL) -> None:
    model, other = tiny_pearl().learn(2 * ROLLOUT), tiny_pearl(seed=5)
    parameters: dict[str, Any] = model.get_parameters()
    assert set(parameters) == {
        "policy",
        "knowledge",
        "actor.optimizer",
        "critic.optimizer",
        "encoder.optimizer",
        "reward_model.optimizer",
    }
    other.set_parameters(parameters)
    for name, value in all_parameters(model).items():
        assert th.equal(value, all_parameters(other)[name]), name
    with pytest.raises(ValueError, match="Names of parameters do not match"):
        other.set_parameters({"policy": parameters["policy"]})
    other.set_parameters({"policy": parameters["policy"]}, exact_match=False)


def test_deterministic_predictions_repeat_and_others_do_not(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    obs, z = np.zeros((3, 2), dtype=np.float32), np.zeros((3, 3), dtype=np.float32)
    same = [model.predict(obs, (z,), deterministic=True)[0] for _ in range(2)]
    np.testing.assert_array_equal(same[0], same[1])
    assert (model.predict(obs, (z,))[0] != model.predict(obs, (z,))[0]).any()
    single, _ = model.predict(obs[0], (z[:1],), deterministic=True)
    assert single.shape == (2,)
    np.testing.assert_allclose(single, same[0][0], atol=1e-6)


def test_predicting_leaves_training_mode_and_gradients_alone(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    model.predict(np.zeros(2, dtype=np.float32), (np.zeros((1, 3), dtype=np.float32),))
    assert not model.policy.training
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.predict(np.zeros(2, dtype=np.float32), (np.zeros((1, 3), dtype=np.float32),))
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())


def test_training_goes_on_without_resetting_the_count(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    episodes, updates = model._episode_num, model._n_updates
    model.learn(ROLLOUT, reset_num_timesteps=False)
    assert model.num_timesteps == 3 * ROLLOUT and model._episode_num > episodes and model._n_updates > updates
    model.learn(ROLLOUT)
    assert model.num_timesteps == ROLLOUT


def test_a_model_that_goes_on_without_its_experience_says_so(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4))
    with pytest.warns(UserWarning, match="The experience that this model was trained on is not there.*load_replay_buffer"):
        loaded.learn(ROLLOUT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4))
        whole.load_replay_buffer(tmp_path / "buffer")
        whole.learn(ROLLOUT)
        model.learn(ROLLOUT)
        tiny_pearl().learn(2 * ROLLOUT)


@pytest.mark.parametrize("env", [ENV_ID, "one env"])
def test_a_deep_copy_learns_on_its_own(env: str, tiny_pearl: MakePEARL) -> None:
    settings = {} if env == ENV_ID else {"n_tasks_per_rollout": 1}
    model = tiny_pearl(ENV_ID if env == ENV_ID else gym.make(ENV_ID), **settings).learn(ROLLOUT)
    twin, before = copy.deepcopy(model), all_parameters(model)
    twin.learn(2 * ROLLOUT, reset_num_timesteps=False)
    assert twin.num_timesteps == 3 * ROLLOUT and model.num_timesteps == ROLLOUT
    assert all(th.equal(value, before[name]) for name, value in all_parameters(model).items())
    assert any(not th.equal(value, before[name]) for name, value in all_parameters(twin).items())


def test_an_evaluation_leaves_numpys_generator_alone(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    before = np.random.get_state(legacy=False)
    evaluate_adaptation(model, ENV_ID, n_episodes=1)
    np.testing.assert_equal(np.random.get_state(legacy=False), before)


def test_sb3s_callbacks_work(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    save = CheckpointCallback(60, str(tmp_path), save_replay_buffer=True)
    stop = StopTrainingOnMaxEpisodes(max_episodes=10)  # of each env
    model = tiny_pearl()
    model.learn(10 * ROLLOUT, callback=CallbackList([save, stop]))
    assert model.num_timesteps < 10 * ROLLOUT and model._episode_num >= 36
    assert list(tmp_path.glob("*.zip")) and list(tmp_path.glob("*replay_buffer*"))


def test_a_callback_that_an_evaluation_calls_goes_on_where_it_was(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """A training that learns nothing is stopped at the same step, interrupted or not."""
    steps = []
    for parts in ([40 * ROLLOUT], [6 * ROLLOUT, 40 * ROLLOUT]):
        run = tmp_path / str(len(parts))
        for i, total in enumerate(parts):
            model, patience = tiny_pearl(learning_rate=0.0), StopTrainingOnNoModelImprovement(max_no_improvement_evals=6)
            evaluation = MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=1, callback_after_eval=patience, verbose=0)
            checkpointing = Checkpointing(1, str(run), companions=[evaluation])
            if i > 0:
                checkpointing.restore(model, load_latest(run)[1])
            model.learn(total - model.num_timesteps, [checkpointing, evaluation], reset_num_timesteps=False)
        steps.append(model.num_timesteps)
    assert steps[0] == steps[1] < 40 * ROLLOUT


def test_the_logger_can_be_replaced(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    model.set_logger(configure(str(tmp_path), ["csv", "json"]))
    model.learn(3 * ROLLOUT)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"time/total_timesteps", "rollout/ep_rew_mean", "train/critic_loss", "train/learning_rate"} <= set(header)


def test_envs_can_be_replaced_by_equal_ones_only(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    model.set_env(make_task_vec_env(ENV_ID, 4))
    model.learn(ROLLOUT, reset_num_timesteps=False)
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(make_task_vec_env(ENV_ID, 3))
    with pytest.raises(ValueError, match="The env is a gymnasium VectorEnv"):
        model.set_env(gym.make_vec(ENV_ID, 4))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        tiny_pearl().set_env(make_task_vec_env("SparseTargetSpeed-v0", 4))
    with pytest.raises(ValueError, match=r"The env has another task family: its goal_distance is 0\.5"):
        model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.5}))


def test_actions_of_any_bounds(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(Rescaled(gym.make(ENV_ID)), n_tasks_per_rollout=2).learn(3 * ROLLOUT)
    actions, _ = model.predict(np.zeros((50, 2), dtype=np.float32), (np.random.randn(50, 3).astype(np.float32),))
    assert model.action_space.contains(actions[0].astype(np.float64))
    assert model.replay_buffer is not None
    stored = model.replay_buffer.episodes.rows[model.replay_buffer.episodes.index().rows][:, 2:4]
    assert np.abs(stored).max() <= 1 and stored.std() > 0.1


def test_a_dead_env_process_is_named_and_hangs_nothing(tiny_pearl: MakePEARL) -> None:
    from stable_baselines3.common.vec_env import SubprocVecEnv

    def make() -> gym.Env[Any, Any]:
        return Fragile(gym.make(ENV_ID))

    env = SubprocVecEnv([make, make], start_method="fork")
    with pytest.raises(
        RuntimeError, match=r"At env step \d+, on one of the training tasks \[\d+, \d+\], the process of an env died"
    ):
        tiny_pearl(env).learn(ROLLOUT)


def test_an_env_of_this_process_that_loses_its_connection_says_so_itself(tiny_pearl: MakePEARL) -> None:
    class Lost(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            raise ConnectionResetError("the robot is gone")

    with pytest.raises(ConnectionResetError, match="the robot is gone"):
        tiny_pearl(Lost(gym.make(ENV_ID))).learn(ROLLOUT)


class Fragile(gym.Wrapper[Any, Any, Any, Any]):
    n_steps = 0

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        if self.n_steps == 30:
            raise ZeroDivisionError("a bug of the env")
        return self.env.step(action)


def test_callbacks_see_what_sb3_has_in_a_rollout(tiny_pearl: MakePEARL) -> None:
    seen: list[dict[str, Any]] = []

    def look(local: dict[str, Any], _: Any) -> bool:
        seen.append({name: local[name] for name in ("actions", "buffer_actions", "new_obs", "rewards", "dones", "infos")})
        return True

    model = tiny_pearl(seed=0).learn(ROLLOUT, look)
    first = seen[0]
    assert model.replay_buffer is not None
    np.testing.assert_allclose(model.policy.scale_action(first["actions"]), first["buffer_actions"], atol=1e-6)
    # The point moves by a tenth of its action
    np.testing.assert_allclose(first["new_obs"], 0.1 * first["actions"], atol=1e-6)
    ended = [local for local in seen if local["dones"].all()]
    assert ended and all((local["new_obs"] == 0).all() for local in ended), "each episode begins in the middle"
    assert all((info["terminal_observation"] != 0).any() for local in ended for info in local["infos"])


def test_an_actor_of_ones_own_acts_and_learns() -> None:
    class AlwaysRight(Actor):
        def get_action_dist_params(self, obs: Any) -> Any:
            mean, log_std, kwargs = super().get_action_dist_params(obs)
            return 0 * mean + 3, 0 * log_std - 5, kwargs

    class Policy(PEARLPolicy):
        def make_actor(self, features_extractor: Any = None) -> Actor:
            actor = AlwaysRight(**self._update_features_extractor(self.actor_kwargs, features_extractor))
            actor.mu = th.nn.Sequential(actor.mu, th.nn.Hardtanh())
            return actor

    seen: list[np.ndarray] = []

    def look(local: dict[str, Any], _: Any) -> bool:
        seen.append(local["actions"])
        return True

    model = PEARL(Policy, ENV_ID, **TINY).learn(2 * ROLLOUT, look)
    assert (seen[0] < 0).any() and (seen[-1] > 0.9).all(), "random ones first"
    assert model._n_updates > 0 and (model.adapt(ENV_ID, 1, task=0).predict(np.zeros(2, dtype=np.float32))[0] > 0.9).all()


def test_an_actor_whose_own_part_would_not_be_asked_is_refused() -> None:
    class Sampler(Actor):
        def action_log_prob(self, obs: Any) -> Any:
            return super().action_log_prob(obs)

    class Policy(PEARLPolicy):
        def make_actor(self, features_extractor: Any = None) -> Actor:
            return Sampler(**self._update_features_extractor(self.actor_kwargs, features_extractor))

    with pytest.raises(ValueError, match="The actor Sampler overrides action_log_prob, which nothing calls"):
        PEARL(Policy, ENV_ID, **TINY)


def test_experience_has_a_file_of_its_own(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"replay_buffer is no part of a model's file, .*: call save_replay_buffer"):
        tiny_pearl().save(tmp_path / "model", include=["replay_buffer"])
    assert not any(tmp_path.iterdir())


def test_a_model_of_an_id_can_be_sent_to_another_process(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(ENV_ID).learn(ROLLOUT)
    for loads, dumps in ((pickle.loads, pickle.dumps), (pickle.loads, cloudpickle.dumps)):
        copied = loads(dumps(model))
        assert copied.num_timesteps == ROLLOUT
        copied.learn(ROLLOUT, reset_num_timesteps=False)


def test_seeds_of_numpy_are_seeds(tiny_pearl: MakePEARL) -> None:
    for model in (tiny_pearl(), RL2("MlpLstmPolicy", ENV_ID)):
        model.set_random_seed(np.int64(3))  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="seed is -1, expected a whole number from 0"):
            model.set_random_seed(-1)
    make_task_vec_env(ENV_ID, 2, seed=np.int64(2)).reset()  # type: ignore[arg-type]


def test_adam_may_be_told_how_to_work(tiny_pearl: MakePEARL) -> None:
    for how in ({"foreach": True}, {"fused": False}, {"weight_decay": 1e-3}):
        model = tiny_pearl(policy_kwargs={"optimizer_kwargs": how, "net_arch": [8]}).learn(2 * ROLLOUT)
        assert how.items() <= model.actor.optimizer.defaults.items()
