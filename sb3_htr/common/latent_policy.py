"""What a policy is that acts on an observation and a task variable z."""

from abc import abstractmethod
from contextvars import ContextVar
from typing import TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_htr.common.normalizer import ObservationNormalizer

# Of SB3's predict()
Obs: TypeAlias = np.ndarray | dict[str, np.ndarray]
State: TypeAlias = tuple[np.ndarray, ...] | None

# From predict() to what SB3 calls within it. Of each thread: agents of one model share its policy, each with a z of its own
_z: ContextVar[th.Tensor | None] = ContextVar("z", default=None)


class LatentPolicy(BasePolicy):
    """A policy of Stable-Baselines3 for which the state of ``predict`` is z."""

    latent_dim: int
    normalizer: ObservationNormalizer | None

    def predict(
        self, observation: Obs, state: State = None, episode_start: np.ndarray | None = None, deterministic: bool = False
    ) -> tuple[np.ndarray, State]:
        """
        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: tuple of one array, z of each observation (n, latent_dim), or of all (1, latent_dim); None is the prior
            mean
        :param episode_start: ignored: z lives longer than an episode
        :param deterministic: mean action instead of a sample
        :return: actions, and the state for the next call
        :raises ValueError: for a state that is none, and observations that are no finite numbers
        """
        with_info = isinstance(observation, tuple) and any(isinstance(part, dict) for part in observation)
        if observation is None or with_info:
            return super().predict(observation, None, episode_start, deterministic)  # SB3 says what is wrong with it
        n = len(observation) if np.ndim(observation) > 1 else 1  # type: ignore[arg-type]
        if state is not None and not (
            isinstance(state, tuple) and len(state) == 1 and np.shape(state[0]) in ((1, self.latent_dim), (n, self.latent_dim))
        ):
            what = (
                tuple(map(np.shape, state))
                if isinstance(state, tuple)
                else f"{type(state).__name__} of shape {np.shape(state)}"
            )
            raise ValueError(f"state is {what}, expected a tuple of one array, z, of shape ({n}, {self.latent_dim}).")
        if state is not None and not np.isfinite(state[0]).all():
            raise ValueError(f"z, the state, is {state[0]}, expected finite numbers: no action follows from it.")
        if not isinstance(observation, dict) and not np.isfinite(observation).all():
            raise ValueError(f"The observation is {observation}, expected finite numbers: no action follows from it.")
        z = np.zeros((1, self.latent_dim), dtype=np.float32) if state is None else state[0]
        outer = _z.set(th.as_tensor(z, dtype=th.float32, device=self.device))
        try:
            actions, _ = super().predict(observation, None, episode_start, deterministic)
        finally:
            _z.reset(outer)
        return actions, (z,)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        obs = self.normalize(observation.flatten(1).float())
        z = obs.new_zeros(1, self.latent_dim) if (z := _z.get()) is None else z
        return self._act(th.cat([obs, z.expand(len(obs), -1)], dim=1), deterministic)

    def normalize(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (n, obs_dim), as the env gave them
        :return: the same shape, as all networks see them
        """
        return obs if self.normalizer is None else self.normalizer(obs)

    @abstractmethod
    def _act(self, obs_z: th.Tensor, deterministic: bool) -> th.Tensor:
        """Actions (n, action_dim), scaled to [-1, 1], for normalized observations and z (n, obs_dim + latent_dim)."""
