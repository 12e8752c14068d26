"""RL2's policy: sb3-contrib's, which goes through a trial in one call of the LSTM."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_htr.common.normalizer import ObservationNormalizer
from sb3_htr.common.settings import check_flags
from sb3_htr.rivals.trials import LastStep


class TrialFeatures(FlattenExtractor):
    """
    Observations of the env on one scale. The last action, the last reward and whether an episode begins are left as they are:
    a reward that is rare would be a large number.

    :param observation_space: of :class:`sb3_htr.rivals.trials.TrialVecEnv`
    :param obs_dim: length of the env's own observation
    """

    def __init__(self, observation_space: spaces.Box, obs_dim: int) -> None:
        super().__init__(observation_space)
        self.obs_dim = obs_dim
        self.normalizer = ObservationNormalizer(obs_dim)

    def update(self, obs: np.ndarray) -> None:
        """
        :param obs: (..., obs_dim and more), newly observed
        """
        self.normalizer.update(obs[..., : self.obs_dim].reshape(-1, self.obs_dim))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: (n, obs_dim and more) float32
        :return: the same shape
        """
        own, last = observations[..., : self.obs_dim], observations[..., self.obs_dim :]
        return th.cat((self.normalizer(own), last), dim=-1)


class TrialLstmPolicy(RecurrentActorCriticPolicy):
    """
    Actor and critic with an LSTM each.

    The library's policy calls its LSTM step by step if memory has to be forgotten anywhere, and a trial begins with that. But
    the library's rollout buffer cuts sequences where trials begin: it is at the first step of a sequence, if anywhere. To
    forget before the call lets the LSTM have the whole sequence at once, for the same outputs.

    :param observation_space: of :class:`sb3_htr.rivals.trials.TrialVecEnv`
    :param action_space: of the env
    :param lr_schedule: learning rate
    :param args: of the library's policy
    :param normalize_observations: both see the env's observations less their running mean in training, divided by the standard
        deviation, as PEARL's networks do by default; here not by default, as in the library
    :param kwargs: of the library's policy
    :raises ValueError: if normalize_observations is no bool, or there is another features extractor beside it; for layers of
        networks that it has not
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *args: Any,
        normalize_observations: bool = False,
        **kwargs: Any,
    ) -> None:
        check_flags(normalize_observations=normalize_observations)
        layers = kwargs.get("net_arch")
        # The library ignores them, and where "vf" is missing, the critic has no layers
        if isinstance(layers, dict) and not layers.keys() <= {"pi", "vf"}:
            raise ValueError(f"net_arch is {layers}, expected layers for 'pi' and 'vf', or a list for both.")
        self.normalize_observations = normalize_observations
        if normalize_observations:
            if (given := kwargs.get("features_extractor_class", TrialFeatures)) not in (TrialFeatures, FlattenExtractor):
                raise ValueError(
                    f"normalize_observations has features of its own, in the place of {given.__name__}: give one."
                )
            n_last = LastStep(1, action_space.shape[0]).columns.shape[1]
            kwargs["features_extractor_class"] = TrialFeatures
            kwargs["features_extractor_kwargs"] = {"obs_dim": observation_space.shape[0] - n_last}
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "normalize_observations": self.normalize_observations}

    @staticmethod
    def _process_sequence(
        features: th.Tensor, lstm_states: tuple[th.Tensor, th.Tensor], episode_starts: th.Tensor, lstm: nn.LSTM
    ) -> tuple[th.Tensor, th.Tensor]:
        starts = episode_starts.reshape(lstm_states[0].shape[1], -1).clone()
        kept = (1.0 - starts[:, 0]).view(1, -1, 1)
        starts[:, 0] = 0.0
        memory = (kept * lstm_states[0], kept * lstm_states[1])
        return RecurrentActorCriticPolicy._process_sequence(features, memory, starts.flatten(), lstm)
