"""One update: losses, gradients, and what follows them, written down once more."""

from itertools import count
from typing import Any

import numpy as np
import pytest
import torch as th

from helpers import ROLLOUT, MakePEARL
from helpers.experience import by_task
from sb3_htr.pearl.encoder import kl_to_prior


def test_an_update_is_that_of_the_formulas(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    """Written down once more: losses, gradients, and what the target critics follow."""
    settings: dict[str, Any] = {"ent_coef": "auto_0.3", "kl_coef": 0.7, "tau": 0.3, "target_update_interval": 2}
    model = tiny_pearl(**settings, meta_batch_size=2).learn(2 * ROLLOUT)
    policy, critic, target, encoder = model.policy, model.critic, model.critic_target, model.encoder
    assert model.replay_buffer is not None and model.log_ent_coef is not None and model._n_updates == 6
    data = model.replay_buffer.sample(4, meta_batch_size=2, context_size=20)
    # Of tasks of other lengths; some steps end an episode, some returns are of several steps
    lengths, dones, discounts = th.tensor([1, 7]), th.tensor([0.0, 1.0] * 4), th.linspace(0.5, 0.9, 8)
    data = data._replace(lengths=lengths, dones=dones, discounts=discounts, labels=None)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: data)
    for optimizer in (model.actor.optimizer, critic.optimizer, encoder.optimizer, model.ent_coef_optimizer):
        optimizer.param_groups[0]["lr"] = 0.0  # type: ignore[union-attr]
    with th.no_grad():
        for parameter in target.parameters():
            parameter.add_(0.3 * th.randn_like(parameter))
    weight, alpha = th.tensor([1 / 2, *[1 / 14] * 7]), model.log_ent_coef.detach().exp()

    th.manual_seed(0)
    mean, variance = policy.infer(data.context)
    z = (mean + variance.sqrt() * th.randn_like(mean)).repeat_interleave(lengths, dim=0)
    obs, next_obs = (th.cat([policy.normalize(o), z], dim=1) for o in (data.observations, data.next_observations))
    next_actions, next_log_prob = policy.sample_actions(next_obs)
    value = target(next_obs, next_actions).min(dim=0)[0] - alpha * next_log_prob
    expected = (data.rewards + (1 - dones) * discounts * value).detach()
    critic_loss = (weight * (critic(obs, data.actions) - expected) ** 2).sum()
    kl = kl_to_prior(mean, variance).mean()
    gradients = th.autograd.grad(critic_loss + 0.7 * kl, [*encoder.parameters()])
    actions, log_prob = policy.sample_actions(obs.detach())
    actor_loss = (weight * (alpha * log_prob - critic(obs.detach(), actions).min(dim=0)[0])).sum()
    entropy_gap = (weight * log_prob).sum() + float(model.target_entropy)

    before = [parameter.clone() for parameter in target.parameters()]
    th.manual_seed(0)
    _, log = model._update(4)
    for name, loss in (("critic_loss", critic_loss), ("kl_divergence", kl), ("actor_loss", actor_loss)):
        th.testing.assert_close(log[name], loss.detach(), msg=name)
    for parameter, gradient in zip(encoder.parameters(), gradients, strict=True):
        th.testing.assert_close(parameter.grad, gradient)
    # Descent makes the coefficient larger where the entropy is less than is asked for
    assert model.log_ent_coef.grad is not None
    th.testing.assert_close(model.log_ent_coef.grad, -entropy_gap.detach().reshape(1))
    assert all(th.equal(*pair) for pair in zip(target.parameters(), before, strict=True)), "only every other update"
    model._update(4)
    for own, old, new in zip(target.parameters(), before, critic.parameters(), strict=True):
        th.testing.assert_close(own, 0.7 * old + 0.3 * new)


def test_the_aggregate_is_of_the_latest_updates(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    model, number = tiny_pearl().learn(2 * ROLLOUT), count()
    update = model._update
    monkeypatch.setattr(model, "_update", lambda *given: (th.full((1, 3), float(next(number))), update(*given)[1]))
    model.train(30)
    assert model.knowledge.mean.tolist() == [19.5] * 3, "of 10 to 29"


def test_what_is_logged_of_a_meta_batch_is_that_of_its_tasks(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl(meta_batch_size=30).learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    data = model.replay_buffer.sample(8, meta_batch_size=30, context_size=20)
    data = data._replace(unrewarded=np.arange(30) < 6, relabelled=np.arange(30) < 21)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: data)
    _, log = model._update(8)
    assert log["rl_zero_reward_fraction"].item() == pytest.approx(0.2)
    assert log["relabelled_fraction"].item() == pytest.approx(0.7)
    of_tasks = [rewards.mean() for rewards in by_task(data.rewards, data.lengths)]
    assert any(of_tasks) and log["rl_reward_mean"].item() == pytest.approx(np.mean(of_tasks), rel=1e-4)


def test_the_reward_model_learns_from_normalized_observations_of_the_labelled_rows(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    data = model.replay_buffer.sample(4, meta_batch_size=8, n_labelled=10)
    labels, normalize = data.labels, model.policy.normalize
    assert labels is not None
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: data)
    seen: list[th.Tensor] = []
    losses, task_free = model.reward_model.losses, model.reward_model.task_free

    def noting(call: Any, n_seen: int) -> Any:
        def noted(*args: Any) -> Any:
            seen.extend(args[:n_seen])
            return call(*args)

        return noted

    monkeypatch.setattr(model.reward_model, "losses", noting(losses, 1))
    monkeypatch.setattr(model.reward_model, "task_free", noting(task_free, 3))
    model._update(4)
    next_obs, obs = normalize(labels.next_observations), normalize(data.observations[labels.rows])
    for given, expected in zip(seen, (next_obs, obs, data.actions[labels.rows], next_obs), strict=True):
        assert th.equal(given, expected)


def test_reward_coef_is_the_weight_of_the_reward_model_in_z(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    data = model.replay_buffer.sample(4, meta_batch_size=8, n_labelled=20)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: data)
    for network in (model.actor, model.critic, model.encoder, model.reward_model):
        network.optimizer.param_groups[0]["lr"] = 0.0
    model.critic_target.load_state_dict(model.critic.state_dict())
    scale, gradients = model.reward_model.scale.clone(), []
    for model.reward_coef in (0.0, 0.25, 1.0):
        model.reward_model.scale.copy_(scale)
        th.manual_seed(0)
        model._update(4)
        gradients.append(th.cat([th.as_tensor(parameter.grad).flatten() for parameter in model.encoder.parameters()]))
    none, quarter, full = gradients
    assert (full - none).abs().max() > 1e-3
    th.testing.assert_close(quarter - none, 0.25 * (full - none), rtol=1e-2, atol=1e-5)
