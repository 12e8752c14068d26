"""RL2's policy: sb3-contrib's, which goes through a trial in one call of the LSTM."""

import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from torch import nn


class TrialLstmPolicy(RecurrentActorCriticPolicy):
    """
    Actor and critic with an LSTM each.

    The library's policy calls its LSTM step by step if memory has to be forgotten anywhere, and a trial begins with that. But
    the library's rollout buffer cuts sequences where trials begin: it is at the first step of a sequence, if anywhere. To
    forget before the call lets the LSTM have the whole sequence at once, for the same outputs.
    """

    @staticmethod
    def _process_sequence(
        features: th.Tensor, lstm_states: tuple[th.Tensor, th.Tensor], episode_starts: th.Tensor, lstm: nn.LSTM
    ) -> tuple[th.Tensor, th.Tensor]:
        starts = episode_starts.reshape(lstm_states[0].shape[1], -1).clone()
        kept = (1.0 - starts[:, 0]).view(1, -1, 1)
        starts[:, 0] = 0.0
        memory = (kept * lstm_states[0], kept * lstm_states[1])
        return RecurrentActorCriticPolicy._process_sequence(features, memory, starts.flatten(), lstm)
