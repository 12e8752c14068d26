"""Bayes' rule over particles."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch as th

from sb3_htr.adaptation.explorers.base import Explorer
from sb3_htr.adaptation.knowledge import Particles
from sb3_htr.common.settings import check_numbers

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Step

# Draws from the prior in place of particles, before meta-training has solved a task
N_DRAWS = 32


@dataclass
class ParticleExplorer(Explorer):
    """
    A belief over tasks that meta-training has solved, training tasks and hindsight tasks: every step multiplies the weight of
    each by what the reward model says of the step's reward under that task.

    Nothing else is used than observations, actions and rewards.

    :param doubt: from 1e-6 to .5, smallest likelihood that the model is believed: of a success where it excludes one, of none
        where it is sure of one, and of a reward beside the one expected. By measurement, docs/trials.md
    :param temperature: in [0, 1], power of each step's likelihood: steps of an episode are not independent
    :raises ValueError: for a setting out of its range
    """

    needs_success: ClassVar[bool] = True

    doubt: float = 0.005
    temperature: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(doubt=(self.doubt, 1e-6, 0.5), temperature=(self.temperature, 0.0, 1.0))

    def start(self) -> None:
        adaptation = self.adaptation
        self.particles = self.known_tasks()
        if len(self.particles.z) == 0:
            z = th.as_tensor(adaptation.noise(N_DRAWS), device=adaptation.policy.device)
            eye, flat = th.eye(N_DRAWS, device=z.device), th.zeros(N_DRAWS, device=z.device)
            self.particles = Particles(z, eye, eye, flat, flat.bool())
        with th.no_grad():
            self._tasks = adaptation.policy.reward_model.task_tower(self.particles.z)
        self.log_weights = self.particles.log_prior.repeat(adaptation.n_envs, 1)
        self.z = np.zeros((adaptation.n_envs, adaptation.policy.latent_dim), dtype=np.float32)

    def known_tasks(self) -> Particles:
        """
        :return: the tasks that the belief is about; none before meta-training has solved one
        """
        return self.adaptation.knowledge.particles()

    def weights(self, envs: np.ndarray) -> th.Tensor:
        """
        :param envs: (k,) int
        :return: (k, n), probability of each particle
        """
        return self.log_weights[envs].softmax(dim=1)

    def deviation(self) -> np.ndarray:
        z, weights = self.particles.z, self.log_weights.softmax(dim=1)
        variance = weights @ z.square() - (weights @ z).square()
        return np.asarray(variance.clamp(min=0).sqrt().cpu().numpy())

    def update_belief(self, step: "Step") -> None:
        """
        One step of Bayes' rule.

        :param step: what each env did
        """
        policy = self.adaptation.policy
        model, device = policy.reward_model, policy.device
        with th.no_grad():
            next_obs, reward = (
                th.as_tensor(x, dtype=th.float32, device=device) for x in (step.next_observations, self.adaptation.task_reward)
            )
            rewarded = reward > 0
            states = model.state_tower(policy.normalize(next_obs))
            chance = model.success_logits(states, self._tasks).sigmoid().clamp(self.doubt, 1 - self.doubt)
            log_likelihood = th.where(rewarded[:, None], chance, 1 - chance).log()
            if rewarded.any():
                error = (reward[:, None] - model.success_rewards(states, self._tasks)) / model.deviation.clamp(min=1e-6)
                # Relative to that of the reward expected
                log_density = (-0.5 * error.square()).clamp(min=math.log(self.doubt))
                log_likelihood = log_likelihood + th.where(rewarded[:, None], log_density, 0.0)
        self.log_weights += self.temperature * log_likelihood
