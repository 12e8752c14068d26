"""How a rival acts in an adaptation."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_htr.adaptation.adaptation import Step, check_rows, check_step


class OwnWay:
    """In the place of an explorer."""

    name = "own"


def check_explores_in_own_way(agent: object, explorer: Any) -> None:
    """
    :param agent: that has no explorers
    :param explorer: what is asked for
    :raises ValueError: if that is one
    """
    if explorer not in (None, OwnWay.name):
        raise ValueError(f"{type(agent).__name__} has no explorers, but the explorer is {explorer!r}: leave it out.")


class RivalAdaptation(ABC):
    """
    Keeps what anybody can see of an adaptation; a subclass says how to act.

    :param n_envs: number of tasks
    """

    def __init__(self, n_envs: int) -> None:
        self.n_envs = n_envs
        self._found = np.zeros(n_envs, dtype=bool)

    @abstractmethod
    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        :param obs: (n_envs, obs_dim)
        :param deterministic: mean actions instead of samples
        :return: (n_envs, action_dim), scaled to [-1, 1]
        :raises ValueError: for observations of another number of envs, NaN and infinity
        """

    def observe(self, step: Step) -> None:
        """
        :param step: what each env did
        :raises ValueError: for arrays of other shapes, NaN and infinity, and actions that are not scaled
        """
        # How wide they are is the env's, which an adaptation of one's own need not know
        obs_dim, action_dim = (np.atleast_1d(rows).shape[-1] for rows in (step.observations, step.actions))
        check_step(step, self.n_envs, obs_dim, action_dim)
        if step.infos:
            self._found |= [bool(info.get("is_success", False)) for info in step.infos]

    def exploring(self) -> np.ndarray:
        """
        :return: (n_envs,) bool, whether the task was not solved yet; for those who watch, the agent is not told
        """
        return ~self._found

    def _check_observations(self, obs: np.ndarray) -> None:
        # How wide they are, networks and scripts say themselves
        check_rows("observations", obs, self.n_envs, *np.shape(obs)[1:])

    def deviation(self) -> np.ndarray:
        """
        :return: (n_envs,) NaN: there is no z
        """
        return np.full(self.n_envs, np.nan)


class ToldAdaptation(RivalAdaptation):
    """
    No adaptation at all: who acts is told the tasks.

    :param n_envs: number of tasks
    :param act: observations (n_envs, obs_dim), tasks (n_envs, task_dim) and whether actions are to be means instead of
        samples, to actions (n_envs, action_dim) scaled to [-1, 1]
    """

    def __init__(self, n_envs: int, act: Callable[[np.ndarray, np.ndarray, bool], np.ndarray]) -> None:
        super().__init__(n_envs)
        self._act = act
        self._tasks: np.ndarray | None = None

    def see_tasks(self, tasks: np.ndarray) -> None:
        """
        :param tasks: (n_envs, task_dim)
        """
        self._tasks = tasks

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        :param obs: (n_envs, obs_dim)
        :param deterministic: mean actions instead of samples
        :return: (n_envs, action_dim), scaled to [-1, 1]
        :raises ValueError: before the tasks were told; for observations of another number of envs, NaN and infinity
        """
        if self._tasks is None:
            raise ValueError("Who acts here is told its tasks: call see_tasks, with a row for each env, first.")
        self._check_observations(obs)
        return self._act(obs, self._tasks, deterministic)

    def exploring(self) -> np.ndarray:
        """
        :return: (n_envs,) False: there is nothing to find out
        """
        return np.zeros(self.n_envs, dtype=bool)
