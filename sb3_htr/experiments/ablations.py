"""The default explorer with one of its parts taken out, or with none left. They are experiments, and not for use."""

from dataclasses import dataclass
from typing import ClassVar

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


@dataclass
class InTurn(Explorer):
    """
    No inference and no critics: the training tasks that were solved are tried one after another, an episode each. The first is
    in the middle, each next one is the furthest from all before, by z. The first z that is rewarded is kept; what a reward is,
    the model of task-free rewards says, as to all explorers.
    """

    needs_success: ClassVar[bool] = True

    def start(self) -> None:
        z, *_, is_train = self.adaptation.knowledge.particles()
        known = z[is_train].cpu().numpy() if is_train.any() else np.zeros((1, z.shape[1]), dtype=np.float32)
        distances = np.linalg.norm(known[:, None] - known, axis=-1)
        nearest = -np.linalg.norm(known - known.mean(axis=0), axis=1)
        order: list[int] = []
        while len(order) < len(known):
            order.append(int(nearest.argmax()))
            nearest = distances[order].min(axis=0)
        self._known = known[order]
        self._turn = np.zeros(self.adaptation.n_envs, dtype=np.int64)
        self._found = np.zeros(self.adaptation.n_envs, dtype=bool)
        self.z = self._known[self._turn]

    def observe(self, step: Step) -> None:
        self._found |= step.dones & (self.adaptation.episode_return > 0)
        self._turn += step.dones & ~self._found
        self.z = self._known[self._turn % len(self._known)]

    def exploring(self) -> np.ndarray:
        return ~self._found


ABLATIONS: dict[str, Explorer] = {
    "belief, training tasks alone": TrainingTasksAlone(),
    "belief, uniform prior": UniformPrior(),
    "belief, no posterior": NoPosterior(),
    "belief, no value": NoValue(),
    "belief, no giving up": NoGivingUp(),
    "belief, no inference": NoInference(),
    "training tasks in turn": InTurn(),
}
