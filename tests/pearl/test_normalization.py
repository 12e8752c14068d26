"""Normalized observations: a part of the policy."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from helpers import ENV_ID, ROLLOUT, MakePEARL, parameters, with_policy
from helpers.adaptations import step
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.normalizer import ObservationNormalizer
from sb3_htr.common.type_aliases import Context
from sb3_htr.common.vec_env import make_task_vec_env

NOT_NORMALIZED = {"policy_kwargs": with_policy(normalize_observations=False)}


def normalizer(model: PEARL) -> ObservationNormalizer:
    assert model.policy.normalizer is not None
    return model.policy.normalizer


@pytest.fixture
def trained(tiny_pearl: MakePEARL) -> PEARL:
    return tiny_pearl().learn(2 * ROLLOUT)


def test_statistics_follow_what_is_acted_on_in_training(tiny_pearl: MakePEARL) -> None:
    """All of it, also what is acted on at random, and nothing else: not what an episode ends with."""
    acted_on: list[np.ndarray] = []

    def note(names: dict[str, Any], _: Any) -> bool:
        acted_on.append(names["step"].observations.copy())
        return True

    model = tiny_pearl().learn(2 * ROLLOUT, callback=note)
    obs = np.concatenate(acted_on)
    assert len(obs) == model.num_timesteps == 2 * ROLLOUT
    np.testing.assert_allclose(normalizer(model).count, len(obs), rtol=1e-6)
    np.testing.assert_allclose(normalizer(model).mean, obs.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(normalizer(model).variance, obs.var(axis=0), rtol=1e-5)
    assert model.replay_buffer is not None
    rows = model.replay_buffer.episodes.take(np.arange(model.replay_buffer.size()))
    stored = rows[:, model.replay_buffer.transitions.observation]
    np.testing.assert_array_equal(np.sort(stored, axis=0), np.sort(obs, axis=0), err_msg="they are stored as they were")


def test_every_network_sees_normalized_observations(trained: PEARL, tiny_pearl: MakePEARL) -> None:
    """With them, networks without normalization do the same."""
    plain = tiny_pearl(**NOT_NORMALIZED)
    weights = {key: value for key, value in trained.policy.state_dict().items() if not key.startswith("normalizer.")}
    plain.policy.load_state_dict(weights)
    obs = np.random.default_rng(0).normal(0, 0.5, (9, 2)).astype(np.float32)
    z = np.random.default_rng(1).normal(size=(9, 3)).astype(np.float32)
    mean, variance = normalizer(trained).mean.numpy(), normalizer(trained).variance.numpy()
    by_hand = np.clip((obs - mean) / np.sqrt(variance + 1e-8), -10, 10).astype(np.float32)
    assert np.abs(by_hand - obs).max() > 0.5
    np.testing.assert_allclose(trained.policy.act(obs, z, True), plain.policy.act(by_hand, z, True), atol=1e-5)
    ours, _ = trained.predict(obs, (z,), deterministic=True)
    np.testing.assert_allclose(ours, plain.predict(by_hand, (z,), deterministic=True)[0], atol=1e-5)
    actions, rewards, lengths = th.from_numpy(z[:, :2]), th.ones(9), th.tensor([4, 5])
    with th.no_grad():
        a, b = (
            model.policy.infer(Context(th.from_numpy(seen), actions, rewards, th.from_numpy(seen), lengths))
            for model, seen in ((trained, obs), (plain, by_hand))
        )
    for x, y in zip(a, b, strict=True):
        th.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("with_next_obs", [False, True])
def test_a_context_row_is_observation_action_reward(
    with_next_obs: bool, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And, where that is asked for, the observation that followed."""
    trained = tiny_pearl(policy_kwargs=with_policy(use_next_obs_in_context=with_next_obs)).learn(2 * ROLLOUT)
    read: list[th.Tensor] = []

    def extend(state: th.Tensor, rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
        read.append(rows)
        return state

    monkeypatch.setattr(trained.policy.encoder, "extend", extend)
    obs, actions, next_obs = th.tensor([[0.3, 0.2]]), th.tensor([[-0.5, 1.0]]), th.tensor([[0.25, 0.3]])
    trained.policy.infer(Context(obs, actions, th.tensor([6.0]), next_obs, th.tensor([1])))
    expected = [normalizer(trained)(obs), actions, th.tensor([[6.0]]), normalizer(trained)(next_obs)]
    assert th.equal(read[0], th.cat(expected[: 3 + with_next_obs], dim=1))


def test_updates_see_normalized_observations(trained: PEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[th.Tensor] = []
    critic = trained.critic.forward

    def noting(obs_z: th.Tensor, actions: th.Tensor) -> th.Tensor:
        seen.append(obs_z[:, :2].detach())
        return critic(obs_z, actions)

    monkeypatch.setattr(trained.critic, "forward", noting)
    data = trained.replay_buffer.sample(4, meta_batch_size=8)  # type: ignore[union-attr]
    monkeypatch.setattr(trained.replay_buffer, "sample", lambda *_, **__: data)
    trained._update(4)
    expected = normalizer(trained)(data.observations)
    assert len(seen) == 2 and all(th.equal(obs, expected) for obs in seen)


def test_an_adaptation_tells_what_is_task_free_by_normalized_observations(
    trained: PEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[th.Tensor] = []
    task_free = trained.policy.reward_model.task_free

    def noting(*given: th.Tensor) -> th.Tensor:
        seen.extend(given)
        return task_free(*given)

    monkeypatch.setattr(trained.policy.reward_model, "task_free", noting)
    now, then = (np.array([place], dtype=np.float32) for place in ([0.1, 0.2], [0.2, 0.1]))
    trained.start_adaptation(1, "prior").observe(step(now, [0.0], False)._replace(next_observations=then))
    for given, obs in ((seen[0], now), (seen[2], then)):
        assert th.equal(given, normalizer(trained)(th.from_numpy(obs)))


def test_evaluation_leaves_them_alone(trained: PEARL) -> None:
    before = parameters(trained)
    evaluate_adaptation(trained, ENV_ID, "validation", n_episodes=2)
    trained.predict(np.full(2, 99.0, np.float32), (np.zeros((1, 3), np.float32),))
    trained.train(2, 4)
    after = parameters(trained)
    statistics = [name for name in before if name.startswith("normalizer.")]
    assert len(statistics) == 3 and all(th.equal(before[name], after[name]) for name in statistics)


def test_without_it_observations_are_as_they_are(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl(**NOT_NORMALIZED).learn(ROLLOUT).policy
    assert policy.normalizer is None and policy.normalize(obs := th.randn(3, 2)) is obs
    assert not [name for name in policy.state_dict() if name.startswith("normalizer")]


def test_vec_normalize_is_refused(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """At once, and not only where a model is made; also one that normalizes nothing yet."""
    normalized = partial(VecNormalize, norm_obs=False, norm_reward=False)
    message = r"VecNormalize stands between .*policies normalize observations themselves"
    with pytest.raises(ValueError, match=message):
        tiny_pearl(normalized(make_task_vec_env(ENV_ID, 4)))
    tiny_pearl().save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        PEARL.load(tmp_path / "model", env=normalized(make_task_vec_env(ENV_ID, 4)))
    loaded = PEARL.load(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        loaded.set_env(normalized(make_task_vec_env(ENV_ID, 4)))
    model = tiny_pearl()
    with pytest.raises(ValueError, match=message):
        model.set_env(normalized(make_task_vec_env(ENV_ID, 4)))
    assert not isinstance(model.env, VecNormalize)
    # It would act on other numbers than in training, and scores would be of other rewards
    with pytest.raises(ValueError, match=message):
        evaluate_adaptation(model, normalized(make_task_vec_env(ENV_ID, 4)))
    with pytest.raises(ValueError, match=message):
        model.adapt(normalized(make_task_vec_env(ENV_ID, 1)))
