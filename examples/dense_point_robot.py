"""The Point Robot whose every step tells how far the goal is, in training and at meta-test: what a dense context is worth.

    sb3-htr experiment dense_context --gym-packages examples.experiments

SparsePointRobot-v0 pays 0 until its goal is reached; the dense proxy is for RL batches alone, as PEARL's reference has it, so
that an agent adapts to sparse rewards. Here the proxy is the reward of the env itself: one step nearly tells the task. That is
no rival under the same rules, but says how much of what the proxy lacks is the search.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from htr_envs import MetaEnv, TaskDistribution, TaskFamily
from htr_envs.point_robot import PointRobotEnv
from htr_envs.task_env import FloatArray


class Goals(TaskDistribution):
    """The tasks of a family without its hook: with dense rewards there is nothing to relabel, nor to know beforehand."""

    def __init__(self, family: TaskFamily) -> None:
        self.family = family
        super().__init__(family.task_space, family.train_tasks, family.validation_tasks, family.test_tasks)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        return self.family.sample_tasks(n, rng)


class DensePointRobotEnv(MetaEnv):
    """
    SparsePointRobot-v0, rewarded by minus the distance to the goal. ``info["is_success"]`` is that of the sparse env.

    :param family_kwargs: of its family
    """

    def __init__(self, **family_kwargs: Any) -> None:
        self.robot = PointRobotEnv("dense", **family_kwargs)
        super().__init__(Goals(self.robot.task_family))
        self.observation_space, self.action_space = self.robot.observation_space, self.robot.action_space

    def _reset_state(self) -> FloatArray:
        obs, _ = self.robot.reset(seed=int(self.np_random.integers(2**31)), options={"task": self.task})
        return obs

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        obs, reward, terminated, _, self.robot_info = self.robot.step(action)
        return obs, reward, terminated

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, {**info, "is_success": self.robot_info["is_success"]}


gym.register("DensePointRobot-v0", entry_point=DensePointRobotEnv, max_episode_steps=20)
