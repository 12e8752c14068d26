"""Settings that follow from the time limit."""

import warnings
from typing import Any

import gymnasium as gym
import pytest

from helpers import ENV_ID, TINY
from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.horizon import settings_for, timesteps_for
from sb3_htr.pearl.untrusted import load_untrusted

NAMES = ("gamma", "n_steps", "n_episodes_per_task", "learning_starts", "gradient_steps", "batch_size", "context_size")


def make(max_episode_steps: int, **given: Any) -> PEARL:
    env = gym.make(ENV_ID, max_episode_steps=max_episode_steps)
    return PEARL("MlpPolicy", env, policy_kwargs=TINY["policy_kwargs"], **given)


@pytest.mark.parametrize(
    ("max_episode_steps", "expected"),
    [
        (1, (0.0, 1, 10, 199, 10, 1, 1)),
        (2, (0.5, 1, 10, 399, 20, 2, 2)),
        (20, (0.9, 1, 10, 3999, 200, 20, 20)),
        (50, (0.96, 1, 8, 7999, 400, 24, 24)),
        (200, (0.98, 3, 2, 7999, 400, 24, 24)),
        (1000, (0.98, 10, 2, 39_999, 2000, 24, 24)),
    ],
)
def test_what_is_not_given_follows_from_the_time_limit(max_episode_steps: int, expected: tuple[float, ...]) -> None:
    model = make(max_episode_steps)
    assert tuple(getattr(model, name) for name in NAMES) == pytest.approx(expected)


def test_what_is_given_stays() -> None:
    given: dict[str, Any] = dict(zip(NAMES, (0.5, 4, 3, 7, 11, 5, 9), strict=True))
    model = make(200, **given)
    assert {name: getattr(model, name) for name in NAMES} == given


def test_a_rollout_has_as_many_updates_per_step_at_any_time_limit() -> None:
    for max_episode_steps in (5, 20, 77, 200, 1000):
        settings = settings_for(max_episode_steps, 20)
        steps = 20 * settings["n_episodes_per_task"] * max_episode_steps
        assert steps / settings["gradient_steps"] == pytest.approx(20, rel=0.05)
        assert timesteps_for(max_episode_steps) >= 10 * steps, "a training has many rollouts"


def test_a_loaded_model_keeps_its_own(tmp_path: Any) -> None:
    model = make(20, gamma=0.7)
    model.save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", env=gym.make(ENV_ID, max_episode_steps=200))
    assert {name: getattr(loaded, name) for name in NAMES} == {name: getattr(model, name) for name in NAMES}


def test_what_follows_from_another_training_is_warned_of(tmp_path: Any) -> None:
    make(20).save(tmp_path / "model")
    longer = gym.make(ENV_ID, max_episode_steps=200)
    for load in (PEARL.load, load_untrusted):
        with pytest.warns(UserWarning, match="The env's time limit is 200 steps, and what follows from it is still of 20"):
            load(tmp_path / "model", env=longer)
        with pytest.warns(UserWarning, match="A rollout is of 50 tasks, and what follows from that is still of 20"):
            load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 50))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4))  # 20 tasks, four at a time
            load(tmp_path / "model", env=gym.make(ENV_ID))


def test_learn_has_a_budget_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr("stable_baselines3.sac.SAC.learn", lambda self, total_timesteps, **_: asked.append(total_timesteps))
    for max_episode_steps in (20, 200):
        make(max_episode_steps).learn()
    assert asked == [150_000, 600_000]
