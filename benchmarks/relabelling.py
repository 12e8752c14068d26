"""Relabelled transitions per second, against Stable-Baselines3's HerReplayBuffer."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from _common import Figure, by_turns, faster, look_at_all, seconds, write
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her import HerReplayBuffer

from htr_envs import PointRobotFamily
from sb3_htr.htr import MultiTaskReplayBuffer

# Steps added at a time, and steps of an episode
N_ENVS, LENGTH = 80, 20
K = 0.8  # of HER with four virtual goals for each real one, too


class GoalEnv(gym.Env[Any, Any]):
    """The point robot as HER wants it; only its spaces and its reward are used."""

    place = spaces.Box(-10, 10, (2,), np.float32)
    observation_space = spaces.Dict({"observation": place, "achieved_goal": place, "desired_goal": place})
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        """Sparse reward of the point robot."""
        distance = np.sqrt(np.square(achieved - desired).sum(axis=-1))
        return np.where(distance < 0.2, 1 - distance, 0)


def filled(capacity: int) -> tuple[MultiTaskReplayBuffer, HerReplayBuffer]:
    """
    :param capacity: in transitions
    :return: ours and SB3's, full of the same random walks
    """
    rng, spec = np.random.default_rng(0), GoalEnv()
    ours = MultiTaskReplayBuffer(
        capacity,
        spec.place,
        spec.action_space,
        device="cpu",
        n_envs=N_ENVS,
        task_family=PointRobotFamily(),
        max_episode_steps=LENGTH,
        relabel_probability=K,
    )
    env = DummyVecEnv([GoalEnv])
    her = HerReplayBuffer(capacity, spec.observation_space, spec.action_space, env, "cpu", N_ENVS, copy_info_dict=False)
    infos = [{"task_id": i % 80, "task_free_reward": 0.0, "TimeLimit.truncated": True} for i in range(N_ENVS)]
    position = np.zeros((N_ENVS, 2), dtype=np.float32)
    for step in range(capacity // N_ENVS):
        action = rng.uniform(-1, 1, (N_ENVS, 2)).astype(np.float32)
        moved, done, reward = position + 0.1 * action, np.full(N_ENVS, step % LENGTH == LENGTH - 1), np.zeros(N_ENVS)
        ours.add(position, moved, action, reward, done, infos)
        obs, new_obs = ({"observation": p, "achieved_goal": p, "desired_goal": 0 * p + 1} for p in (position, moved))
        her.add(obs, new_obs, action, reward, done, infos)
        position = np.where(done[:, None], np.float32(0), moved)
    return ours, her


def main() -> None:
    """
    Batches of about as many rows, of which K are relabelled: ours are contexts of 20 and RL batches of 16 rows a task. What
    ours asks of a step once, when it is first drawn, was asked before.
    """
    th.set_num_threads(1)
    figures = []
    for capacity in (10_000, 100_000, 1_000_000):
        ours, her = filled(capacity)
        look_at_all(ours)
        for batch in (256, 4096):
            n_tasks = round(batch / 36)
            draw = partial(ours.sample, 16, meta_batch_size=n_tasks, context_size=20)
            times = by_turns({"ours": partial(seconds, draw, 50), "her": partial(seconds, partial(her.sample, batch), 50)})
            per_row = times["ours"] / (36 * n_tasks * K), times["her"] / (batch * K)
            ours_rate, her_rate = (float(1e-6 / th.tensor(duration).median()) for duration in per_row)
            name = f"batch {batch}, capacity {capacity:,}"
            # SB3's and PEARL's default capacity
            goal = 3.0 if capacity == 1_000_000 else None
            figures.append(Figure(name, "million/s", ours_rate, her_rate, faster(*per_row), goal, "SB3 HerReplayBuffer"))
    write("relabelling", figures)


if __name__ == "__main__":
    main()
