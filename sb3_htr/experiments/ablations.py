"""The default explorer with one of its parts taken out. They are experiments, and not for use."""

from dataclasses import dataclass

import numpy as np
import torch as th

from sb3_htr.adaptation import Step
from sb3_htr.adaptation.explorers import Belief, Explorer
from sb3_htr.adaptation.knowledge import Particles


@dataclass
class TrainingTasksAlone(Belief):
    """No particles of hindsight tasks."""

    def known_tasks(self) -> Particles:
        tasks = super().known_tasks()
        z, gain, returns, log_prior, kept = tasks
        if not kept.any():
            return tasks
        return Particles(z[kept], gain[kept][:, kept], returns[kept][:, kept], log_prior[kept], kept[kept])


@dataclass
class UniformPrior(Belief):
    """All particles are as likely beforehand."""

    def start(self) -> None:
        super().start()
        self.log_weights[:] = 0


@dataclass
class NoPosterior(Belief):
    """The encoder's posterior mean is never acted with."""

    def propose(self, envs: np.ndarray) -> None:
        pass


@dataclass
class NoValue(Belief):
    """Before the first reward, what an episode is expected to earn alone: not how soon, nor whether the policy gets there."""

    def most_promising(self, envs: np.ndarray, obs: np.ndarray) -> th.Tensor:
        return (self.weights(envs) @ self.particles.gain.T).argmax(dim=1)


@dataclass
class NoGivingUp(Belief):
    """After the first reward, an episode acts with one z to its end, whatever the critics say of it."""

    def give_up(self, envs: np.ndarray, obs: np.ndarray) -> None:
        pass


@dataclass
class NoInference(Belief):
    """What the reward model says of rewards is ignored: the belief stays as it was beforehand."""

    def update_belief(self, step: Step) -> None:
        pass

    def rule_out(self, envs: np.ndarray) -> None:
        pass


ABLATIONS: dict[str, Explorer] = {
    "belief, training tasks alone": TrainingTasksAlone(),
    "belief, uniform prior": UniformPrior(),
    "belief, no posterior": NoPosterior(),
    "belief, no value": NoValue(),
    "belief, no giving up": NoGivingUp(),
    "belief, no inference": NoInference(),
}
