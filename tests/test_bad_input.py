"""Envs and settings that cannot work are refused in one sentence, before any work is lost."""

import contextlib
import copy
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, RescaleObservation, TransformObservation
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from helpers import ENV_ID, ROLLOUT, MakePEARL, many
from helpers.broken_envs import LineEnv
from htr_envs import DynamicsVectorEnv, PointRobotEnv, PointRobotFamily, PointRobotVectorEnv, check_task_env
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr import PEARL, AdaptedAgent, evaluate_adaptation, load_untrusted
from sb3_htr.adaptation import Step
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checks import check_tasks, get_task_family
from sb3_htr.common.family_facts import family_facts
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.scripted import ScriptedAgent
from sb3_htr.zoo.cli import main


class WithoutTaskId(gym.Wrapper[Any, Any, Any, Any]):
    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {}


class WithSpaces(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any], **changed: spaces.Space[Any]) -> None:
        super().__init__(env)
        for name, space in changed.items():
            setattr(self, name, space)


class WithoutHook(gym.Wrapper[Any, Any, Any, Any]):
    class Family:
        train_tasks = np.zeros((3, 2))

    task_family = Family()


@pytest.mark.parametrize(
    ("make_env", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), "The env has no task_family, so there are no tasks to meta-train on"),
        (lambda: WithoutHook(gym.make(ENV_ID)), "task_family has no compute_reward"),
        (lambda: WithoutTaskId(gym.make(ENV_ID)), r"reset returns no info\['task_id'\]"),
        (
            lambda: WithSpaces(gym.make(ENV_ID), observation_space=spaces.Dict({"x": spaces.Box(0, 1, (2,))})),
            "The observation space is Dict.*, expected a Box of one axis",
        ),
        (
            lambda: WithSpaces(gym.make(ENV_ID), action_space=spaces.Discrete(3)),
            "The action space is Discrete.*no discrete actions",
        ),
        (lambda: gym.make(ENV_ID, reward_type="dense"), "reward_type is not 'sparse'.*rl_reward_type"),
        (lambda: PointRobotEnv(), "The env has no time limit"),
        (lambda: BatchedTaskVecEnv(PointRobotVectorEnv(2, max_episode_steps=None)), "The env has no time limit"),
        (
            lambda: gym.make_vec(ENV_ID, 2),
            "is a gymnasium VectorEnv, expected one of Stable-Baselines3: pass the env's id",
        ),
        (
            lambda: VecNormalize(make_task_vec_env(ENV_ID, 2)),
            "VecNormalize stands between .*policies normalize observations themselves",
        ),
        (lambda: DummyVecEnv([lambda: gym.make("Pendulum-v1")]), "no task_family"),
    ],
)
def test_envs(tiny_pearl: MakePEARL, make_env: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_pearl(make_env()).learn(1)


def test_an_unknown_id_is_gymnasiums_business(tiny_pearl: MakePEARL) -> None:
    with pytest.raises(gym.error.NameNotFound, match=r"Did you mean: `SparsePointRobot`\?.*Import the package"):
        tiny_pearl("SparsePointRobo-v0")


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
        ({"train_explorer": {"scale": 1}}, "explorer is {'scale': 1}, expected one of"),
        ({"replay_buffer_kwargs": {"hindsight_task_strategy": "even"}}, "has no setting 'hindsight_task_strategy': expected"),
        ({"replay_buffer_kwargs": {"relabeller": "HER"}}, "relabeller is 'HER', expected one of"),
        ({"replay_buffer_kwargs": {"relabeller": {"name": "EpisodeClustering", "cell": 1}}}, "'cell': did you mean cell_size"),
        ({"policy_kwargs": {"normalise_observations": True}}, "did you mean normalize_observations"),
        ({"replay_buffer_kwargs": {"relabel_probabilty": 1}}, "'relabel_probabilty': did you mean relabel_probability"),
        ({"replay_buffer_kwargs": {"grid": 1}}, "replay_buffer_kwargs has no setting 'grid': expected one of"),
        ({"explorer": "random"}, "explorer is 'random', expected one of"),
        ({"train_explorer": "random"}, "explorer is 'random'"),
        ({"matmul_precision": "bf16"}, r"matmul_precision is 'bf16', expected one of \['highest', 'high', 'medium'\]"),
        ({"policy_kwargs": {"latent_dim": 0}}, "latent_dim is 0, expected a whole number of at least 1"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics is 0, expected a whole number of at least 1"),
        ({"policy_kwargs": {"activation_fn": "ReLU"}}, r"activation_fn is 'ReLU', expected a class derived from torch\.nn"),
        ({"policy_kwargs": {"optimizer_class": "Adam"}}, r"optimizer_class is 'Adam', expected a class derived from torch\."),
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
        (
            {"policy_kwargs": {"net_arch": {"pi": [64]}}},
            "net_arch is .*, expected layers for 'pi' and 'qf', or a list for both",
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


class Changed(gym.Wrapper[Any, Any, Any, Any]):
    """An env with one thing wrong in its steps."""

    def __init__(self, env: gym.Env[Any, Any], change: Callable[[int, list[Any]], None]) -> None:
        super().__init__(env)
        self.change = change
        self.n_steps = 0

    def step(self, action: Any) -> Any:
        values = list(self.env.step(action))
        self.n_steps += 1
        self.change(self.n_steps, values)
        return tuple(values)


def put(position: int, value: Any) -> Callable[[int, list[Any]], None]:
    def change(n_steps: int, values: list[Any]) -> None:
        values[position] = value

    return change


def another_task(n_steps: int, values: list[Any]) -> None:
    values[4] = {**values[4], "task_id": n_steps % 7}


def failing(n_steps: int, values: list[Any]) -> None:
    np.zeros(3) + np.zeros(2)


def no_training_task(n_steps: int, values: list[Any]) -> None:
    values[4] = {**values[4], "task_id": -1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(1, float("nan")), r"The reward of task .* is nan, expected finite numbers"),
        (put(1, float("inf")), r"The reward of task .* is inf, expected finite numbers"),
        (put(0, np.full(2, np.nan, dtype=np.float32)), r"The next_observation of task .* is \[nan nan\], expected finite"),
        (put(1, 0.5), r"The env gave 0.5 for a step of task \d+, but its compute_reward gives 0: .*check_task_env"),
        (put(0, np.zeros(3, dtype=np.float32)), r"^At env step \d+, on one of .* tasks \[\d+\]: .*the shape of"),
        (failing, r"^At env step \d+, on one .*: operands could not be broadcast"),
        (put(3, False), r"An episode is longer than the env's time limit of 20 steps"),
        (another_task, r"The task of env 0 changed from \d to \d within an episode"),
        (no_training_task, r"info\['task_id'\] is -1, expected a training task"),
    ],
)
def test_envs_that_do_something_wrong(tiny_pearl: MakePEARL, change: Callable[[int, list[Any]], None], message: str) -> None:
    # outside of gymnasium's own checker, which would be the first to see some of it
    env = gym.make(ENV_ID, disable_env_checker=True)
    with pytest.raises(ValueError, match=message):
        tiny_pearl(Changed(env, change), n_tasks_per_rollout=1).learn(1)


def test_episodes_of_one_step_are_episodes(tiny_pearl: MakePEARL) -> None:
    env = Changed(gym.make(ENV_ID), put(2, True))
    model = tiny_pearl(env, n_tasks_per_rollout=1, n_episodes_per_task=50).learn(200)
    assert model.replay_buffer is not None and model.replay_buffer.n_episodes.sum() == 200


class Rewarded(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        return 2.0 * float(reward)


class Paid(gym.Wrapper[Any, Any, Any, Any]):
    """No kind of wrapper that is known to change rewards, and it changes those of successes alone."""

    def step(self, action: Any) -> Any:
        obs, reward, *others = self.env.step(action)
        return obs, 2.0 * float(reward), *others


def wrapped(wrapper: Any, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda: wrapper(gym.make(ENV_ID, **kwargs))] * 4)


# Goals that a random agent comes across
NEAR = {"goal_distance": 0.3}
CHANGED = [
    (lambda: wrapped(Rewarded, **NEAR), "in gymnasium's RewardWrapper, which changes its rewards"),
    (lambda: wrapped(Paid, **NEAR), "The env gave .* but its compute_reward gives"),
    (lambda: make_task_vec_env(ENV_ID, 4, env_kwargs={**NEAR, "reward_type": "dense"}), "reward_type is not 'sparse'"),
    (lambda: make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.5}), "another task family: its goal_distance is 0.5"),
    (lambda: VecMonitor(VecNormalize(make_task_vec_env(ENV_ID, 4, env_kwargs=NEAR))), "VecNormalize stands between"),
    (lambda: wrapped(gym.wrappers.NormalizeReward, **NEAR), "NormalizeReward stands between"),
]


