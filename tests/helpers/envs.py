"""Registered task envs, single and batched."""

from typing import Any

import gymnasium as gym
import numpy as np

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
