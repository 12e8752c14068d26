"""Agents that nobody trained: random actions are the floor, a script that is told the task is a ceiling."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.rivals.actions import unscaled
from sb3_htr.rivals.adaptation import OwnWay, ToldAdaptation, check_explores_in_own_way

# Observations (n, obs_dim) and tasks (n, task_dim) to actions (n, action_dim), scaled to [-1, 1]
Script = Callable[[np.ndarray, np.ndarray], np.ndarray]


class ScriptedAgent:
    """
    Is evaluated as a trained one is, by :func:`sb3_htr.evaluate_adaptation`.

    :param action_space: Box
    :param script: observations (n, obs_dim) and the tasks to solve (n, task_dim) to actions (n, action_dim), scaled to
        [-1, 1]; by default, actions are uniformly random, whatever the task
    :raises ValueError: for another action space
    """

    explorer = OwnWay()

    def __init__(self, action_space: spaces.Space[Any], script: Script | None = None) -> None:
        if not isinstance(action_space, spaces.Box):
            raise ValueError(f"action_space is {action_space}, expected a Box: a script's actions are scaled to its bounds.")
        self.action_space = action_space
        self.script = script

    @property
    def policy(self) -> "ScriptedAgent":
        """What knows the action space."""
        return self

    def unscale_action(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: (n, action_dim), scaled to [-1, 1]
        :return: the same, in the bounds of the action space
        """
        return unscaled(actions, self.action_space)

    def check_env(self, env: VecEnv) -> None:
        """
        :param env: to act in
        :raises ValueError: if its actions are others than the script's
        """
        check_for_correct_spaces(env, env.observation_space, self.action_space)

    def start_adaptation(self, n_envs: int, explorer: Any = None, generator: th.Generator | None = None) -> ToldAdaptation:
        """
        :param n_envs: number of tasks
        :param explorer: None or ``"own"``: a script explores in no other way
        :param generator: source of random actions; torch's global one by default
        :return: acts by the script
        :raises ValueError: for an explorer
        """
        check_explores_in_own_way(self, explorer)

        def act(obs: np.ndarray, tasks: np.ndarray, deterministic: bool) -> np.ndarray:
            if self.script is not None:
                return self.script(obs, tasks)
            return np.asarray(2 * th.rand((len(obs), *self.action_space.shape), generator=generator).numpy() - 1)

        return ToldAdaptation(n_envs, act)
