"""Small models and experience for the tests."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import settings

import htr_envs
from sb3_htr import PEARL, MultiTaskReplayBuffer

th.set_num_threads(1)
# Timings on a shared machine say nothing; `--hypothesis-profile nightly` looks harder
settings.register_profile("ci", deadline=None, max_examples=50)
settings.register_profile("nightly", deadline=None, max_examples=2000)
settings.load_profile("ci")


def many(test: Callable[..., None]) -> Callable[..., None]:
    """For fuzzing: 200 examples, or more if the profile has more."""
    return settings(max_examples=max(200, settings().max_examples))(test)


ENV_ID = "SparsePointRobot-v0"
TINY: dict[str, Any] = {
    "n_tasks_per_rollout": 4,
    "n_episodes_per_task": 3,
    "n_exploration_episodes": 1,
    "learning_starts": 40,
    "gradient_steps": 3,
    "meta_batch_size": 8,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [16], "encoder_arch": [16], "latent_dim": 3},
    "seed": 0,
}


@pytest.fixture
def tiny_pearl() -> Callable[..., PEARL]:
    """A PEARL that trains in a moment; keyword arguments change its settings."""

    def make(env: Any = ENV_ID, **kwargs: Any) -> PEARL:
        return PEARL("MlpPolicy", env, **{**TINY, **kwargs})

    return make


@pytest.fixture
def family() -> htr_envs.PointRobotFamily:
    """The point robot's tasks and rewards."""
    return htr_envs.PointRobotFamily()


def make_buffer(
    family: Any, n_envs: int = 2, buffer_size: int = 8000, buffer_class: Any = MultiTaskReplayBuffer, **kwargs: Any
) -> MultiTaskReplayBuffer:
    """An empty buffer for the point robot."""
    env = gym.make(ENV_ID)
    buffer: MultiTaskReplayBuffer = buffer_class(
        buffer_size,
        env.observation_space,
        env.action_space,
        device="cpu",
        n_envs=n_envs,
        **{"task_family": family, "max_episode_steps": 20, "seed": 0, **kwargs},
    )
    return buffer


def add_episode(
    buffer: MultiTaskReplayBuffer, tasks: list[int], length: int, rng: np.random.Generator, terminated: bool = False
) -> None:
    """Add one random walk of the point robot per env, with the true reward of its task."""
    n = len(tasks)
    family = buffer.task_family
    obs = np.zeros((n, 2), dtype=np.float32)
    for step in range(length):
        action = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        next_obs = (obs + 0.1 * action).astype(np.float32)
        traj = htr_envs.Trajectory(obs[:, None], action[:, None], next_obs[:, None], np.zeros((n, 1), dtype=np.float32))
        reward = family.compute_reward(traj, family.train_tasks[tasks])[:, 0]
        done = np.full(n, step == length - 1)
        infos: list[dict[str, Any]] = [
            {"task_id": task, "task_free_reward": 0.0, "TimeLimit.truncated": bool(done[0]) and not terminated}
            for task in tasks
        ]
        buffer.add(obs, next_obs, action, reward, done, infos)
        obs = next_obs
