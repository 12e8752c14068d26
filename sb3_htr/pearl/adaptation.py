"""Posterior sampling over the episodes of an adaptation, for several tasks side by side."""

import numpy as np
import torch as th

from sb3_htr.pearl.context import evenly_spread
from sb3_htr.pearl.exploration import Explorer
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.pearl.task_search import TaskSearch

# Episodes that may be worse than the best one, before the z of that one is acted with again: by turns with the z of the
# training task that promises most and from the posterior. The posterior of an episode that only grazed its goal can be narrow
# and beside it, so each setback widens it by its deviation. By measurement on the Point Robot (two models, 200 tasks drawn
# anew), last return with 4 and with 6 12.9 and 12.8; without the training tasks 12.2 and 12.3.
MAX_SETBACKS = 4
# An episode counts as no setback if it is better than the best one by so much. The same z does not return the same from every
# start, and of many episodes one is a little better. By measurement: on the Wheeled robot (two models, 40 tasks drawn anew)
# all tasks are solved in the last episode with 1.02, 90 and 97 % with 1, because the agent never settled
CLEARLY_BETTER = 1.02
# A return without its task-free part is that much above 0, or it is 0: the difference of two sums of float32
ROUNDING = 1e-5
# What an episode counts for that found the reward, but with more than one z, so that it cannot be repeated with one
FOUND = 2 * ROUNDING


