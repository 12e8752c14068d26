"""A belief over tasks, by which an unknown one is searched for and exploited."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch as th

from sb3_htr.adaptation.explorers.particles import ParticleExplorer
from sb3_htr.common.settings import check_numbers
from sb3_htr.common.task_reward import ROUNDING

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Step

# z that are compared by their values, those that promise most: fewer change nothing that was measured
N_COMPARED = 32
# z is chosen anew about so often in an episode, once it is known how long one is
N_CHOICES = 40


@dataclass
class Belief(ParticleExplorer):
    """
    The explorer that is the default at meta-test.

    First it searches: several times in an episode, it chooses the z of the particle with the largest product of two numbers:
    what the belief expects a rewarded step of its episode to earn, and the critics' value of acting with it from here on, less
    the value of unrewarded steps. (Where no value is above that, as with critics that learn from a dense proxy, less the
    lowest of them.) What several z found cannot be repeated: every other episode searches, until one with a single z has
    returned half as much. The others have a single z, the one that promises the largest return: of a particle, under the same
    belief; of the best episode so far, what it returned. The encoder's posterior mean, given a new best episode, is tried
    once. Where an episode begins elsewhere each time, a z that was good may be a bad one: an episode that is not rewarded and
    whose value, as it goes on, is not what it was at the start, searches on to its end. Two searches in a row that end without
    a reward on the way to the same task tell against it and those like it.

    :param margin: 1 or more. So many times what the best episode with one z returned must a particle promise, to be tried in
        its place, and what the best of all episodes returned a new one, for the encoder to be asked about it
    :param kept: in [0, 1], when an episode with one z keeps its word: of what was found, the share that it must return to end
        the search; of what the critics promised at its start, the share that they must still promise as long as it is
        unrewarded. By measurement, docs/trials.md
    :raises ValueError: for a setting out of its range
    """

    margin: float = 1.02
    kept: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(margin=(self.margin, 1.0), kept=(self.kept, 0.0, 1.0))

    def start(self) -> None:
        super().start()
        n_envs = len(self.z)
        # Whether more than one z was acted with in the running episode
        self._turned = np.zeros(n_envs, dtype=bool)
        self._at_start = np.ones(n_envs, dtype=bool)
        self._searching = np.ones(n_envs, dtype=bool)
        self._n_steps = np.zeros(n_envs, dtype=np.int64)
        # Steps from one choice within an episode to the next
        self._every = np.ones(n_envs, dtype=np.int64)
        # Value of acting with the only z of the running episode, at its start; whether it was not kept
        self._promised = np.zeros(n_envs)
        self._gave_up = np.zeros(n_envs, dtype=bool)
        # Of all episodes, and of those with one z
        self._best_return = np.zeros(n_envs)
        self._best_z = np.zeros_like(self.z)
        self._best_z_return = np.zeros(n_envs)
        # Particles that had an episode, and the one that is acted with, -1 for none
        self._tried = np.zeros((n_envs, len(self.particles.z)), dtype=bool)
        self._particle = np.full(n_envs, -1)
        # The one that a search headed for last, in this episode and in the one before, -1 for none
        self._aim, self._aim_before = np.full(n_envs, -1), np.full(n_envs, -1)
        # The encoder's word on a new best episode
        self._proposal = np.zeros_like(self.z)
        self._has_proposal = np.zeros(n_envs, dtype=bool)

    def exploring(self) -> np.ndarray:
        return np.asarray(self._best_return <= 0)

    def final_z(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), z of the best episode of those with one z, if it ended the search; else the one that
            promises the largest return; where nothing was found, the one that was acted with last
        """
        returns = self.weights(np.arange(len(self.z))) @ self.particles.returns.T
        promising = self.particles.z[returns.argmax(dim=1)].cpu().numpy()
        found = np.where(self._keeps_its_word()[:, None], self._best_z, promising)
        return np.where(self.exploring()[:, None], self.z, found)

    def _keeps_its_word(self) -> np.ndarray:
        """(n_envs,) bool, whether an episode with one z has returned enough of what was found."""
        return (self._best_z_return > 0) & (self._best_z_return >= self.kept * self._best_return)

    def look(self, obs: np.ndarray) -> None:
        unsure = ~self._keeps_its_word() & ~self._has_proposal
        search = unsure & (self.exploring() | ~self._searching)
        self._searching = np.where(self._at_start, search, self._searching)
        due = self._at_start | (self._n_steps % self._every == 0)
        self._exploit(np.flatnonzero(~self._searching & self._at_start), obs)
        has_one_z = ~self._searching & ~self._gave_up & ~self._at_start
        self.give_up(np.flatnonzero(has_one_z & due & (self.adaptation.episode_return <= 0)), obs)
        self._search(np.flatnonzero((self._searching | self._gave_up) & due), obs)
        self._at_start[:] = False

    def _search(self, envs: np.ndarray, obs: np.ndarray) -> None:
        if len(envs) == 0:
            return
        with th.no_grad():
            self._aim[envs] = self.most_promising(envs, obs).cpu().numpy()
            chosen = self.particles.z[self._aim[envs]].cpu().numpy()
        self._turned[envs] |= ~self._at_start[envs] & (chosen != self.z[envs]).any(axis=1)
        self.z[envs] = chosen

    def most_promising(self, envs: np.ndarray, obs: np.ndarray) -> th.Tensor:
        """
        :param envs: (k,) int, where the task is searched for
        :param obs: (n_envs, obs_dim), what is acted on
        :return: (k,) int, particles that earn most, and soonest
        """
        n_compared = min(N_COMPARED, len(self.particles.z))
        gain, index = (self.weights(envs) @ self.particles.gain.T).topk(n_compared, dim=1)
        z = self.particles.z[index]
        values, level = self.adaptation.policy.values(obs[envs], z), self.adaptation.knowledge.task_free_value
        # Critics that learn from a dense proxy have another level, of which nothing tells: then it is the worst of them
        level = th.where(values.amax(dim=1, keepdim=True) > level, level, values.amin(dim=1, keepdim=True))
        promise = gain * (values - level).clamp(min=0)
        return index[th.arange(len(envs)), promise.argmax(dim=1)]

    def _exploit(self, envs: np.ndarray, obs: np.ndarray) -> None:
        """What returns most."""
        if len(envs) == 0:
            return
        returns = (self.weights(envs) @ self.particles.returns.T).cpu().numpy()
        returns[self._tried[envs]] = 0
        particle = returns.argmax(axis=1)
        self.z[envs], self._particle[envs] = self.particles.z[particle].cpu().numpy(), particle
        best = envs[returns.max(axis=1) < self.margin * self._best_z_return[envs]]
        self.z[best], self._particle[best] = self._best_z[best], -1
        proposed = envs[self._has_proposal[envs]]
        self.z[proposed], self._particle[proposed] = self._proposal[proposed], -1
        self._has_proposal[proposed] = False
        self._promised[envs] = self._values(envs, obs)

    def give_up(self, envs: np.ndarray, obs: np.ndarray) -> None:
        """
        Until a reward comes, the value of going there grows by 1 / gamma a step. Where it does not, search.

        :param envs: (k,) int, whose episodes have a single z, and no reward yet
        :param obs: (n_envs, obs_dim), what is acted on
        """
        if len(envs) == 0:
            return
        kept = self.adaptation.gamma ** self._n_steps[envs] * self._values(envs, obs)
        promised = self._promised[envs]
        self._gave_up[envs] = (promised > 0) & (kept < self.kept * promised)

    def _values(self, envs: np.ndarray, obs: np.ndarray) -> np.ndarray:
        """(k,), of going on with z."""
        policy, knowledge = self.adaptation.policy, self.adaptation.knowledge
        with th.no_grad():
            z = th.as_tensor(self.z[envs], device=policy.device)[:, None]
            values = policy.values(obs[envs], z)[:, 0] - knowledge.task_free_value
        return np.asarray(values.cpu().numpy())

    def observe(self, step: "Step") -> None:
        self.update_belief(step)
        self._n_steps += 1
        ended = np.flatnonzero(step.dones)
        if len(ended):
            self._every[ended] = np.maximum(self._every[ended], self._n_steps[ended] // N_CHOICES)
            self._end(ended)

    def _end(self, envs: np.ndarray) -> None:
        """Learn from the episodes that end."""
        episode_return = self.adaptation.episode_return
        returns, particle = episode_return[envs], self._particle[envs]
        self._tried[envs[particle >= 0], particle[particle >= 0]] = True
        better = envs[returns > self.margin * self._best_return[envs] + ROUNDING]
        self._best_return[envs] = np.maximum(self._best_return[envs], returns)
        repeatable = envs[~self._turned[envs] & (returns > self._best_z_return[envs] + ROUNDING)]
        self._best_z[repeatable], self._best_z_return[repeatable] = self.z[repeatable], episode_return[repeatable]
        self.propose(better)
        self.rule_out(envs)
        self._turned[envs], self._gave_up[envs], self._at_start[envs] = False, False, True
        self._n_steps[envs], self._particle[envs] = 0, -1

    def rule_out(self, envs: np.ndarray) -> None:
        """
        What ended two searches on the way to one task, such as an obstacle or a safety stop, would end all that follow. So
        count it as evidence: they would have met the task, and those like it.

        :param envs: (k,) int, whose episodes end
        """
        aim = np.where(self.adaptation.episode_return[envs] > 0, -1, self._aim[envs])
        again = (aim >= 0) & (aim == self._aim_before[envs])
        gain = self.particles.gain[aim[again]]
        met = (gain / gain.amax(dim=1, keepdim=True).clamp(min=1e-6)).clamp(self.doubt, 1 - self.doubt)
        self.log_weights[envs[again]] += (1 - met).log()
        self._aim_before[envs], self._aim[envs] = aim, -1

    def propose(self, envs: np.ndarray) -> None:
        """
        Let the encoder have its word, which is tried once.

        :param envs: (k,) int, whose episodes that end are the best so far
        """
        self.adaptation.infer(envs, keep=False)
        self._proposal[envs] = self.adaptation.posterior(envs)[0]
        self._has_proposal[envs] = True
