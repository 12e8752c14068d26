"""Observations on one scale, in whatever units."""

import numpy as np
import torch as th
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import nn

# As in SB3's VecNormalize
EPSILON, CLIP = 1e-8, 10.0


class ObservationNormalizer(nn.Module):
    """
    Subtracts the running mean of what was observed in training, and divides by the standard deviation. What varies by less
    than 1e-4 is divided by about that, so that the jitter of a constant stays small; but so do micrometres that are given in
    metres.

    It is a part of the policy and saved with it. SB3's ``VecNormalize`` does the same outside of the policy, where a model
    that is loaded without it acts on other numbers than it was trained on, and where stored observations are changed.

    :param obs_dim: length of an observation
    """

    mean: th.Tensor
    variance: th.Tensor
    count: th.Tensor

    def __init__(self, obs_dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(obs_dim, dtype=th.float64))
        self.register_buffer("variance", th.ones(obs_dim, dtype=th.float64))
        # RunningMeanStd begins as if it had seen a little of a 0, which is far off where observations have an offset
        self.register_buffer("count", th.zeros((), dtype=th.float64))

    def update(self, obs: np.ndarray) -> None:
        """
        :param obs: (n, obs_dim), newly observed, finite
        """
        moments = RunningMeanStd(shape=self.mean.shape)
        moments.mean, moments.var = self.mean.cpu().numpy(), self.variance.cpu().numpy()
        moments.count = self.count.item()
        # A whole rollout at once: in float32 its sum would be rounded
        mean, variance = obs.mean(axis=0, dtype=np.float64), obs.var(axis=0, dtype=np.float64)
        moments.update_from_moments(mean, variance, len(obs))
        self.mean.copy_(th.from_numpy(moments.mean))
        self.variance.copy_(th.from_numpy(moments.var))
        self.count.fill_(moments.count)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (..., obs_dim) float32
        :return: the same shape, float32, within [-10, 10]
        """
        scaled = (obs.double() - self.mean) / (self.variance + EPSILON).sqrt()
        return scaled.clamp(-CLIP, CLIP).float()
