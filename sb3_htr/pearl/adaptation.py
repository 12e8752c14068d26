"""Posterior sampling over the episodes of an adaptation, for several tasks at once."""

import numpy as np
import torch as th

from sb3_htr.pearl.exploration import Explorer
from sb3_htr.pearl.policies import PEARLPolicy


class Adaptation:
    """
    Adapts to one task per env from the episodes of this adaptation alone, one after the other.

    :param policy: networks
    :param n_envs: number of tasks adapted to side by side
    :param n_exploration_episodes: episodes before the posterior is used
    :param explorer: how z is drawn while exploring
    :param deterministic: use the posterior's mean instead of a sample
    :param generator: source of randomness
    """

    def __init__(
        self,
        policy: PEARLPolicy,
        n_envs: int,
        n_exploration_episodes: int,
        explorer: Explorer,
        max_episode_steps: int,
        generator: th.Generator | None = None,
        context: str = "best",
    ) -> None:
        self.policy = policy
        self.explorer = explorer
        self.n_exploration_episodes = n_exploration_episodes
        self.generator = generator
        self.context = context
        self.n_episodes = np.zeros(n_envs, dtype=np.int64)
        self._rows = np.zeros((n_envs, 4 * max_episode_steps, policy.context_dim), dtype=np.float32)
        self._start = np.zeros(n_envs, dtype=np.int64)
        self._length = np.zeros(n_envs, dtype=np.int64)
        self._best = np.zeros((n_envs, 2), dtype=np.int64)
        self._best_return = np.full(n_envs, -np.inf)
        self.z = np.zeros((n_envs, policy.latent_dim), dtype=np.float32)
        self._draw(np.arange(n_envs))

    @property
    def rewarded(self) -> np.ndarray:
        return self._best_return > 0

    def observe(self, obs: np.ndarray, action: np.ndarray, reward: np.ndarray, done: np.ndarray, goal_reward) -> None:
        if self._length.max() == self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)], axis=1)
        env = np.arange(len(done))
        self._rows[env, self._length] = np.concatenate([obs.reshape(len(done), -1), action, reward[:, None]], axis=1)
        self._length += 1
        if not hasattr(self, "_ret"):
            self._ret = np.zeros(len(done))
        self._ret += goal_reward
        if done.any():
            finished = np.flatnonzero(done)
            better = finished[self._ret[finished] > self._best_return[finished]]
            self._best[better] = np.stack([self._start[better], self._length[better]], axis=1)
            self._best_return[better] = self._ret[better]
            self._ret[finished] = 0
            self._start[finished] = self._length[finished]
            self.n_episodes[finished] += 1
            self._draw(finished)

    def _draw(self, envs: np.ndarray) -> None:
        attempt = th.as_tensor(self.n_episodes[envs])
        with th.no_grad():
            z = self.policy.latent_prior.sample(self.explorer, attempt, self.generator)
            if self.explorer is Explorer.PLAN:
                posterior = self.rewarded[envs]
            elif self.explorer is Explorer.AGGREGATE:
                posterior = (self.n_episodes[envs] >= self.n_exploration_episodes) & self.rewarded[envs]
            else:
                posterior = self.n_episodes[envs] >= self.n_exploration_episodes
            if posterior.any():
                z[th.as_tensor(posterior)] = self._posterior(envs[posterior])
        self.z[envs] = z.cpu().numpy()

    def _posterior(self, envs) -> th.Tensor:
        step = np.arange(self._length[envs].max())
        if self.context == "best":
            mask = (step >= self._best[envs, :1]) & (step < self._best[envs, 1:])
        else:
            mask = step < self._length[envs, None]
        context = th.as_tensor(self._rows[envs, : len(step)])
        mean, variance = self.policy.encoder(context, th.as_tensor(mask.astype(np.float32)))
        if self.context == "best":
            return mean
        return mean + variance.sqrt() * th.randn(mean.shape, generator=self.generator)
