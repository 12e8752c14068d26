"""The robots that MuJoCo simulates."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from htr_envs import DynamicsEnv, DynamicsVectorEnv

mujoco = pytest.importorskip("mujoco")

from htr_envs.mujoco_dynamics import MujocoDynamics  # noqa: E402

WHEELED, ANT = "SparseWheeled-v0", "SparseAnt-v0"
both_envs = pytest.mark.parametrize("env_id", [WHEELED, ANT])


def make(env_id: str, **kwargs: Any) -> tuple[gym.Env[Any, Any], DynamicsEnv]:
    env = gym.make(env_id, **kwargs)
    assert isinstance(env.unwrapped, DynamicsEnv)
    return env, env.unwrapped


def make_vec(env_id: str, num_envs: int, **kwargs: Any) -> DynamicsVectorEnv:
    env = gym.make_vec(env_id, num_envs=num_envs, **kwargs)
    assert isinstance(env, DynamicsVectorEnv)
    return env


def robots(env: gym.Env[Any, Any] | DynamicsVectorEnv) -> MujocoDynamics:
    base = env.unwrapped
    assert isinstance(base, DynamicsEnv | DynamicsVectorEnv) and isinstance(base.dynamics, MujocoDynamics)
    return base.dynamics


def random_actions(env: gym.Env[Any, Any] | DynamicsVectorEnv, n_steps: int, seed: int = 0) -> Any:
    shape = env.action_space.shape
    assert shape is not None
    # some are beyond the bounds, which clip them
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (n_steps, *shape)).astype(np.float32)
