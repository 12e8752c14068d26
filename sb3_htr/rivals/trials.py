"""RL2's trials: several episodes on one task, seen by an agent as one."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_htr.common.checks import check_spaces, get_task_family
from sb3_htr.common.settings import check_numbers
from sb3_htr.common.vec_env import set_tasks
from sb3_htr.common.vec_wrappers import CopiedWrapper
from sb3_htr.rivals.actions import scaled


class LastStep:
    """
    What RL2's policy sees beside the observation: its last action, the last reward, and whether an episode begins.

    :param n_envs: number of envs
    :param action_dim: length of an action
    """

    def __init__(self, n_envs: int, action_dim: int) -> None:
        #: (n_envs, action_dim + 2) float32
        self.columns = np.zeros((n_envs, action_dim + 2), dtype=np.float32)
        self.forget(np.arange(n_envs))

    def forget(self, envs: np.ndarray) -> None:
        """
        :param envs: (k,) int, where a trial begins
        """
        self.columns[envs] = 0
        self.columns[envs, -1] = 1

    def take_in(self, actions: np.ndarray, rewards: np.ndarray, dones: np.ndarray) -> None:
        """
        :param actions: (n_envs, action_dim), scaled to [-1, 1]
        :param rewards: (n_envs,)
        :param dones: (n_envs,) bool, where an episode has ended
        """
        self.columns[:, :-2], self.columns[:, -2], self.columns[:, -1] = actions, rewards, dones

    def beside(self, obs: np.ndarray) -> np.ndarray:
        """
        :param obs: (n_envs, obs_dim)
        :return: (n_envs, obs_dim + action_dim + 2) float32
        """
        return np.concatenate([obs, self.columns], axis=1, dtype=np.float32)


class TrialVecEnv(CopiedWrapper):
    """
    Each episode of it is a trial: ``n_episodes`` episodes of the env on one training task, which the env draws. An observation
    is that of the env with :class:`LastStep` beside it. A trial's end is a true end, whatever its last episode ended with.

    :param venv: env of a task family
    :param n_episodes: episodes of a trial
    :raises ValueError: for a number below 1, or an env that has no tasks, or other observations and actions than vectors
    """

    def __init__(self, venv: VecEnv, n_episodes: int) -> None:
        check_numbers(n_episodes=(n_episodes, 1))
        check_spaces(venv)
        get_task_family(venv)
        obs, action = venv.observation_space, venv.action_space
        assert isinstance(obs, spaces.Box) and isinstance(action, spaces.Box)
        action_dim = action.shape[0]
        low, high = np.append(-np.ones(action_dim), [-np.inf, 0]), np.append(np.ones(action_dim), [np.inf, 1])
        space = spaces.Box(np.append(obs.low, low).astype(np.float32), np.append(obs.high, high).astype(np.float32))
        super().__init__(venv, observation_space=space)
        self.n_episodes = n_episodes
        self._episode = np.zeros(self.num_envs, dtype=np.int64)
        self._last = LastStep(self.num_envs, action_dim)

    def reset(self) -> VecEnvObs:
        """Begin a trial in each env."""
        everyone = np.arange(self.num_envs)
        set_tasks(self.venv, None, everyone)
        obs = self.venv.reset()
        assert isinstance(obs, np.ndarray)
        self._episode[:] = 0
        self._last.forget(everyone)
        self._arrange(everyone)
        return self._last.beside(obs)

    def _arrange(self, envs: np.ndarray) -> None:
        """Where an episode has just begun: keep its task for the trial, and in the last one let the env draw the next."""
        first, last = (envs[self._episode[envs] == episode] for episode in (0, self.n_episodes - 1))
        set_tasks(self.venv, np.array(self.venv.get_attr("task_id", first.tolist()), dtype=np.int64), first)
        set_tasks(self.venv, None, last)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(obs, np.ndarray)
        assert isinstance(self.action_space, spaces.Box)
        self._last.take_in(scaled(self._actions, self.action_space), rewards, dones)
        ended = np.flatnonzero(dones)
        trial_ends = np.zeros(self.num_envs, dtype=bool)
        if len(ended):
            self._episode[ended] += 1
            over = ended[self._episode[ended] == self.n_episodes]
            trial_ends[over] = True
            self._end(over, obs, infos)
            self._arrange(ended)
        return self._last.beside(obs), rewards, trial_ends, infos

    def _end(self, envs: np.ndarray, obs: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Trials that are over."""
        final = obs.copy()
        for env in envs:
            final[env] = infos[env]["terminal_observation"]
        final = self._last.beside(final)
        for env in envs:
            infos[env].update({"terminal_observation": final[env], "TimeLimit.truncated": False})
        self._episode[envs] = 0
        self._last.forget(envs)
