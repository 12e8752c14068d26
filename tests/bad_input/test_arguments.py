"""Arguments of PEARL and of a training that cannot work are refused in one sentence, before any work is lost."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import HerReplayBuffer

from helpers import ENV_ID, ROLLOUT, MakePEARL, many
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.vec_env import make_task_vec_env


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"meta_batch_size": 0}, "meta_batch_size is 0, expected a whole number of at least 1"),
        ({"batch_size": -1}, "batch_size is -1"),
        ({"context_size": 0}, "context_size is 0"),
        ({"n_tasks_per_rollout": 0}, "n_tasks_per_rollout is 0"),
        ({"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class is HerReplayBuffer, expected MultiTaskReplayBuffer"),
        ({"n_episodes_per_task": 0}, "n_episodes_per_task is 0"),
        ({"kl_coef": -0.1}, "kl_coef is -0.1, expected a number of at least 0"),
        ({"final_kl_coef": -0.1}, "final_kl_coef is -0.1, expected a number of at least 0"),
        ({"kl_coef": 0.0, "final_kl_coef": 0.1}, "kl_coef and final_kl_coef are a factor apart, so neither may be 0"),
        ({"policy_kwargs": {"encoder_class": 3}}, r"encoder_class is 3, expected a class derived from torch\.nn"),
        ({"policy_kwargs": {"encoder_class": th.nn.GRU}}, "encoder_class GRU has no empty, extend, posterior"),
        ({"policy_kwargs": {"encoder_class": "Mine"}}, r"encoder_class is 'Mine', expected one of \['ContextEncoder', 'Prior"),
        ({"gamma": 1.1}, "gamma is 1.1, expected a number from 0 to 1"),
        ({"tau": float("nan")}, "tau is nan"),
        ({"tau": 0.0}, "tau is 0, with which the target critics would never learn"),
        ({"gradient_steps": 0}, "gradient_steps is 0"),
        ({"learning_starts": -1}, "learning_starts is -1"),
        ({"explorer": {"name": "prior", "n_exploration_episodes": -1}}, "n_exploration_episodes is -1"),
        ({"explorer": {"name": "prior", "scale": 1}}, "explorer 'prior' has no setting 'scale'"),
        ({"train_explorer": {"scale": 1}}, "train_explorer is {'scale': 1}, expected one of"),
        ({"replay_buffer_kwargs": {"hindsight_task_strategy": "even"}}, "has no setting 'hindsight_task_strategy': expected"),
        ({"replay_buffer_kwargs": {"relabeller": "HER"}}, "relabeller is 'HER', expected one of"),
        ({"replay_buffer_kwargs": {"relabeller": {"name": "EpisodeClustering", "cell": 1}}}, "'cell': did you mean cell_size"),
        ({"policy_kwargs": {"normalise_observations": True}}, "did you mean normalize_observations"),
        ({"replay_buffer_kwargs": {"relabel_probabilty": 1}}, "'relabel_probabilty': did you mean relabel_probability"),
        ({"replay_buffer_kwargs": {"grid": 1}}, "replay_buffer_kwargs has no setting 'grid': expected one of"),
        ({"explorer": "random"}, "explorer is 'random', expected one of"),
        ({"train_explorer": "random"}, "train_explorer is 'random'"),
        ({"matmul_precision": "bf16"}, r"matmul_precision is 'bf16', expected one of \['highest', 'high', 'medium'\]"),
        ({"policy_kwargs": {"latent_dim": 0}}, "latent_dim is 0, expected a whole number of at least 1"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics is 0, expected a whole number of at least 1"),
        ({"policy_kwargs": {"activation_fn": "ReLU"}}, r"activation_fn is 'ReLU', expected a class derived from torch\.nn"),
        ({"policy_kwargs": {"optimizer_class": "Adam"}}, r"optimizer_class is 'Adam', expected a class derived from torch\."),
        ({"policy_kwargs": {"use_next_obs_in_context": 1.5}}, "use_next_obs_in_context is 1.5, expected True or False"),
        ({"policy_kwargs": {"normalize_observations": "no"}}, "normalize_observations is 'no', expected True or False"),
        ({"policy_kwargs": {"use_sde": True}}, "policy_kwargs has no setting 'use_sde'"),
        ({"policy_kwargs": {"lr_schedul": 1}}, "policy_kwargs has no setting 'lr_schedul': expected one of"),
        ({"policy_kwargs": {"action_space": 1}}, "policy_kwargs has no setting 'action_space'"),
        ({"policy_kwargs": [1]}, r"policy_kwargs is \[1\], expected names and values"),
        ({"policy_kwargs": {"optimizer_kwargs": 3}}, "optimizer_kwargs is 3, expected names and values"),
        *(
            ({"policy_kwargs": {name: units}}, f"{name} is .*, expected the hidden units of each layer")
            for name in ("net_arch", "encoder_arch")
            for units in (64, [64.0], [0], [True], "64")
        ),
        *(
            ({"policy_kwargs": {"net_arch": layers}}, "net_arch is .*, expected layers for 'pi' and 'qf', or a list for both")
            for layers in ({"pi": [64]}, {"pi": [64], "qf": [64], "encoder": [200]})
        ),
        ({"policy_kwargs": {"net_arch": {"pi": None, "qf": [64]}}}, "pi is None, expected the hidden units of each layer"),
        ({"policy_kwargs": {"net_arch": {"pi": [64], "qf": [64.0]}}}, r"qf is \[64\.0\], expected the hidden units"),
        ({"replay_buffer_kwargs": 3}, "replay_buffer_kwargs is 3, expected names and values"),
        ({"replay_buffer_class": "HerReplayBuffer"}, "replay_buffer_class is HerReplayBuffer, expected MultiTaskReplayBuffer"),
        *(({"learning_rate": rate}, "learning_rate is .*, expected a number of at least 0") for rate in ("1e-3", None, -1)),
        *(({"target_entropy": value}, "target_entropy is .*, expected a number\\.") for value in ("x", None, np.nan, True)),
        *(({"policy": policy}, "policy is .*, expected a class derived from sb3_htr") for policy in (None, 3)),
        ({"verbose": "a"}, "verbose is 'a', expected a whole number"),
        ({"stats_window_size": 0}, "stats_window_size is 0, expected a whole number of at least 1"),
        ({"device": th.device("mps")}, "The device 'mps' cannot be used: give cpu"),
        ({"device": "meta"}, "The device 'meta' cannot be used: give cpu"),
        ({"device": None}, "The device 'None' cannot be used: give cpu"),
        ({"ent_coef": -0.1}, "ent_coef is -0.1, expected a number of at least 0"),
        *(
            ({"ent_coef": text}, f"ent_coef is the text '{text}', expected a number")
            for text in ("5e-2", "-0.5", "foo", "auto_0")
        ),
        ({"replay_buffer_kwargs": {"relabel_probability": -1}}, "relabel_probability is -1"),
        ({"buffer_size": 10}, "buffer_size is 10, too small"),
        ({"policy": "CnnPolicy"}, r"PEARL has no policy 'CnnPolicy': expected one of \['MlpPolicy'\], or a class"),
    ],
)
def test_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PEARL(**{"policy": "MlpPolicy", "env": ENV_ID, **kwargs})


def test_what_is_positional_in_sac_and_means_something_else_here_is_refused() -> None:
    with pytest.raises(TypeError, match="positional arguments"):
        PEARL("MlpPolicy", ENV_ID, 3e-4, 100_000, 100, 256, 0.005, 0.99, 1)  # type: ignore[call-arg]


def test_what_the_model_gives_its_replay_buffer_is_no_setting() -> None:
    with pytest.raises(ValueError, match="replay_buffer_kwargs has no setting 'seed'"):
        PEARL("MlpPolicy", ENV_ID, replay_buffer_kwargs={"seed": 3})


numbers = st.one_of(st.integers(-3, 300), st.floats(-2, 2), st.just(float("nan")), st.just(float("inf")))


@many
@given(
    st.dictionaries(
        st.sampled_from(["meta_batch_size", "batch_size", "context_size", "gamma", "tau", "kl_coef", "gradient_steps"]),
        numbers,
    ),
    st.dictionaries(st.sampled_from(["relabel_probability", "context_episodes", "rl_reward_type"]), numbers),
)
def test_fuzzed_settings_are_taken_or_refused_in_one_sentence(kwargs: dict[str, Any], replay: dict[str, Any]) -> None:
    try:
        model = PEARL("MlpPolicy", ENV_ID, replay_buffer_kwargs=replay, **kwargs)
    except ValueError as error:
        assert str(error).count("\n") == 0
        assert any(name in str(error) for name in (*kwargs, *replay))
    else:
        assert all(np.isfinite(value) and value >= 0 for value in (*kwargs.values(), *replay.values()))
        assert model.gamma <= 1 and 0 < model.tau <= 1 and model.meta_batch_size >= 1


def test_a_meta_batch_may_be_larger_than_the_number_of_tasks(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"n_train_tasks": 2, "n_test_tasks": 1})
    model = tiny_pearl(env, n_tasks_per_rollout=2, meta_batch_size=50).learn(2 * ROLLOUT)
    assert model._n_updates == 4 * 3 and model.replay_buffer is not None
    assert len(model.replay_buffer.sample(4, meta_batch_size=50).lengths) == 50


def test_one_update_a_rollout_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"gradient_steps is 1, the updates after a rollout of 4000 env steps.*every 20"):
        PEARL("MlpPolicy", ENV_ID, gradient_steps=1)


def test_a_model_needs_an_env_for_its_networks() -> None:
    with pytest.raises(ValueError, match="PEARL has no env to make its networks for"):
        PEARL("MlpPolicy", None)


def test_a_gpu_that_is_not_there_is_not_replaced_in_silence(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """SB3 takes the CPU and says nothing."""
    with pytest.warns(UserWarning, match="There is no cuda that torch could use: cpu is used"):
        tiny_pearl(device="cuda").save(tmp_path / "model")
    with pytest.warns(UserWarning, match="There is no cuda:1 that torch could use: cpu is used"):
        PEARL.load(tmp_path / "model", device="cuda:1")
    with pytest.raises(ValueError, match="The device 'gpu' cannot be used: give cpu, cuda or cuda:N"):
        tiny_pearl(device="gpu")


@pytest.mark.parametrize("seed", [-1, 2**32, None, 0.5])
def test_seeds_that_some_generator_would_not_take(tiny_pearl: MakePEARL, seed: Any) -> None:
    model = tiny_pearl()
    for call in (model.adapt, partial(evaluate_adaptation, model)):
        with pytest.raises(ValueError, match=r"seed is .*, expected a whole number"):
            call(ENV_ID, n_episodes=1, seed=seed)
    if seed is not None:
        with pytest.raises(ValueError, match=r"seed is .*, expected a whole number"):
            tiny_pearl(seed=seed)
    assert tiny_pearl(seed=np.int64(3)).seed == 3


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_seeds_may_be_numbers_of_numpy(tiny_pearl: MakePEARL) -> None:
    model, paths = tiny_pearl(), []
    seeds: Any = np.arange(2)
    for seed in seeds:
        given, plain = (model.adapt(ENV_ID, n_episodes=1, task=0, explorer="prior", seed=s) for s in (seed, int(seed)))
        np.testing.assert_array_equal(given.z, plain.z)
        ours, theirs = (record_adaptation(model, ENV_ID, explorer="prior", n_episodes=1, seed=s) for s in (seed, int(seed)))
        np.testing.assert_array_equal(ours.achieved, theirs.achieved)
        paths.append(ours.achieved)
    assert (paths[0] != paths[1]).any()


@pytest.mark.parametrize("total_timesteps", [-5, float("nan"), "1e5"])
def test_a_budget_that_is_none(total_timesteps: Any, tiny_pearl: MakePEARL) -> None:
    with pytest.raises(ValueError, match=r"total_timesteps is .*, expected a number of at least 0"):
        tiny_pearl().learn(total_timesteps)
    with pytest.raises(ValueError, match="log_interval is 0, expected a whole number of at least 1"):
        tiny_pearl().learn(ROLLOUT, log_interval=0)


def test_a_training_without_an_update_is_warned_of(tiny_pearl: MakePEARL) -> None:
    with pytest.warns(UserWarning, match="Nothing was learnt: learning begins after 9999 env steps"):
        tiny_pearl(learning_starts=9999).learn(ROLLOUT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = tiny_pearl().learn(ROLLOUT)
        model.learn(0, reset_num_timesteps=False)