class Adaptation:
    """
    Adapts to one task per env, from nothing but the episodes of this adaptation.

    The z to act with is in :attr:`z`; feed every step to :meth:`observe`, and ``z`` changes where an episode ends, and where a
    search turns elsewhere.

    :param policy: networks
    :param n_envs: number of tasks
    :param explorer: how z is drawn before the posterior is used
    :param n_exploration_episodes: episodes before the posterior is used, for the explorer PRIOR
    :param context_size: steps of an episode that the posterior is inferred from, evenly spread, at most: as many as in
        meta-training, because each narrows it
    :param generator: source of randomness; torch's global one by default
    """

    def __init__(
        self,
        policy: PEARLPolicy,
        n_envs: int,
        explorer: Explorer,
        n_exploration_episodes: int,
        context_size: int,
        generator: th.Generator | None = None,
    ) -> None:
        self.policy = policy
        self.explorer = explorer
        self.n_exploration_episodes = n_exploration_episodes
        self.context_size = context_size
        self.generator = generator
        self.n_episodes = np.zeros(n_envs, dtype=np.int64)
        # Return of the best episode, without the task-free part
        self.best_return = np.zeros(n_envs, dtype=np.float64)
        self.z = np.zeros((n_envs, policy.latent_dim), dtype=np.float32)
        # Of the running episodes
        self._rows = np.zeros((n_envs, 64, policy.context_dim), dtype=np.float32)
        self._n_rows = np.zeros(n_envs, dtype=np.int64)
        self._episode_return = np.zeros(n_envs, dtype=np.float64)
        # Whether z has changed within the episode
        self._turned = np.zeros(n_envs, dtype=bool)
        # The posterior, as precision and precision times mean, which products of Gaussians add up. Meta-training sees contexts
        # of one rewarded episode; the misses of a search would look like nothing it knows. So it is over the best episode,
        # or, for the explorer PRIOR, over all of them
        self._precision = np.zeros_like(self.z)
        self._precision_mean = np.zeros_like(self.z)
        self._best_z = np.zeros_like(self.z)
        # Episodes since one was clearly better
        self._setbacks = np.zeros(n_envs, dtype=np.int64)
        has_search = explorer is Explorer.SEARCH and policy.latent_prior.n_known_tasks > 0
        self._search = TaskSearch(policy.latent_prior.known_tasks(), n_envs) if has_search else None
        self._draw(np.arange(n_envs))

    def observe(
        self, obs: np.ndarray, actions: np.ndarray, rewards: np.ndarray, task_free_rewards: np.ndarray, dones: np.ndarray
    ) -> None:
        """
        :param obs: (n_envs, obs_dim), what the actions were chosen for
        :param actions: (n_envs, action_dim), scaled to [-1, 1]
        :param rewards: (n_envs,)
        :param task_free_rewards: (n_envs,), the part of the rewards that depends on no task
        :param dones: (n_envs,), where an episode ended
        """
        n_envs = len(dones)
        if self._n_rows.max() == self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)], axis=1)
        row = np.concatenate([obs.reshape(n_envs, -1), actions, rewards[:, None]], axis=1)
        self._rows[np.arange(n_envs), self._n_rows] = row
        self._n_rows += 1
        self._episode_return += rewards - task_free_rewards
        if self._search is not None:
            returns = np.where(self._episode_return > ROUNDING, self._episode_return, 0.0)
            turning, z = self._search.observe(returns, np.asarray(dones, dtype=bool))
            self.z[turning] = z
            self._turned[turning] = True
        ended = np.flatnonzero(dones)
        if len(ended) == 0:
            return
        returns = np.where(self._turned, np.minimum(self._episode_return, FOUND), self._episode_return)
        better = ended[returns[ended] > self.best_return[ended] + 0.5 * ROUNDING]
        clearly_better = better[returns[better] > CLEARLY_BETTER * self.best_return[better]]
        self.best_return[better] = returns[better]
        self._best_z[better] = self.z[better]
        self._setbacks[ended] += 1
        self._setbacks[clearly_better] = 0
        self._episode_return[ended] = 0
        self._turned[ended] = False
        self._infer(ended if self.explorer is Explorer.PRIOR else better)
        self._n_rows[ended] = 0
        self.n_episodes[ended] += 1
        self._draw(ended)

    def exploring(self) -> np.ndarray:
        """
        :return: (n_envs,) bool, whether z is still drawn by the explorer
        """
        if self.explorer is Explorer.PRIOR:
            return self.n_episodes < self.n_exploration_episodes
        return self.best_return <= 0

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: mean and standard deviation (n_envs, latent_dim) of the posterior over the best episode (explorer PRIOR: over
            all episodes), those of N(0, I) where there is none yet
        """
        return self._posterior(np.arange(len(self.z)))

    def deviation(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), standard deviation of what is known about z: of what the explorer draws from while
            exploring, of the posterior afterwards
        """
        prior = self.policy.latent_prior
        if self._search is not None:
            belief, known = self._search.belief, self._search.known.z
            exploring = np.sqrt(np.maximum(belief @ known**2 - (belief @ known) ** 2, 0.0))
        elif self.explorer is Explorer.PRIOR:
            exploring = np.ones_like(self.z)
        else:
            exploring = np.tile(prior.aggregate_scale * prior.cholesky.norm(dim=1).cpu().numpy(), (len(self.z), 1))
        return np.where(self.exploring()[:, None], exploring, self.posterior()[1])

    def frozen_z(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), the z to act with when no more episodes follow: that of the best episode, or, where none
            was rewarded or for the explorer PRIOR, the one that would be acted with next
        """
        use_best = (self.explorer is not Explorer.PRIOR) & (self.best_return > 0)
        return np.where(use_best[:, None], self._best_z, self.z)

    def _draw(self, envs: np.ndarray) -> None:
        """New z for some envs."""
        exploring = self.exploring()[envs]
        explored = self.policy.latent_prior.sample(self.explorer, len(envs), self.generator).cpu().numpy()
        self.z[envs] = np.where(exploring[:, None], explored, self._sample_posterior(envs))
        if self.explorer is Explorer.PRIOR:
            return
        settled = (self._setbacks[envs] >= MAX_SETBACKS) & (self.best_return[envs] > FOUND)
        self.z[envs[settled]] = self._best_z[envs[settled]]
        if self._search is not None:
            visit = exploring | ((self._setbacks[envs] % 2 == 0) & ~settled)
            self.z[envs[visit]] = self._search.begin(envs[visit], exploring[visit])

    def _infer(self, envs: np.ndarray) -> None:
        """Take the episodes that end into the posterior."""
        if len(envs) == 0:
            return
        steps, lengths = evenly_spread(self._n_rows[envs], self.context_size)
        rows = self._rows[np.repeat(envs, lengths), steps]
        device = self.policy.device
        with th.no_grad():
            mean, variance = self.policy.encoder(th.as_tensor(rows, device=device), th.as_tensor(lengths, device=device))
        if self.explorer is not Explorer.PRIOR:
            self._precision[envs] = self._precision_mean[envs] = 0
        self._precision[envs] += (1 / variance).cpu().numpy()
        self._precision_mean[envs] += (mean / variance).cpu().numpy()

    def _sample_posterior(self, envs: np.ndarray) -> np.ndarray:
        mean, deviation = self._posterior(envs)
        if self.explorer is not Explorer.PRIOR:
            deviation *= 1 + self._setbacks[envs, None]
        noise = th.randn(deviation.shape, generator=self.generator).numpy()
        return np.asarray(mean + deviation * noise)

    def _posterior(self, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (k, latent_dim) for some envs, those of N(0, 1) where there is no evidence yet."""
        variance = 1 / np.where(self._precision[envs] > 0, self._precision[envs], 1)
        return variance * self._precision_mean[envs], np.sqrt(variance)
