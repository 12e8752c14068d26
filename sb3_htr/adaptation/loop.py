"""The step loop that rollouts, evaluations and whoever watches an agent share."""

from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.adaptation import Step


class Adapting(Protocol):
    """An adaptation in progress, such as :class:`sb3_htr.adaptation.Adaptation`."""

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """Actions (n_envs, action_dim) scaled to [-1, 1] for observations (n_envs, obs_dim)."""
        ...

    def observe(self, step: Step) -> None:
        """Take in one step of each env."""
        ...

    def exploring(self) -> np.ndarray:
        """(n_envs,) bool, whether nothing is known about the task yet but what was tried in vain."""
        ...

    def deviation(self) -> np.ndarray:
        """(n_envs,), how uncertain the task is, in units of the agent's own; NaN for an agent that cannot say."""
        ...


@runtime_checkable
class SeesTasks(Protocol):
    """An adaptation that is told the tasks: of an agent that is no rival but a ceiling."""

    def see_tasks(self, tasks: np.ndarray) -> None:
        """Tasks (n_envs, task_dim) of the envs, before the first step."""
        ...


def adaptation_steps(
    env: VecEnv,
    adaptation: Adapting,
    n_episodes: int,
    unscale_action: Callable[[np.ndarray], np.ndarray],
    act: Callable[[np.ndarray], np.ndarray],
    obs: np.ndarray,
) -> Iterator[Step]:
    """
    Act until each env has finished so many episodes; envs whose episodes are shorter go on with more of them.

    :param env: after a reset
    :param adaptation: takes in each step, before it is yielded
    :param n_episodes: per env
    :param unscale_action: from [-1, 1] to the bounds of the action space
    :param act: observations (n_envs, obs_dim) to actions (n_envs, action_dim) scaled to [-1, 1]
    :param obs: (n_envs, obs_dim) of that reset
    :return: what each env did, step by step
    """
    if isinstance(adaptation, SeesTasks):
        adaptation.see_tasks(np.stack(env.get_attr("task")))
    remaining = np.full(env.num_envs, n_episodes)
    while (remaining > 0).any():
        actions = act(obs)
        new_obs, rewards, dones, infos = env.step(unscale_action(actions))
        assert isinstance(new_obs, np.ndarray)
        next_obs = new_obs
        ended = np.flatnonzero(dones)
        if len(ended):
            next_obs = new_obs.copy()
            next_obs[ended] = [infos[i]["terminal_observation"] for i in ended]
        step = Step(obs, actions, rewards, next_obs, dones, infos)
        adaptation.observe(step)
        yield step
        obs = new_obs
        remaining -= dones