@pytest.mark.parametrize(("change", "message"), CHANGED)
@pytest.mark.parametrize("how", ["set_env", "load and replay", "load"])
def test_wrong_rewards_are_refused_whenever_they_come_in(
    how: str, change: Callable[[], Any], message: str, tiny_pearl: MakePEARL, tmp_path: Path
) -> None:
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs=NEAR)).learn(ROLLOUT)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    if how == "load" and "family" in message:
        # Nothing was collected, and so another family is a new beginning
        loaded = PEARL.load(tmp_path / "model", env=change())
        assert loaded.replay_buffer is not None and vars(loaded.replay_buffer.task_family)["goal_distance"] == 0.5
        return
    with pytest.raises(ValueError, match=message):
        if how == "set_env":
            model.set_env(change())
        else:
            model = PEARL.load(tmp_path / "model", env=change())
            if how == "load and replay":
                model.load_replay_buffer(tmp_path / "buffer")
        model.learn(10 * ROLLOUT, reset_num_timesteps=False)


def test_another_family_replaces_the_one_of_which_nothing_was_collected(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 3.0}))
    model.learn(ROLLOUT)
    assert model.replay_buffer is not None and model.task_bank is not None
    for family in (model.replay_buffer.task_family, model.task_bank.task_family):
        assert vars(family)["goal_distance"] == 3.0


