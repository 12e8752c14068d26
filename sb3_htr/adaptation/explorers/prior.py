"""PEARL's own protocol."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sb3_htr.adaptation.explorers.base import Explorer
from sb3_htr.common.settings import check_numbers

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Step


@dataclass
class FixedExploration(Explorer):
    """
    Explores for a number of episodes that is fixed beforehand, whatever they find.

    :param n_exploration_episodes: 0 or more episodes before the posterior is used (PEARL's reference, num_exp_traj_eval: 5 for
        the sparse point robot, 1 or 2 for others)
    :raises ValueError: if it is negative
    """

    n_exploration_episodes: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(n_exploration_episodes=(self.n_exploration_episodes, 0))

    def exploring(self) -> np.ndarray:
        return np.asarray(self.adaptation.n_episodes < self.n_exploration_episodes)

    def observe(self, step: "Step") -> None:
        ended = np.flatnonzero(step.dones)
        if len(ended):
            self.adaptation.infer(ended, keep=True)
            self.draw(ended)

    def final_z(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), the z to act with when no more episodes follow. Where all of them explored, a draw from
            the posterior over them, as z is still one that nothing was learnt for
        """
        z = super().final_z()
        explored = np.flatnonzero(self.exploring() & (self.adaptation.n_episodes > 0))
        if len(explored):
            z[explored] = self.inferred(explored)
        return z

    @abstractmethod
    def draw(self, envs: np.ndarray) -> None:
        """
        Choose z for the next episode.

        :param envs: (k,) int, whose episodes have ended, and are in their posteriors
        """

    @abstractmethod
    def inferred(self, envs: np.ndarray) -> np.ndarray:
        """
        :param envs: (k,) int
        :return: (k, latent_dim), z drawn from the posterior over their episodes so far
        """


@dataclass
class Prior(FixedExploration):
    """
    z ~ N(0, I) for a fixed number of episodes, then from the posterior over all episodes.

    :param n_exploration_episodes: 0 or more episodes before the posterior is used (PEARL's reference, num_exp_traj_eval: 5 for
        the sparse point robot, 1 or 2 for others)
    :raises ValueError: if it is negative
    """

    def start(self) -> None:
        self.z = np.zeros((self.adaptation.n_envs, self.adaptation.policy.latent_dim), dtype=np.float32)
        self.draw(np.arange(len(self.z)))

    def deviation(self) -> np.ndarray:
        return np.where(self.exploring()[:, None], 1.0, super().deviation())

    def draw(self, envs: np.ndarray) -> None:
        explored, inferred = self.adaptation.noise(len(envs)), self.inferred(envs)
        self.z[envs] = np.where(self.exploring()[envs, None], explored, inferred)

    def inferred(self, envs: np.ndarray) -> np.ndarray:
        return self.adaptation.sample_posterior(envs)
