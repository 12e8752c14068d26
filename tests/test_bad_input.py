"""Envs and settings that cannot work are refused in one sentence, before any work is lost."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import ENV_ID
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from htr_envs import PointRobotEnv
from sb3_htr import PEARL
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env

MakePEARL = Callable[..., PEARL]


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
            "The observation space is Dict.* but PEARL needs a Box of one axis",
        ),
        (lambda: WithSpaces(gym.make(ENV_ID), action_space=spaces.Discrete(3)), "The action space is Discrete"),
        (lambda: gym.make(ENV_ID, reward_type="dense"), "reward_type is not 'sparse'.*rl_reward_type"),
        (lambda: PointRobotEnv(), "The env has no time limit"),
        (lambda: VecNormalize(make_task_vec_env(ENV_ID, 2)), "VecNormalize rescales rewards.*pass norm_reward=False"),
        (lambda: DummyVecEnv([lambda: gym.make("Pendulum-v1")]), "no task_family"),
    ],
)
def test_envs(tiny_pearl: MakePEARL, make_env: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_pearl(make_env()).learn(1)


def test_an_unknown_id_is_gymnasiums_business(tiny_pearl: MakePEARL) -> None:
    with pytest.raises(gym.error.NameNotFound, match="SparsePointRobot"):
        tiny_pearl("SparsePointRobo-v0")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"meta_batch_size": 0}, "meta_batch_size is 0, expected at least 1"),
        ({"batch_size": -1}, "batch_size is -1"),
        ({"context_size": 0}, "context_size is 0"),
        ({"n_tasks_per_rollout": 0}, "n_tasks_per_rollout is 0"),
        ({"n_episodes_per_task": 0}, "n_episodes_per_task is 0"),
        ({"kl_coef": -0.1}, "kl_coef is -0.1, expected 0 or more"),
        ({"explorer": "random"}, "explorer is 'random', expected one of"),
        ({"train_explorer": "random"}, "explorer is 'random'"),
        ({"policy_kwargs": {"latent_dim": 0}}, "latent_dim is 0, expected at least 1"),
        ({"replay_buffer_kwargs": {"relabel_probability": -1}}, "relabel_probability is -1"),
        ({"buffer_size": 10}, "buffer_size is 10, too small"),
        ({"policy": "CnnPolicy"}, "CnnPolicy unknown"),
    ],
)
def test_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PEARL(**{"policy": "MlpPolicy", "env": ENV_ID, **kwargs})


def test_rewards_that_become_nan_stop_training(tiny_pearl: MakePEARL) -> None:
    class Broken(gym.RewardWrapper[Any, Any]):
        def reward(self, reward: Any) -> Any:
            return float("nan")

    with pytest.raises(ValueError, match=r"The reward of task .* is nan, expected finite numbers"):
        tiny_pearl(Broken(gym.make(ENV_ID))).learn(1)


def test_options_of_a_batch_must_agree() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    env.set_options([{"task_id": 1}, {}])
    with pytest.raises(ValueError, match="options with the same keys"):
        env.reset()


def test_only_same_step_autoreset_can_be_an_sb3_vec_env() -> None:
    env = gym.make_vec(ENV_ID, 2, vectorization_mode="sync")
    with pytest.raises(ValueError, match=r"expected AutoresetMode\.SAME_STEP"):
        BatchedTaskVecEnv(env)
