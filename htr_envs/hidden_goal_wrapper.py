"""HiddenGoalWrapper: a GoalEnv itself, as the agents of its hidden goals see it."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from htr_envs.goal_env_source import SPARSE_ONLY, check_goal_env, space_without_goal, without_goal
from htr_envs.task_env import FloatArray


class HiddenGoalWrapper(gym.Wrapper[Any, Any, Any, Any]):
    """A robot with the interface of a GoalEnv, to adapt to its goal with an agent that was trained in ``HiddenGoal/ID``.

    Observations are ``observation`` and ``achieved_goal``, in this order, rewards 1 where the GoalEnv pays that its goal is
    reached and 0 elsewhere. All episodes of an adaptation are of one task, so the goal must stay until ``reset`` is given a
    seed or options; another one may have a wrapper of its own, too. Most simulations draw one at each reset, and are refused:
    there, ``HiddenGoal/ID`` does what is wanted.

    :param env: with a sparse reward, -1 and 0 or 0 and 1.
    :raises ValueError: if it is no GoalEnv.
    """

    def __init__(self, env: gym.Env[dict[str, Any], NDArray[Any]]) -> None:
        super().__init__(env)
        self._name = env.spec.id if env.spec else type(env.unwrapped).__name__
        check_goal_env(env, self._name)
        self.observation_space = space_without_goal(env)
        self._goal = np.empty(0)  # which is no goal
        self._success = np.nan

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode.

        :param seed: as the GoalEnv takes it; with one, the goal may be another.
        :param options: as the GoalEnv takes them; with some, the goal may be another.
        :return: observation (obs_dim,), info of the GoalEnv.
        :raises ValueError: if the goal is another one without either, or not finite, or the reward is not sparse.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        if not self._goal.size or seed is not None or options:
            self._goal = np.array(observation["desired_goal"])
            if not np.isfinite(self._goal).all():
                raise ValueError(f"The desired_goal of {self._name} is {self._goal}, expected finite numbers.")
            # One goal at a time, as a robot need not take many; copies, which it may write into
            compute_reward = self.env.get_wrapper_attr("compute_reward")
            self._success = float(compute_reward(self._goal.copy(), self._goal.copy(), {}))
            self._check_sparse(self._success)
        self._check_goal(observation)
        return without_goal(observation), info

    def step(self, action: NDArray[Any]) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Do one step.

        :param action: as the GoalEnv takes it.
        :return: next observation (obs_dim,), reward, terminated, truncated, info of the GoalEnv.
        :raises ValueError: if the goal is another one, or the reward is not sparse.
        """
        observation, paid, terminated, truncated, info = self.env.step(action)
        self._check_goal(observation)
        self._check_sparse(float(paid))
        if terminated and paid == self._success:
            warnings.warn(
                f"{self._name} ends an episode where its goal is reached, and HiddenGoal goes on there: the agent has learnt "
                "to stay, and returns count the steps that it stays for. Let the robot go on up to its time limit.",
                stacklevel=2,
            )
        return without_goal(observation), float(paid) - self._success + 1.0, terminated, truncated, info

    def _check_sparse(self, reward: float) -> None:
        if self._success not in (0.0, 1.0) or reward not in (self._success, self._success - 1.0):
            raise ValueError(f"{self._name} pays {reward:.3g}, {SPARSE_ONLY}")

    def _check_goal(self, observation: dict[str, Any]) -> None:
        if not np.array_equal(observation["desired_goal"], self._goal):
            raise ValueError(
                f"{self._name} was at another goal, {observation['desired_goal']} in the place of {self._goal}, but all "
                "episodes of an adaptation are of one task: let its goal stay until reset is given a seed or options; in "
                f"simulation, take HiddenGoal/{self._name.replace('/', '-')}, which stays on a goal."
            )