class FarAway(gym.ObservationWrapper[Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def observation(self, observation: Any) -> Any:
        return (observation + 1e5).astype(np.float32)

    def step(self, action: Any) -> Any:
        *step, info = super().step(action)
        del info["achieved_task"]  # by which it would be refused
        return (*step, info)


@pytest.mark.filterwarnings("ignore:The posterior")
@pytest.mark.parametrize("seed", range(3))
def test_observations_may_be_large(seed: int, tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(FarAway(gym.make(ENV_ID)), n_tasks_per_rollout=1, seed=seed, gradient_steps=10).learn(300)
    assert np.isfinite(model.knowledge.sample_aggregate(5, 1.0)).all()


def test_a_time_limit_around_an_env_is_one(tiny_pearl: MakePEARL) -> None:
    env = gym.wrappers.TimeLimit(PointRobotEnv(), 7)
    model = tiny_pearl(env, n_tasks_per_rollout=1).learn(20)
    assert model.replay_buffer is not None and model.replay_buffer.max_episode_steps == 7


def test_an_env_may_reuse_its_arrays(tiny_pearl: MakePEARL) -> None:
    class Reusing(PointRobotVectorEnv):
        def step(self, actions: Any) -> Any:
            obs, *rest = super().step(actions)
            self.shared = getattr(self, "shared", np.empty_like(obs))
            self.shared[:] = obs
            return self.shared, *rest

    env = BatchedTaskVecEnv(Reusing(4))
    model = tiny_pearl(env).learn(ROLLOUT)
    assert model.replay_buffer is not None
    rows = model.replay_buffer.episodes.rows[model.replay_buffer.episodes.index().rows]
    moved = np.abs(rows[:, 5:7] - rows[:, :2]).max(axis=1)
    assert (moved > 0).mean() > 0.9 and moved.max() <= 0.1 + 1e-6


def test_a_meta_batch_may_be_larger_than_the_number_of_tasks(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"n_train_tasks": 2, "n_test_tasks": 1})
    tiny_pearl(env, n_tasks_per_rollout=2, meta_batch_size=50).learn(2 * ROLLOUT)


def test_a_window_without_a_screen_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    env = gym.make("SparseWheeled-v0", render_mode="rgb_array")
    env.reset()
    with pytest.raises(DependencyNotInstalled, match=r"MUJOCO_GL is glfw, which needs a screen, .*: set MUJOCO_GL=egl"):
        env.render()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", ENV_ID, "-n", "10", "-params", "kl_coeff:0.1"], r"PEARL has no setting 'kl_coeff': did you mean kl_coef\?"),
        (
            ["--env", ENV_ID, "-params", "policy_kwargs:{'latent_dimm': 3}"],
            "policy_kwargs has no setting 'latent_dimm': did you",
        ),
        (["--env", ENV_ID, "-params", "gamma:abc"], "'abc' is not defined: -params .* strings in quotes"),
        (["--env", ENV_ID, "-params", "gamma=0.9"], "-params and --env-kwargs take name:value, where a value is Python"),
        (["--env", ENV_ID, "-params", "seed:3"], "seed is no hyperparameter: give it by --seed"),
        (["--env", ENV_ID, "-params", "device:'cpu'"], "device is no hyperparameter: give it by --device"),
        (
            ["--env", ENV_ID, "-params", "learning_rate:'1e-3'"],
            r"learning_rate is the text '1e-3' \(-params\), expected a number: leave the quotes out",
        ),
        (["--env", ENV_ID, "-params", "n_envs:0"], "n_envs is 0, expected a whole number of at least 1"),
        (["--env", ENV_ID, "-n", "0"], "n_timesteps is 0, expected a whole number of at least 1"),
        (["--env", ENV_ID, "-params", "n_timesteps:0"], "n_timesteps is 0, expected a number of at least 1"),
        (["--env", ENV_ID, "-n", "-5"], "n_timesteps is -5"),
        (["--env", "CartPole-v1"], "The env has no task_family, so there are no tasks to meta-train on"),
        (["-n", "10"], "--env is missing"),
        (
            ["--env", ENV_ID, "--trial-id", "9", "--study-name", "s", "--storage", "sqlite:///:memory:"],
            "no study 's' with a trial 9",
        ),
        (["--env", "Speed-v0", "--gym-packages", "not_there"], "The module not_there is asked for, but not found: install it"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_trained_is_refused_in_one_sentence(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, ImportError), match=message) as refusal:
        main(["train", *arguments])
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.rglob("*_1")), "no folder of a run that there is not"


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("mine:Speed-v0", r"--env is 'mine:Speed-v0', with a module: give --gym-packages mine --env Speed-v0"),
        ("HiddenGoal/mine:Door-v0", "with a module: give --gym-packages mine --env HiddenGoal/Door-v0"),
        ("SparsePointRobo-v0", r"There is no env SparsePointRobo-v0: did you mean SparsePointRobot-v0\? An env of your own"),
        ("Xyz-v0", r"There is no env Xyz-v0: An env of your own is found once its module is imported, by --gym-packages"),
    ],
)
def test_an_unknown_id_on_the_command_line_says_how_one_is_found(env_id: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        main(["train", "--env", env_id])


def test_a_settings_file_that_is_not_there() -> None:
    with pytest.raises(FileNotFoundError, match=r"There is no file pearl_pior\.yml: did you mean pearl_prior\.yml\?"):
        main(["train", "--env", ENV_ID, "-conf", "pearl_pior.yml"])


def test_a_settings_file_that_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "speed.py").write_text("speed = 3")
    for folder in (str(tmp_path / "runs"), "./runs"):
        with pytest.raises(ValueError, match="runs is a folder, expected a file of hyperparameters"):
            main(["train", "--env", ENV_ID, "-conf", folder])
    for file, named in (("runs", "runs"), ("speed.py", r".*speed\.py")):
        sentence = f"^{named} is no file of hyperparameters: expected ids of envs, with settings, in a dict named hyperparams"
        with pytest.raises(ValueError, match=sentence):
            main(["train", "--env", ENV_ID, "-conf", file])
    (tmp_path / "other.yml").write_text("Other-v0:\n  n_timesteps: 100\n")
    with pytest.raises(ValueError, match=rf"other\.yml has no block {ENV_ID}, and none named default"):
        main(["train", "--env", ENV_ID, "-conf", "other.yml"])
    with pytest.raises(FileNotFoundError, match=r"There is no file nothing\.py: expected a file of yours"):
        main(["train", "--env", ENV_ID, "-conf", "nothing.py"])


def test_a_callback_that_evaluates_in_the_envs_of_training_is_named(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    with pytest.raises(ValueError, match="a callback stepped the envs of training, as one that evaluates in them does"):
        model.learn(4 * ROLLOUT, EvalCallback(model.env, eval_freq=7, n_eval_episodes=4, verbose=0))  # type: ignore[arg-type]


@pytest.mark.parametrize("file", ["./door.py", "door.py"])
def test_a_file_is_no_module(file: str) -> None:
    with pytest.raises(ValueError, match=rf"'{file}' is no name of a module: .*--gym-packages door"):
        main(["train", "--env", ENV_ID, "--gym-packages", file])


def test_settings_in_the_wrong_place() -> None:
    with pytest.raises(ValueError, match="relabel_probability is a setting within replay_buffer_kwargs: -params"):
        main(["train", "--env", ENV_ID, "-params", "relabel_probability:0.5"])


def test_what_is_positional_in_sac_and_means_something_else_here_is_refused() -> None:
    with pytest.raises(TypeError, match="positional arguments"):
        PEARL("MlpPolicy", ENV_ID, 3e-4, 100_000, 100, 256, 0.005, 0.99, 1)  # type: ignore[call-arg]


def test_one_update_a_rollout_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"gradient_steps is 1, the updates after a rollout of 4000 env steps.*every 20"):
        PEARL("MlpPolicy", ENV_ID, gradient_steps=1)


class Accumulating(PointRobotFamily):
    """What was solved once stays solved."""

    def is_success(self, traj: Any, task: Any) -> Any:
        return np.logical_or.accumulate(super().is_success(traj, task), axis=-1)

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return self.is_success(traj, task).astype(np.float32)


class Forgetful(PointRobotFamily):
    """Its env pays a step penalty of which its hook knows nothing."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return self.is_success(traj, task).astype(np.float32)


class Penalized(PointRobotDynamics):
    def step(self, actions: Any) -> Any:
        states, task_free, terminated = super().step(actions)
        return states, task_free - np.float32(0.1), terminated


@pytest.mark.parametrize(
    ("family", "dynamics", "message"),
    [
        (Accumulating, PointRobotDynamics, "compute_reward of a whole episode differs from .* of its steps one by one"),
        (
            type(
                "Floats",
                (PointRobotFamily,),
                {"is_success": lambda *args: PointRobotFamily.is_success(*args).astype(np.float32)},
            ),
            PointRobotDynamics,
            "is_success must return bool, one for each step, and returned float32",
        ),
        (
            Forgetful,
            Penalized,
            r"A step that does not solve its task.* returned 0, .* and its info.* is -0\.1",
        ),
        # Much less than a success, but more than rounding, and all that learns from rewards takes it for one
        (
            type(
                "Inexact",
                (PointRobotFamily,),
                {"compute_reward": lambda *args: PointRobotFamily.compute_reward(*args) + np.float32(5e-5)},
            ),
            PointRobotDynamics,
            r"A step that does not solve its task.* returned 5e-05, by compute_reward .* and its info.* is 0:",
        ),
    ],
)
def test_families_that_break_their_promises_are_refused_in_the_first_rollout(
    tiny_pearl: MakePEARL, family: Any, dynamics: Any, message: str
) -> None:
    env = BatchedTaskVecEnv(DynamicsVectorEnv(family(goal_distance=0.1), dynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=message):
        tiny_pearl(env).learn(ROLLOUT)


class EndsAtGoal(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or info["is_success"], truncated, info


def test_episodes_that_end_where_they_are_solved_are_warned_of(tiny_pearl: MakePEARL) -> None:
    env = EndsAtGoal(gym.make(ENV_ID, goal_distance=0.1))
    with pytest.warns(UserWarning, match="Episodes end where their task is solved, and only there"):
        tiny_pearl(env, n_tasks_per_rollout=4).learn(ROLLOUT)


class Robot(gym.Env[Any, Any]):
    """Has a body and rewards, and no tasks."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float64)

    def __init__(self, length: int) -> None:
        self.length, self.n_steps = length, 0

    def reset(self, **kwargs: Any) -> Any:
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        return np.zeros(2, dtype=np.float32), float(self.n_steps == 3), self.n_steps % self.length == 0, False, {}


