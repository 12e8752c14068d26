"""Random walks of the point robot, stored."""

from typing import Any

import gymnasium as gym
import numpy as np

from helpers import ENV_ID
from htr_envs import PointRobotFamily, Trajectory
from sb3_htr import MultiTaskReplayBuffer
from sb3_htr.common.type_aliases import MultiTaskSamples

FAMILY = PointRobotFamily()


def make_buffer(n_envs: int = 2, buffer_size: int = 8000, **kwargs: Any) -> MultiTaskReplayBuffer:
    """An empty buffer."""
    env = gym.make(ENV_ID)
    settings = {"task_family": FAMILY, "max_episode_steps": 20, "seed": 0, "device": "cpu", "n_envs": n_envs, **kwargs}
    return MultiTaskReplayBuffer(buffer_size, env.observation_space, env.action_space, **settings)


def add_episode(
    buffer: MultiTaskReplayBuffer,
    tasks: list[int],
    length: int,
    rng: np.random.Generator,
    terminated: bool = False,
    task_free: float = 0.0,
) -> None:
    """Add one random walk per env, with the true reward of its task beside what each step returns."""
    n = len(tasks)
    family = buffer.task_family
    obs = np.zeros((n, 2), dtype=np.float32)
    for step in range(length):
        action = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        next_obs = (obs + 0.1 * action).astype(np.float32)
        traj = Trajectory(obs[:, None], action[:, None], next_obs[:, None], np.full((n, 1), task_free, dtype=np.float32))
        reward = family.compute_reward(traj, family.train_tasks[tasks])[:, 0]
        done = np.full(n, step == length - 1)
        infos: list[dict[str, Any]] = [
            {"task_id": task, "task_free_reward": task_free, "TimeLimit.truncated": bool(done[0]) and not terminated}
            for task in tasks
        ]
        buffer.add(obs, next_obs, action, reward, done, infos)
        obs = next_obs


def filled(
    walk_seed: int = 0, n_episodes: int = 6, lengths: tuple[int, ...] = (20,), task_free: float = 0.0, **kwargs: Any
) -> MultiTaskReplayBuffer:
    """A buffer with so many episodes of each of two envs, on seven tasks."""
    rng = np.random.default_rng(walk_seed)
    buffer = make_buffer(**kwargs)
    for i in range(n_episodes):
        add_episode(buffer, [i % 3, 3 + i % 4], lengths[i % len(lengths)], rng, task_free=task_free)
    return buffer


def by_task(values: Any, lengths: Any) -> list[np.ndarray]:
    """The rows of a sample, one array for each row of the meta-batch."""
    return np.split(np.asarray(values), np.cumsum(np.asarray(lengths))[:-1])


def assert_same(a: MultiTaskSamples, b: MultiTaskSamples) -> None:
    """Bit for bit."""
    for name, x, y in zip((*a.context._fields, *a._fields[1:]), (*a.context, *a[1:]), (*b.context, *b[1:]), strict=True):
        assert (np.asarray(x) == np.asarray(y)).all(), name
