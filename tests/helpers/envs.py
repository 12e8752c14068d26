"""Registered task envs, single, batched and wrapped; and a robot that has no tasks."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers import ENV_ID
from htr_envs import TaskEnv, TaskVectorEnv


def make(env_id: str, **kwargs: Any) -> tuple[gym.Env[Any, Any], TaskEnv]:
    env = gym.make(env_id, **kwargs)
    base = env.unwrapped
    assert isinstance(base, TaskEnv)
    return env, base


def make_vec(env_id: str, num_envs: int, **kwargs: Any) -> TaskVectorEnv:
    env = gym.make_vec(env_id, num_envs=num_envs, **kwargs)
    assert isinstance(env, TaskVectorEnv)
    return env


def times_three(env: gym.Env) -> gym.Env:
    """
    :param env: with actions from -1 to 1
    :return: the same with actions from -3 to 3
    """
    return gym.wrappers.RescaleAction(env, np.float32(-3), np.float32(3))


def wrapped(wrapper: Any, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda: wrapper(gym.make(ENV_ID, **kwargs))] * 4)


class Rescaled(gym.ActionWrapper[Any, Any, Any]):
    """The same robot with actions in other units, which are float64."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = spaces.Box(np.array([0.0, -30.0]), np.array([2.0, 50.0]), dtype=np.float64)

    def action(self, action: Any) -> Any:
        return (action - np.array([1.0, 10.0])) / np.array([1.0, 40.0])


class DropsOptions(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper as people write them."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=seed)


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
