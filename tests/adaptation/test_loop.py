"""The step loop that rollouts, evaluations and players share."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers import ENV_ID
from sb3_htr.adaptation import Step
from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.rivals.adaptation import RivalAdaptation


class Noting(RivalAdaptation):
    """Acts at random, and notes what it is told."""

    def __init__(self) -> None:
        super().__init__(n_envs=2)
        self.steps: list[Step] = []
        self.rng = np.random.default_rng(0)

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        return self.rng.uniform(-1, 1, (len(obs), 2)).astype(np.float32)

    def observe(self, step: Step) -> None:
        self.steps.append(step)


def test_each_env_finishes_its_episodes_and_each_step_is_whole() -> None:
    """Also where episodes end at different times, and the env is reset within the step that ends one."""
    lengths = (5, 3)
    env = DummyVecEnv([partial(gym.make, ENV_ID, max_episode_steps=length) for length in lengths])
    noting = Noting()
    env.set_options({"task_id": 0})
    first = env.reset()
    assert isinstance(first, np.ndarray)
    steps = list(adaptation_steps(env, noting, 2, lambda actions: actions, noting.act, first))
    assert len(steps) == 2 * 5, "until the slowest has done its episodes"
    assert all(told is step for told, step in zip(noting.steps, steps, strict=True)), "told before it is yielded"
    for i, length in enumerate(lengths):
        assert [bool(step.dones[i]) for step in steps] == [(n + 1) % length == 0 for n in range(10)]
        expected = first[i]
        for step in steps:
            np.testing.assert_array_equal(step.observations[i], expected)
            moved = step.observations[i] + 0.1 * step.actions[i]
            np.testing.assert_allclose(step.next_observations[i], moved, atol=1e-6, err_msg="the last one of its episode")
            expected = np.zeros(2) if step.dones[i] else step.next_observations[i]


def test_an_episode_that_nobody_ends_is_given_up() -> None:
    class Endless(gym.Wrapper[Any, Any, Any, Any]):
        max_episode_steps = 3

    env = DummyVecEnv([lambda: Endless(gym.make(ENV_ID, max_episode_steps=1000))])
    first = env.reset()
    assert isinstance(first, np.ndarray)
    with pytest.raises(ValueError, match="An episode goes on after 30 steps, 10 times what those of training had"):
        list(adaptation_steps(env, Noting(), 1, lambda actions: actions, Noting().act, first))
