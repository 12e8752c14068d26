"""The reward model's losses, whose gradients are written by hand."""

import pytest
import torch as th
from torch.nn import functional as F

from sb3_htr.common.type_aliases import RewardLabels
from sb3_htr.pearl.reward_model import MIN_LOG_STD, RewardModel

N_STATES, N_TASKS, LATENT_DIM = 30, 8, 3


def by_autograd(model: RewardModel, next_obs: th.Tensor, z: th.Tensor, labels: RewardLabels) -> th.Tensor:
    """What the losses are defined as, added up with different weights."""
    states, tasks = model.state_tower(next_obs), model.task_tower(z)
    weight = labels.inferred / (labels.inferred.sum().clamp(min=1) * len(states))
    success = (labels.reward > 0).float()
    cross_entropy = F.binary_cross_entropy_with_logits(model.success_logits(states, tasks), success, reduction="none")
    log_std = model.log_std.clamp(min=MIN_LOG_STD)
    error = (model.success_rewards(states, tasks) - labels.reward) / model.scale.clamp(min=1e-6)
    likelihood = 0.5 * error.square() * (-2 * log_std).exp() + log_std
    return 2 * (cross_entropy * weight).sum() + 3 * (likelihood * success * weight).sum()


@pytest.mark.parametrize("log_std", [-1.0, MIN_LOG_STD - 1])
@pytest.mark.parametrize("share_of_successes", [0.2, 0.0])
@pytest.mark.parametrize("share_of_inferred", [0.7, 0.0])
def test_losses_and_gradients_are_those_of_autograd(
    log_std: float, share_of_successes: float, share_of_inferred: float
) -> None:
    th.manual_seed(0)
    model = RewardModel(2, 2, LATENT_DIM)
    model.log_std.data.fill_(log_std)
    model.scale.fill_(0.8)
    next_obs, z = th.randn(N_STATES, 2), th.randn(N_TASKS, LATENT_DIM, requires_grad=True)
    reward = th.rand(N_STATES, N_TASKS) * (th.rand(N_STATES, N_TASKS) < share_of_successes)
    inferred = (th.rand(N_TASKS) < share_of_inferred).float()
    labels = RewardLabels(th.arange(N_STATES), reward, th.zeros(N_STATES), inferred)
    learning = [z, *model.state_tower.parameters(), *model.task_tower.parameters(), model.raw_sharpness, model.log_std]
    success_loss, reward_loss = model.losses(next_obs, z, labels)
    actual = 2 * success_loss + 3 * reward_loss
    # The scale has followed the rewards: it is the same for both
    expected = by_autograd(model, next_obs, z, labels)
    th.testing.assert_close(actual, expected)
    th.testing.assert_close(th.autograd.grad(actual, learning), th.autograd.grad(expected, learning))
