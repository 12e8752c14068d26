"""Exploration by visits to known tasks."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sb3_htr.adaptation.explorers.aggregate import ROUNDING, Aggregate
from sb3_htr.adaptation.explorers.task_search import TaskSearch

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Step


@dataclass
class Search(Aggregate):
    """
    z of the training task that the unknown one is most likely to be found with, given the misses so far, until an episode is
    rewarded; then by turns z of the training task that promises most, and the posterior over the best episode.

    As long as no training task is known, it is :class:`Aggregate`, whose settings it has.
    """

    def start(self) -> None:
        known = self.adaptation.knowledge.known_tasks()
        self._search = TaskSearch(known, self.adaptation.n_envs) if len(known.z) else None
        super().start()

    def observe(self, step: "Step") -> None:
        if self._search is not None:
            returns = self.adaptation.episode_return
            returns = np.where(returns > ROUNDING, returns, 0.0)
            turning, z = self._search.observe(returns, np.asarray(step.dones, dtype=bool))
            self.z[turning] = z
            self._turned[turning] = True
        super().observe(step)

    def _exploring_deviation(self) -> np.ndarray:
        if self._search is None:
            return super()._exploring_deviation()
        belief, known = self._search.belief, self._search.known.z
        return np.asarray(np.sqrt(np.maximum(belief @ known**2 - (belief @ known) ** 2, 0.0)))

    def _draw(self, envs: np.ndarray) -> None:
        super()._draw(envs)
        if self._search is not None:
            exploring = self.exploring()[envs]
            visit = exploring | ((self._setbacks[envs] % 2 == 0) & ~self._settled(envs))
            self.z[envs[visit]] = self._search.begin(envs[visit], exploring[visit])
