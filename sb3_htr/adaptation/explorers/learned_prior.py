"""PEARL's protocol with a prior that was learned."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch as th

from sb3_htr.adaptation.explorers.particles import ParticleExplorer
from sb3_htr.adaptation.explorers.prior import FixedExploration
from sb3_htr.common.settings import check_numbers

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Step


@dataclass
class LearnedPrior(FixedExploration, ParticleExplorer):
    """
    Posterior sampling, as PEARL has it, with an empirical prior in place of N(0, I): the posterior means of solved training
    tasks, all alike, and with a small share those of hindsight tasks. z is drawn from it for a fixed number of episodes, and
    then from the posterior over all episodes, their misses included. One z an episode.

    :param n_exploration_episodes: 0 or more episodes before the posterior is used (PEARL's reference, num_exp_traj_eval: 5 for
        the sparse point robot, 1 or 2 for others)
    :param hindsight_share: in [0, 1], of the prior. By measurement, docs/trials.md: without, no task is found that lies
        elsewhere than those of training
    :raises ValueError: for a setting out of its range
    """

    hindsight_share: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(hindsight_share=(self.hindsight_share, 0.0, 1.0))
        if type(self) is LearnedPrior:  # a class of one's own has its own name
            self.name = "learned-prior"

    def start(self) -> None:
        super().start()
        prior, is_train = self.particles.log_prior.softmax(dim=0), self.particles.is_train
        if is_train.any() and not is_train.all():
            of_hindsight = self.hindsight_share * prior / prior[~is_train].sum()
            prior = th.where(is_train, (1 - self.hindsight_share) / is_train.sum(), of_hindsight)
        self._prior = prior.log()
        self.log_weights[:] = self._prior
        self.draw(np.arange(len(self.z)))

    def observe(self, step: "Step") -> None:
        self.update_belief(step)
        super().observe(step)

    def draw(self, envs: np.ndarray) -> None:
        exploring = th.as_tensor(self.exploring()[envs], device=self._prior.device)[:, None]
        self.z[envs] = self._drawn(th.where(exploring, self._prior.softmax(dim=0), self.weights(envs)))

    def inferred(self, envs: np.ndarray) -> np.ndarray:
        return self._drawn(self.weights(envs))

    def _drawn(self, weights: th.Tensor) -> np.ndarray:
        particle = th.multinomial(weights.cpu(), 1, generator=self.adaptation.generator)[:, 0]
        return self.particles.z.cpu()[particle].numpy()