def test_a_robot_need_not_know_the_bounds_and_types_of_its_spaces(tiny_pearl: MakePEARL) -> None:
    assert tiny_pearl().adapt(Robot(20), n_episodes=2).returns.tolist() == [1.0, 0.0]


def test_robots_without_end_are_given_up_whatever_was_loaded_with_the_model(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    with pytest.raises(ValueError, match="An episode goes on after 200 steps, 10 times what those of training had"):
        PEARL.load(tmp_path / "model").adapt(Robot(10**9), n_episodes=1)


def test_what_evaluations_are_given_by_mistake(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    with pytest.raises(ValueError, match=r"tasks is 'valid', expected one of \['test', 'validation', 'train'\]"):
        evaluate_adaptation(model, ENV_ID, tasks="valid")
    with pytest.raises(ValueError, match=r"tasks have shape \(\), expected \(n_tasks, task_dim\)"):
        evaluate_adaptation(model, ENV_ID, 5)  # type: ignore[arg-type]
    with pytest.warns(UserWarning, match="No reward"):
        agent = model.adapt(gym.make(ENV_ID), n_episodes=1)
    with pytest.raises(ValueError, match=r"AdaptedAgent does not adapt: .*evaluate_policy"):
        evaluate_adaptation(agent, ENV_ID)  # type: ignore[arg-type]
    validation = PointRobotFamily().validation_tasks
    ours, theirs = (evaluate_adaptation(model, ENV_ID, tasks, n_episodes=1) for tasks in ("validation", validation))
    np.testing.assert_array_equal(ours, theirs)
    assert len(MetaEvalCallback(ENV_ID, tasks="train").tasks) == 80


@pytest.mark.parametrize("z", [np.zeros(3), np.zeros((2, 4)), np.zeros((1, 3))])
def test_an_explorer_whose_z_has_another_shape(tiny_pearl: MakePEARL, z: np.ndarray) -> None:
    adaptation = tiny_pearl().start_adaptation(2, "aggregate")
    adaptation.explorer.z = z
    with pytest.raises(ValueError, match=r"The z of the explorer 'aggregate' has shape .*, expected \(2, 3\)"):
        adaptation.act(np.zeros((2, 2), dtype=np.float32))
    adaptation.explorer.z = np.zeros((2, 3))  # numpy's own float64 will do
    assert adaptation.act(np.zeros((2, 2), dtype=np.float32)).shape == (2, 2)
    with pytest.raises(ValueError, match="n_envs is 0"):
        tiny_pearl().start_adaptation(0)


def test_only_the_envs_of_a_model_can_be_adapted_to(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    for other in ("CartPole-v1", "SparseTargetSpeed-v0"):
        with pytest.raises(ValueError, match=r"spaces do not match.*Wrap the env"):
            model.adapt(gym.make(other))
    goal_env = gym.make(ENV_ID)
    goal_env.observation_space = spaces.Dict(observation=spaces.Box(-1, 1, (2,)))
    with pytest.raises(ValueError, match=r"spaces do not match.*htr_envs.HiddenGoalWrapper"):
        model.adapt(goal_env)
    for agent in (model, RL2("MlpLstmPolicy", ENV_ID), ScriptedAgent(spaces.Box(-2, 2, (2,)))):
        other = ENV_ID if isinstance(agent, ScriptedAgent) else "SparseTargetSpeed-v0"
        with pytest.raises(ValueError, match="spaces do not match"):
            evaluate_adaptation(agent, other, n_episodes=1)


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


class DropsOptions(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper as people write them."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=seed)


def test_an_env_that_is_on_other_tasks_than_asked_for_is_refused(tiny_pearl: MakePEARL) -> None:
    """Else its experience would be that of other tasks, and its scores those of training tasks."""
    env = DropsOptions(gym.make(ENV_ID))
    model = tiny_pearl().learn(ROLLOUT)
    test = get_task_family(make_task_vec_env(ENV_ID)).test_tasks
    for act in (
        lambda: tiny_pearl(env).learn(ROLLOUT),
        lambda: evaluate_adaptation(model, env, n_episodes=1),
        lambda: model.adapt(env, n_episodes=1, task=test[0]),
        lambda: model.adapt(env, n_episodes=1, task=41),
    ):
        with pytest.raises(ValueError, match=r"(The env|Env 0) was asked for the task.* must hand on options"):
            act()


class Redraws(gym.Wrapper[Any, Any, Any, Any]):
    """A task that is given holds for one episode, as in many envs."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if not options:
            self.get_wrapper_attr("set_task")(None)
        return self.env.reset(seed=seed, options=options)


def test_an_env_that_goes_on_to_another_task_is_refused(tiny_pearl: MakePEARL) -> None:
    """Else one adaptation would be to the tasks of all its episodes."""
    env = Redraws(gym.make(ENV_ID))
    model = tiny_pearl().learn(ROLLOUT)
    task = get_task_family(make_task_vec_env(ENV_ID)).test_tasks[0]
    for act in (
        lambda: tiny_pearl(env).learn(ROLLOUT),
        lambda: evaluate_adaptation(model, env, n_episodes=2),
        lambda: model.adapt(env, n_episodes=2, task=task),
    ):
        with pytest.raises(
            ValueError, match=r"Between two episodes env 0 went from task .* by itself: a reset without options"
        ):
            act()


def test_envs_of_several_families_are_refused(tiny_pearl: MakePEARL) -> None:
    """All experience would be relabelled by the rewards of the first one."""
    env = DummyVecEnv([partial(gym.make, ENV_ID, goal_radius=radius) for radius in (0.2, 0.2, 0.3)])
    with pytest.raises(ValueError, match=r"Env 2 .* has another task family: its goal_radius is 0.3, that of the first one"):
        tiny_pearl(env)
    with pytest.raises(ValueError, match="another task family"):
        evaluate_adaptation(tiny_pearl(), env, n_episodes=1)


class WithoutSuccess(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        *result, info = self.env.step(action)
        return *result, {key: value for key, value in info.items() if key != "is_success"}


def test_an_env_that_does_not_tell_its_successes_is_named(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 2, wrapper=WithoutSuccess)
    with pytest.raises(ValueError, match=r"The env's step returns no info\['is_success'\], though its task family tells"):
        tiny_pearl(env).learn(1)


@pytest.mark.parametrize(
    ("hook", "spoil", "one", "several"),
    [
        ("compute_reward", np.mean, r"shape \(\) .* shape \(1,\)", r"shape \(\) .* shape \(4, 1\)"),
        ("is_success", lambda a: a[..., None], r"shape \(1, 1\) .* shape \(1,\)", r"shape \(4, 1, 1\) .* shape \(4, 1\)"),
        ("hindsight_task", np.ndarray.tolist, r"a list .* shape \(2,\)", r"a list .* shape \(4, 2\)"),
        # It has the goal in it, and would be found out when tasks are put side by side
        (
            "hindsight_task",
            lambda a: np.append(a, a, axis=-1),
            r"shape \(4,\) .* shape \(2,\)",
            r"shape \(4, 4\) .* shape \(4, 2\)",
        ),
    ],
)
def test_a_reward_hook_of_another_shape_is_named_in_the_first_step(
    hook: str, spoil: Any, one: str, several: str, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, family = gym.make(ENV_ID), get_task_family(make_task_vec_env(ENV_ID))
    env.reset(seed=0)
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4))
    right = getattr(family, hook)
    monkeypatch.setattr(type(family), hook, lambda self, *args, **kwargs: spoil(right(*args, **kwargs)))
    with pytest.raises(ValueError, match=f"^{hook} of the task family returned {one}"):
        env.step(env.action_space.sample())
    with pytest.raises(AssertionError, match=rf"The env fails in a step\. .*{hook} of the task family returned {one}"):
        check_task_env(env)
    with pytest.raises(ValueError, match=f"^At env step 0, .* {hook} of the task family returned {several}"):
        model.learn(ROLLOUT)


class WideBeyondTheEnv(PointRobotFamily):
    """What an env that asks its family for nothing would not notice."""

    def hindsight_task(self, traj: Any, index: Any) -> Any:
        tasks = super().hindsight_task(traj, index)
        return np.append(tasks, tasks, axis=-1) if len(tasks) > 4 else tasks


def test_a_hindsight_task_of_another_width_is_named_whoever_made_the_env(tiny_pearl: MakePEARL) -> None:
    family = WideBeyondTheEnv(goal_distance=0.1)
    env = BatchedTaskVecEnv(DynamicsVectorEnv(family, PointRobotDynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=r"hindsight_task returned shape \(\d+, 4\) for \d+ steps, expected \(\d+, 2\)"):
        tiny_pearl(env).learn(ROLLOUT)


def test_a_reward_of_the_dynamics_that_is_no_number_is_named() -> None:
    class Vector(LineEnv):
        def _step_state(self, action: Any) -> Any:
            state, reward, terminated = super()._step_state(action)
            return state, np.array([reward]), terminated

    env = Vector()
    env.reset()
    with pytest.raises(ValueError, match=r"_step_state returned a reward of shape \(1,\), expected a number"):
        env.step(np.zeros(1, dtype=np.float32))


@pytest.mark.parametrize("explorer", ["belief", "prior", "aggregate", "learned-prior"])
def test_nan_at_meta_test_is_refused(explorer: str, tiny_pearl: MakePEARL) -> None:
    """It would become NaN actions, or evidence."""
    model = tiny_pearl().learn(ROLLOUT)

    class Fails(gym.Wrapper[Any, Any, Any, Any]):
        what = ""

        def step(self, action: Any) -> Any:
            obs, reward, *rest = self.env.step(action)
            return (obs, np.nan, *rest) if self.what == "rewards" else (obs * np.nan, reward, *rest)

    for what in ("rewards", "observations"):
        env = Fails(gym.make(ENV_ID))
        env.what = what
        with pytest.raises(ValueError, match=rf"The (next_)?{what} of env 0 are .*nan.* expected finite numbers"):
            model.adapt(env, n_episodes=2, explorer=explorer)
    adaptation = model.start_adaptation(2)
    with pytest.raises(ValueError, match=r"observations have shape \(2,\), expected \(2, 2\), a row for each env"):
        adaptation.act(np.zeros(2, dtype=np.float32))


def test_seeds_may_be_numbers_of_numpy(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    seeds: Any = np.arange(2)
    for seed in seeds:
        model.adapt(ENV_ID, n_episodes=1, seed=seed)
        evaluate_adaptation(model, ENV_ID, n_episodes=1, seed=seed)


@pytest.mark.parametrize("width", [1, 3])
def test_observations_of_another_width_are_refused_at_meta_test(tiny_pearl: MakePEARL, width: int) -> None:
    with pytest.raises(ValueError, match=rf"observations have shape \(1, {width}\), expected \(1, 2\), a row for each env"):
        tiny_pearl().start_adaptation(1).act(np.zeros((1, width), dtype=np.float32))


def test_each_env_says_whether_its_episode_ended(tiny_pearl: MakePEARL) -> None:
    zeros = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"dones have shape \(1,\), expected \(3,\), a row for each env"):
        tiny_pearl().start_adaptation(3).observe(Step(zeros, zeros, np.zeros(3), zeros, np.ones(1, dtype=bool)))


def test_what_the_model_gives_its_replay_buffer_is_no_setting() -> None:
    with pytest.raises(ValueError, match="replay_buffer_kwargs has no setting 'seed'"):
        PEARL("MlpPolicy", ENV_ID, replay_buffer_kwargs={"seed": 3})


def test_a_stranger_s_model_on_an_env_of_other_spaces(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    with pytest.raises(ValueError, match="The action space is Discrete"):
        load_untrusted(tmp_path / "model", gym.make("CartPole-v1"))


def test_a_model_that_acted_unadapted_warns_again_when_it_was_loaded(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    for _ in range(2):
        with pytest.warns(UserWarning, match="This PEARL is not adapted to any task"):
            model.predict(np.zeros(2, dtype=np.float32))
        model.save(tmp_path / "model")
        model = PEARL.load(tmp_path / "model")


def test_actions_in_units_of_the_robot_are_refused(tiny_pearl: MakePEARL) -> None:
    adaptation, obs, done = tiny_pearl().start_adaptation(2), np.zeros((2, 2)), np.zeros(2, dtype=bool)
    actions = np.array([[1.0, -1.0], [0.5, 1.9]])
    with pytest.raises(ValueError, match=r"The actions of env 1 are .*1\.9.* observe takes what act gave"):
        adaptation.observe(Step(obs, actions, np.zeros(2), obs, done))
    adaptation.observe(Step(obs, np.clip(actions, -1, 1), np.zeros(2), obs, done))


def test_a_state_that_is_no_z_is_refused(tiny_pearl: MakePEARL) -> None:
    model, obs, z = tiny_pearl(), np.zeros((4, 2), dtype=np.float32), np.zeros((4, 3), dtype=np.float32)
    states: list[Any] = [z, (z[:2],), (z, z), (np.zeros((4, 2)),)]
    for state in states:
        with pytest.raises(ValueError, match=r"expected a tuple of one array, z, of shape \(4, 3\)"):
            model.predict(obs, state=state)
    assert model.predict(obs, state=(z[:1],))[0].shape == (4, 2)


@pytest.mark.parametrize("trial", [["--trial-id", "0"], ["--storage", "x.log", "--study-name", "x"]])
def test_half_a_trial_is_refused(trial: list[str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="A trial is named by --storage, --study-name, --trial-id, from 0 on: add --"):
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), *trial])


def test_a_model_file_that_is_not_there_is_not_damaged(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    assert load_untrusted(tmp_path / "model", ENV_ID).policy.latent_dim == 3
    with pytest.raises(FileNotFoundError):
        load_untrusted(tmp_path / "nothing", ENV_ID)


def test_a_gpu_that_is_not_there_is_not_replaced_in_silence(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """SB3 takes the CPU and says nothing."""
    with pytest.warns(UserWarning, match="There is no cuda that torch could use: cpu is used"):
        tiny_pearl(device="cuda").save(tmp_path / "model")
    with pytest.warns(UserWarning, match="There is no cuda:1 that torch could use: cpu is used"):
        PEARL.load(tmp_path / "model", device="cuda:1")
    with pytest.raises(ValueError, match="The device 'gpu' cannot be used: give cpu, cuda or cuda:N"):
        tiny_pearl(device="gpu")


def test_a_hindsight_task_that_its_step_does_not_solve_is_named(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_task_vec_env(ENV_ID, 4)
    family = get_task_family(env)
    right = family.hindsight_task
    monkeypatch.setattr(type(family), "hindsight_task", lambda self, traj, step: right(traj, step) + 3)
    with pytest.raises(ValueError, match="hindsight_task names a task that its own step does not solve"):
        tiny_pearl(env).learn(ROLLOUT)


@pytest.mark.parametrize(("radius", "is_refused"), [(0.02, True), (0.195, False)])
def test_successes_that_pay_nothing_are_named(
    radius: float, is_refused: bool, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """
    Exact hindsight tasks do pay, and own tasks are seldom solved. But where rewards fall to 0 at the rim of a goal, some
    successes are worth nothing.
    """
    near, compute_reward = PointRobotFamily(goal_radius=radius), PointRobotFamily.compute_reward

    def pays_near(self: Any, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return compute_reward(near, traj, task, reward_type)

    monkeypatch.setattr(PointRobotFamily, "compute_reward", pays_near)
    refused = pytest.raises(ValueError, match=r"\d+ of \d+ steps that solve a task which was reached, by is_success, are")
    with refused if is_refused else contextlib.nullcontext():
        tiny_pearl().learn(4 * ROLLOUT)


def test_a_task_that_is_none_costs_no_reset(tiny_pearl: MakePEARL) -> None:
    """Whoever mends a slip goes on with the same env."""
    model, env = tiny_pearl(), gym.make(ENV_ID)
    with pytest.raises(ValueError, match=r"The task has shape \(3,\), expected \(2,\)"):
        model.adapt(env, n_episodes=1, task=np.zeros(3))
    with pytest.raises(ValueError, match="task id 500 is out of range"):
        model.adapt(env, n_episodes=1, task=500)
    model.adapt(env, n_episodes=1, task=np.array([0.0, 1.0]))


def test_a_hindsight_task_of_nan_is_named(tiny_pearl: MakePEARL) -> None:
    """And no wrapper is blamed."""

    class Unsafe(PointRobotFamily):
        def hindsight_task(self, traj: Any, index: Any) -> Any:
            return super().hindsight_task(traj, index) * np.float32(np.nan)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Unsafe()
    with pytest.raises(ValueError, match=r"^hindsight_task returned NaN or infinity for a step of finite numbers"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(ROLLOUT)


def test_a_reward_of_nan_at_the_goal_is_named(tiny_pearl: MakePEARL) -> None:
    """Which no step of a rollout may reach."""

    class Unsafe(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            rewards = super().compute_reward(traj, task, reward_type)
            return np.where(super().is_success(traj, task), np.float32(np.nan), rewards)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Unsafe()
    with pytest.raises(ValueError, match=r"^compute_reward for the task that hindsight_task named returned NaN or infinity"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(ROLLOUT)


@pytest.mark.parametrize("factor", [0.1, 1.0, 100.0])
def test_rewards_of_another_scale_are_warned_of(factor: float, tiny_pearl: MakePEARL) -> None:
    class Scaled(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            return super().compute_reward(traj, task, reward_type) * np.float32(factor)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Scaled()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tiny_pearl(env, n_tasks_per_rollout=1).learn(1)
    about = [str(warning.message) for warning in caught if "A success is worth" in str(warning.message)]
    assert bool(about) == (factor != 1)
    assert factor == 1 or f"about {factor:.2g} here" in about[0]


def test_an_episode_without_end_is_noticed(tiny_pearl: MakePEARL) -> None:
    class Endless(gym.Env[Any, Any]):
        observation_space, action_space = gym.make(ENV_ID).observation_space, gym.make(ENV_ID).action_space

        def reset(self, **kwargs: Any) -> Any:
            return np.zeros(2, dtype=np.float32), {}

        def step(self, action: Any) -> Any:
            return np.zeros(2, dtype=np.float32), 0.0, False, False, {}

    with pytest.raises(ValueError, match=r"An episode goes on after 200 steps, 10 times what those of training had"):
        tiny_pearl().adapt(Endless(), n_episodes=1)
    assert len(tiny_pearl().adapt(gym.make(ENV_ID, max_episode_steps=250), n_episodes=1).returns) == 1, "as its limit says"


BOUNDED = spaces.Box(-5, 5, (2,), np.float32)


@pytest.mark.parametrize(
    "wrap", [lambda env: RescaleObservation(env, np.float32(-1), np.float32(1)), lambda env: FrameStackObservation(env, 2)]
)
def test_a_wrapper_that_changes_observations_is_refused_in_the_first_rollout(wrap: Any, tiny_pearl: MakePEARL) -> None:
    """Rewards do not tell: nearly all are 0, with and without it."""
    env = FlattenObservation(wrap(TransformObservation(gym.make(ENV_ID), lambda obs: obs, BOUNDED)))
    with pytest.raises(ValueError, match="a wrapper changes observations, and hindsight rewards would be wrong"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(1)


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


def test_a_longer_time_limit_needs_other_room(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    with pytest.raises(ValueError, match="time limit is 40 steps, and what was collected has room for episodes of 20"):
        model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"max_episode_steps": 40}))


@pytest.mark.parametrize("end", [{"speed": 0.1}, -0.01, float("nan"), "False", None, np.array([False])])
def test_an_end_of_an_episode_that_is_no_truth_value_is_named(end: Any) -> None:
    """gymnasium's own order has an info in its place, which is true: each episode would have one step."""

    class InfoInItsPlace(LineEnv):
        def _step_state(self, action: Any) -> Any:
            return *super()._step_state(action)[:2], end

    env = InfoInItsPlace()
    env.reset()
    with pytest.raises(ValueError, match="for whether the episode terminates, expected True or False: return an observation"):
        env.step(np.zeros(1, dtype=np.float32))


def test_an_entropy_coefficient_of_another_kind_than_the_files(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    for theirs, ours in (("auto", 0.01), (0.01, "auto")):
        tiny_pearl(ent_coef=theirs).save(tmp_path / "model")
        with pytest.raises(ValueError, match=f"ent_coef is {ours!r}, and that of the file is of the other kind"):
            PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4), ent_coef=ours)


def test_a_step_of_all_envs_tells_of_each(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_task_vec_env(ENV_ID, 4)
    env.reset()
    vector_env = env.unwrapped.vector_env  # type: ignore[attr-defined]
    monkeypatch.setattr(
        vector_env, "_step_state", lambda actions: (np.zeros((4, 2), dtype=np.float32), 0.0, np.zeros(4, bool))
    )
    with pytest.raises(
        ValueError, match=r"expected arrays of the shapes \(\(4, 2\), \(4,\), \(4,\)\), got \(\(4, 2\), \(\), \(4,\)\)"
    ):
        env.step(np.zeros((4, 2), dtype=np.float32))
    monkeypatch.setattr(vector_env, "_step_state", lambda actions: (np.zeros((4, 2), np.float32), np.zeros(4), np.zeros(4)))
    with pytest.raises(ValueError, match="_step_state returns terminations of dtype float64, expected bool"):
        env.step(np.zeros((4, 2), dtype=np.float32))


def test_a_z_that_is_none_is_no_z_to_act_by(tiny_pearl: MakePEARL) -> None:
    """It would be saved, and found damaged; or give actions that are no numbers."""
    policy, none = tiny_pearl().policy, np.zeros(0)
    for z in (np.zeros((1, 3)), np.full(3, np.nan)):
        with pytest.raises(ValueError, match=r"z is .*, expected finite numbers of shape \(3,\)"):
            AdaptedAgent(policy, z, none, none.astype(bool))
    with pytest.raises(ValueError, match=r"z, the state, is .*nan.*, expected finite numbers: no action follows from it"):
        policy.predict(np.zeros(2, dtype=np.float32), (np.full((1, 3), np.nan, dtype=np.float32),))


@pytest.mark.parametrize("lengths", [(20, 1000), (1000, 20)])
def test_the_shortest_time_limit_around_an_env_is_the_one_that_counts(lengths: tuple[int, int], tiny_pearl: MakePEARL) -> None:
    inner, outer = lengths
    env = gym.wrappers.TimeLimit(gym.make(ENV_ID, max_episode_steps=inner), outer)
    assert tiny_pearl(env, n_tasks_per_rollout=1).max_episode_steps == 20


def test_the_longest_time_limit_of_several_envs_is_the_one_that_counts(tiny_pearl: MakePEARL) -> None:
    env = DummyVecEnv([partial(gym.make, ENV_ID, max_episode_steps=length) for length in (10, 20, 10, 10)])
    model = tiny_pearl(env).learn(ROLLOUT)
    assert model.max_episode_steps == 20 and model._n_updates > 0


def test_settings_of_another_time_limit_are_warned_of(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    longer = make_task_vec_env(ENV_ID, 4, env_kwargs={"max_episode_steps": 40})
    with pytest.warns(UserWarning, match="time limit is 40 steps, and what follows from it is still of 20: .*gamma"):
        PEARL.load(tmp_path / "model", env=longer)


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


def test_whole_numbers_are_no_actions(tiny_pearl: MakePEARL) -> None:
    whole = spaces.Box(-1, 1, (2,), np.int64)
    with pytest.raises(ValueError, match="has whole numbers, but actions are floats"):
        tiny_pearl(WithSpaces(gym.make(ENV_ID), action_space=whole), n_tasks_per_rollout=1)
    robot = Robot(20)
    robot.action_space = whole
    with pytest.raises(ValueError, match="has whole numbers, but actions are floats"):
        tiny_pearl().adapt(robot)


def test_no_action_follows_from_nothing(tiny_pearl: MakePEARL) -> None:
    agent = tiny_pearl().adapt(Robot(20), n_episodes=1)
    with pytest.raises(ValueError, match=r"The observation is \[nan  0\.\], expected finite numbers"):
        agent.predict(np.array([np.nan, 0.0]))


def test_an_env_that_is_refused_leaves_the_model_as_it_was(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    before = model.env
    with pytest.raises(ValueError, match="The env has no task_family"):
        model.set_env(DummyVecEnv([lambda: gym.wrappers.TimeLimit(Robot(20), 20)] * 4))
    assert model.env is before and model.learn(ROLLOUT)._n_updates > 0


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ((np.zeros(3, dtype=np.float32), 0.0), "observations must have the shape of its observation_space"),
        ((np.zeros(2, dtype=np.float32), np.zeros(2)), "an env's reward must be a number"),
        ((np.zeros(2, dtype=np.float32),), "an env's step must return observation, reward, terminated, truncated and info"),
    ],
)
def test_a_robot_that_returns_something_else(returned: Any, message: str, tiny_pearl: MakePEARL) -> None:
    robot = Robot(20)
    robot.step = lambda action: (*returned, False, False, {})  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=message):
        tiny_pearl().adapt(robot)


@pytest.mark.parametrize(
    "reset",
    [
        lambda **_: np.zeros(2, dtype=np.float32),
        lambda **_: np.zeros(3, dtype=np.float32),
        lambda: np.zeros(2, dtype=np.float32),
    ],
)
def test_a_robot_of_the_old_gym(reset: Any, tiny_pearl: MakePEARL) -> None:
    robot = Robot(20)
    robot.reset = reset  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="an env's reset must take seed and options, and return observation and info"):
        tiny_pearl().adapt(robot)


def test_what_a_wrapper_complains_of_is_said_as_it_is(tiny_pearl: MakePEARL) -> None:
    class Careful(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            raise ValueError("joint 3 is beyond its limit")

    with pytest.raises(ValueError, match=r"^joint 3 is beyond its limit$"):
        tiny_pearl().adapt(Careful(DummyVecEnv([lambda: Robot(20)])))


@pytest.mark.parametrize("normalizer", [gym.wrappers.NormalizeReward, gym.wrappers.NormalizeObservation])
def test_adaptation_to_what_is_normalized_elsewhere(normalizer: Any, tiny_pearl: MakePEARL) -> None:
    with pytest.raises(ValueError, match=f"{normalizer.__name__} stands between"):
        evaluate_adaptation(tiny_pearl(), wrapped(normalizer), n_episodes=1)


def test_an_env_that_names_its_task_by_the_index_alone(tiny_pearl: MakePEARL) -> None:
    """More is not in the contract."""

    class Bare(gym.Env[Any, Any]):
        max_episode_steps = 20

        def __init__(self) -> None:
            self.within = gym.make(ENV_ID)
            self.task_family = PointRobotFamily()
            self.observation_space, self.action_space = self.within.observation_space, self.within.action_space

        def reset(self, **kwargs: Any) -> Any:
            return self.within.reset(**kwargs)

        def step(self, action: Any) -> Any:
            return self.within.step(action)

    env = Bare()
    env.reset(options={"task_id": 7})
    assert len(tiny_pearl().adapt(env, n_episodes=2).returns) == 2
    assert env.reset()[1]["task_id"] == 7


@pytest.mark.parametrize("tasks", [[[0.0, 1.0]], np.zeros((0, 2)), np.zeros(3)])
def test_training_tasks_that_are_no_array_of_tasks(tasks: Any, tiny_pearl: MakePEARL) -> None:
    class Family(WithoutHook.Family):
        train_tasks = tasks

    env = WithoutHook(gym.make(ENV_ID))
    env.task_family = Family()
    with pytest.raises(ValueError, match=r"train_tasks are .*, expected an array \(n_tasks, task_dim\)"):
        tiny_pearl(env, n_tasks_per_rollout=1)


def test_an_evaluation_on_the_very_env_of_training(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    env = model.get_env()
    assert env is not None
    with pytest.raises(ValueError, match="eval_env is the env that is trained on"):
        model.learn(ROLLOUT, MetaEvalCallback(env, n_eval_episodes=1))


def test_a_model_needs_an_env_for_its_networks() -> None:
    with pytest.raises(ValueError, match="PEARL has no env to make its networks for"):
        PEARL("MlpPolicy", None)


class Band:
    """An object that has no text of its own."""

    def __init__(self, width: float) -> None:
        self.width, self.itself = width, self


def test_families_are_compared_by_all_that_is_in_them() -> None:
    def facts(value: Any) -> dict[str, str]:
        family = PointRobotFamily()
        vars(family)["part"] = value
        return family_facts(family)

    tensor = th.arange(2000.0)
    for one, other in (
        (Band(0.2), Band(0.3)),
        ([Band(0.2)], [Band(0.3)]),
        ({"x": (Band(0.2),)}, {"x": (Band(0.3),)}),
        (tensor, tensor + (tensor == 1000)),
        ({0, 8}, {0, 16}),
    ):
        assert facts(one) != facts(other)
        assert facts(one) == facts(copy.deepcopy(one))
    # Neither where it is in memory, nor the order of a set, which another process may have otherwise
    assert facts(np.random.default_rng(0)) == facts(np.random.default_rng(0))
    assert list({0, 8}) != list({8, 0}) and facts({0, 8}) == facts({8, 0})


@pytest.mark.parametrize("how", ["set_env", "load_replay_buffer"])
def test_rewards_of_which_no_attribute_tells_are_compared(
    how: str, tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def env() -> Any:
        return make_task_vec_env(ENV_ID, 4, env_kwargs=NEAR)

    model = tiny_pearl(env()).learn(ROLLOUT)
    model.save_replay_buffer(tmp_path / "buffer")
    tiny_pearl(env()).load_replay_buffer(tmp_path / "buffer")
    own = PointRobotFamily.compute_reward
    monkeypatch.setattr(PointRobotFamily, "compute_reward", lambda *args, **kwargs: 2 * own(*args, **kwargs))
    with pytest.raises(ValueError, match=r"What was collected is of another task family .* its compute_reward gives"):
        if how == "set_env":
            model.set_env(env())
        else:
            tiny_pearl(env()).load_replay_buffer(tmp_path / "buffer")


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        (np.zeros((2, 3)), "tasks have 3 numbers each, expected 2"),
        ([[50.0, 50.0]], r"The task \[\[50.0, 50.0\]\] is not in Box"),
    ],
)
def test_tasks_that_are_none_are_refused_before_the_training(tasks: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MetaEvalCallback(ENV_ID, tasks=tasks)


def test_evaluations_that_could_not_be_made_are_refused_before_the_training(tiny_pearl: MakePEARL) -> None:
    """The first one may be at its end."""
    model = tiny_pearl()
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.learn(ROLLOUT, MetaEvalCallback("SparseTargetSpeed-v0"))
    model.knowledge.set_tells_success(False)
    with pytest.raises(ValueError, match="explorer 'aggregate' goes by successes"):
        MetaEvalCallback(ENV_ID, explorer="aggregate").init_callback(model)
    assert model.num_timesteps == 0


def test_the_env_that_is_on_another_task_is_named() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    tasks = np.array([[1.0, 0.0], [0.0, 1.0]], dtype=np.float32)
    env.set_options([{"task": task} for task in tasks])
    env.reset()
    with pytest.raises(ValueError, match=r"Env 1 was asked for the task \[1. 0.\], and is on \[0. 1.\]"):
        check_tasks(env, tasks[[0, 0]])


def test_observations_come_without_infos(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    for observation in (gym.make(ENV_ID).reset(), None):
        with warnings.catch_warnings(), pytest.raises((ValueError, AttributeError)) as ours:
            warnings.simplefilter("ignore")
            model.predict(observation)  # type: ignore[arg-type]
        if observation is not None:
            assert "You have passed a tuple to the predict() function" in str(ours.value)


def test_lists_are_observations_too(tiny_pearl: MakePEARL) -> None:
    adaptation = tiny_pearl().learn(2 * ROLLOUT).start_adaptation(1, generator=th.Generator().manual_seed(0))
    assert adaptation.act([[0.0, 0.0]]).shape == (1, 2)  # type: ignore[arg-type]
