"""The step loop that rollouts, evaluations and whoever watches an agent share."""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, dummy_vec_env

from sb3_htr.adaptation.adaptation import Step
from sb3_htr.common.checks import get_max_episode_steps

# An adaptation gives up after an episode of so many times those of training: an env that never ends one would hang
ENDLESS = 10
RESET_RETURNS = "an env's reset must take seed and options, and return observation and info"
# Functions of SB3's DummyVecEnv, and what an env returned that cannot be stored there
NOT_STORED = {
    "reset": RESET_RETURNS,
    "_save_obs": "an env's observations must have the shape of its observation_space",
    "step_wait": "an env's reward must be a number",
}


@runtime_checkable
class Adapting(Protocol):
    """An adaptation in progress, such as :class:`sb3_htr.adaptation.Adaptation`."""

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """Actions (n_envs, action_dim) scaled to [-1, 1] for observations (n_envs, obs_dim)."""
        ...

    def observe(self, step: Step) -> None:
        """Take in one step of each env."""
        ...

    def exploring(self) -> np.ndarray:
        """(n_envs,) bool, whether it still explores, see :meth:`sb3_htr.adaptation.explorers.Explorer.exploring`."""
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
    max_episode_steps: int | None = None,
) -> Iterator[Step]:
    """
    Act until each env has finished so many episodes; envs whose episodes are shorter go on with more of them.

    :param env: after a reset
    :param adaptation: takes in each step, before it is yielded
    :param n_episodes: per env
    :param unscale_action: from [-1, 1] to the bounds of the action space
    :param act: observations (n_envs, obs_dim) to actions (n_envs, action_dim) scaled to [-1, 1]
    :param obs: (n_envs, obs_dim) of that reset
    :param max_episode_steps: that episodes of training had; by default the time limit of the env
    :return: what each env did, step by step
    :raises ValueError: for an episode that does not end, an env that goes on to another task, observations of another shape,
        rewards that are no numbers
    """
    longest = ENDLESS * (get_max_episode_steps(env) if max_episode_steps is None else max_episode_steps)
    length = np.zeros(env.num_envs, dtype=np.int64)
    tasks = _task_ids(env)
    if isinstance(adaptation, SeesTasks):
        adaptation.see_tasks(np.stack(env.get_attr("task")))
    remaining = np.full(env.num_envs, n_episodes)
    while (remaining > 0).any():
        actions = act(obs)
        with _returns_are_named():
            new_obs, rewards, dones, infos = env.step(unscale_action(actions))
        assert isinstance(new_obs, np.ndarray)
        next_obs = new_obs
        ended = np.flatnonzero(dones)
        if len(ended):
            next_obs = new_obs.copy()
            next_obs[ended] = [infos[i]["terminal_observation"] for i in ended]
            if (now := _task_ids(env)) != tasks:
                i = next(i for i in ended if now[i] != tasks[i])
                raise ValueError(
                    f"Between two episodes env {i} went from task {tasks[i]} to task {now[i]} by itself: a reset without "
                    "options, in the env or in a wrapper around it, must stay on the task."
                )
        length = np.where(dones, 0, length + 1)
        if length.max() > longest:
            raise ValueError(
                f"An episode goes on after {longest} steps, {ENDLESS} times what those of training had: the env must end its "
                "episodes, as in a gymnasium.wrappers.TimeLimit."
            )
        step = Step(obs, actions, rewards, next_obs, dones, infos, new_obs)
        adaptation.observe(step)
        yield step
        obs = new_obs
        remaining -= dones


def first_observations(env: VecEnv) -> np.ndarray:
    """
    :param env: to adapt in
    :return: (n_envs, obs_dim), after a reset
    :raises ValueError: if an env returns something else there than observation and info, as those of the old gym do
    """
    try:
        with _returns_are_named():
            obs = env.reset()
    except TypeError as error:
        if "unexpected keyword argument 'seed'" not in str(error):
            raise
        raise ValueError(f"{error}: {RESET_RETURNS}") from error
    for info in env.unwrapped.reset_infos:
        # Of an observation of two numbers, the second
        if not isinstance(info, dict):
            raise ValueError(f"{RESET_RETURNS}, but a {type(info).__name__} was in the place of the info.")
    return np.asarray(obs)


def _task_ids(env: VecEnv) -> list[Any]:
    """As the envs told at their latest resets; None where they do not."""
    return [info.get("task_id") for info in env.unwrapped.reset_infos]


@contextmanager
def _returns_are_named() -> Iterator[None]:
    """An env's returns are unpacked and stored by SB3, whose errors do not say what was expected."""
    try:
        yield
    except (ValueError, TypeError) as error:
        # Where SB3 stores what the env returned; within the env, an error is the env's own
        last = traceback.extract_tb(error.__traceback__)[-1]
        wrong = NOT_STORED.get(last.name)
        is_info = "item assignment" in str(error)
        if last.filename != dummy_vec_env.__file__ or wrong is None or not (is_info or isinstance(error, ValueError)):
            raise
        if last.name == "step_wait" and (is_info or "unpack" in str(error)):
            wrong = "an env's step must return observation, reward, terminated, truncated and info"
        raise ValueError(f"{error}: {wrong}") from error
