"""The model of rewards learns which states solve which tasks, and what they return."""

import numpy as np
import pytest
import torch as th

from sb3_htr.common.type_aliases import RewardLabels
from sb3_htr.pearl.reward_model import MIN_LOG_STD, RewardModel

RADIUS = 0.4


def labelled(n_states: int, goals: th.Tensor, inferred: th.Tensor) -> tuple[th.Tensor, RewardLabels]:
    """States of a square, and what they return near each goal: 1 less the distance."""
    states = 2 * th.rand(n_states, 2) - 1
    distance = th.cdist(states, goals)
    reward = (1 - distance) * (distance < RADIUS)
    weights = th.full((n_states,), 1 / n_states)
    return states, RewardLabels(th.arange(n_states), weights, states, reward, th.zeros(n_states), inferred)


def test_it_learns_what_solves_a_task_and_what_that_returns() -> None:
    th.manual_seed(0)
    model = RewardModel(2, 1, 2)
    optimizer = th.optim.Adam(model.parameters(), 3e-3)
    for _ in range(400):
        goals = 2 * th.rand(32, 2) - 1
        states, labels = labelled(128, goals, th.ones(32))
        loss = sum(model.losses(states, goals, labels), start=th.zeros(()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    goals = 2 * th.rand(32, 2) - 1
    states, labels = labelled(1000, goals, th.ones(32))
    with th.no_grad():
        states, tasks = model.state_tower(states), model.task_tower(goals)
        chance, reward = model.success_logits(states, tasks).sigmoid(), model.success_rewards(states, tasks)
    success = labels.reward > 0
    assert chance[success].mean() > 0.7 and chance[~success].mean() < 0.05
    assert chance.mean().item() == pytest.approx(success.float().mean().item(), abs=0.02), "as often as it happens"
    assert (reward - labels.reward)[success].abs().mean() < 0.05
    assert model.log_std < -1.2, "surer than it began, at -1"
    assert model.scale.item() == pytest.approx(labels.reward[success].mean().item(), abs=0.05)


def test_a_task_of_which_nothing_was_rewarded_teaches_nothing() -> None:
    """Its z can be that of any task."""
    th.manual_seed(0)
    model, goals = RewardModel(2, 1, 2), th.rand(8, 2, requires_grad=True)
    states, labels = labelled(64, goals.detach(), (th.arange(8) < 4).float())
    (of_goals,) = th.autograd.grad(sum(model.losses(states, goals, labels), start=th.zeros(())), [goals])
    assert of_goals[:4].abs().sum() > 0 and not of_goals[4:].any()
    nothing = labels._replace(inferred=th.zeros(8))
    assert [loss.item() for loss in model.losses(states, goals, nothing)] == [0.0, 0.0]


def test_a_deviation_that_became_too_small_grows_again() -> None:
    """Also from below its bound, where an update can leave it."""
    model = RewardModel(2, 1, 2)
    reward = 1 + 0.5 * th.randn(64, 8).abs()
    labels = RewardLabels(th.arange(64), th.full((64,), 1 / 64), th.zeros(64, 2), reward, th.zeros(64), th.ones(8))
    with th.no_grad():
        model.log_std.fill_(MIN_LOG_STD - 0.01)
    _, loss = model.losses(th.randn(64, 2), th.randn(8, 2), labels)
    loss.backward()
    assert model.log_std.grad is not None and model.log_std.grad < 0, "descent makes it larger"


def test_losses_of_the_reward_model_are_those_of_the_docstring() -> None:
    th.manual_seed(0)
    model, next_obs, z = RewardModel(2, 1, 2), th.randn(5, 2), th.randn(3, 2)
    reward = th.tensor([[2.0, 0, 1], [0, 0, 0], [0, 3, 0], [1, 1, 1], [0, 0, 2]])
    labels = RewardLabels(th.arange(5), th.full((5,), 1 / 5), next_obs, reward, th.zeros(5), th.tensor([1.0, 0, 1]))
    with th.no_grad():
        model.log_std.fill_(-0.4)
        model.scale.fill_(2.0)
        cross_entropy, nll = model.losses(next_obs, z, labels)
        states, tasks = model.state_tower(next_obs), model.task_tower(z)
        mean, success = model.success_rewards(states, tasks), (reward > 0).float()
        expected = th.distributions.Normal(mean / model.scale, model.log_std.exp()).log_prob(reward / model.scale)
        density = -(expected + 0.5 * th.tensor(2 * th.pi).log()) * success
        chance = th.distributions.Bernoulli(logits=model.success_logits(states, tasks)).log_prob(success)
    th.testing.assert_close(nll, density[:, [0, 2]].mean())
    th.testing.assert_close(cross_entropy, -chance[:, [0, 2]].mean())
    assert model.deviation.item() == pytest.approx(model.scale.item() * np.exp(-0.4))
