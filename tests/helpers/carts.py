"""An env whose tasks change its dynamics, and whose rewards are no function of a step that anybody wrote down."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from htr_envs import MetaEnv, TaskDistribution


class HeavyDistribution(TaskDistribution):
    """How heavy a cart is."""

    def __init__(self) -> None:
        super().__init__(spaces.Box(0.5, 4.0, (1,), np.float32), [[1.0], [2.0]], [[1.5]], [[3.0]])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> Any:
        return rng.uniform(0.5, 4.0, (n, 1)).astype(np.float32)


class CartEnv(MetaEnv):
    """Pushed along a line; it ends where a heavy cart has gone less far."""

    def __init__(self) -> None:
        super().__init__(HeavyDistribution())
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.max_episode_steps = 10
        self.x, self.noise = 0.0, np.random.default_rng(0)

    def first(self) -> float:
        return float(self.np_random.normal())

    def _reset_state(self) -> Any:
        self.x = self.first()
        return [self.x]

    def push(self, action: Any) -> float:
        return float(action[0] / self.task[0])

    def _step_state(self, action: Any) -> Any:
        self.x += self.push(action)
        return [self.x], self.x, abs(self.x) > 2


def make_cart() -> gym.Env[Any, Any]:
    """With its time limit."""
    return TimeLimit(CartEnv(), 10)
