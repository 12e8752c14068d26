"""A model that is loaded, or goes on in another env, takes no wrong rewards, and no env that it was not made for."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from helpers import ENV_ID, ROLLOUT, TINY, MakePEARL
from helpers.envs import Robot, wrapped
from htr_envs import PointRobotFamily
from sb3_htr import PEARL, load_untrusted
from sb3_htr.common.family_facts import family_facts
from sb3_htr.common.vec_env import make_task_vec_env


class Rewarded(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        return 2.0 * float(reward)


class Paid(gym.Wrapper[Any, Any, Any, Any]):
    """No kind of wrapper that is known to change rewards, and it changes those of successes alone."""

    def step(self, action: Any) -> Any:
        obs, reward, *others = self.env.step(action)
        return obs, 2.0 * float(reward), *others


# Goals that a random agent comes across
NEAR = {"goal_distance": 0.3}
CHANGED = [
    (lambda: wrapped(Rewarded, **NEAR), "in gymnasium's RewardWrapper, which changes its rewards"),
    (lambda: wrapped(Paid, **NEAR), "The env gave .* but its compute_reward gives"),
    (lambda: make_task_vec_env(ENV_ID, 4, env_kwargs={**NEAR, "reward_type": "dense"}), "reward_type is not 'sparse'"),
    (lambda: make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.5}), "another task family: its goal_distance is 0.5"),
    (lambda: VecMonitor(VecNormalize(make_task_vec_env(ENV_ID, 4, env_kwargs=NEAR))), "VecNormalize stands between"),
    (lambda: wrapped(gym.wrappers.NormalizeReward, **NEAR), "NormalizeReward stands between"),
]


def near() -> Any:
    return make_task_vec_env(ENV_ID, 4, env_kwargs=NEAR)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a model and its replay are."""
    folder = tmp_path_factory.mktemp("saved")
    model = PEARL("MlpPolicy", near(), **TINY).learn(ROLLOUT)
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    return folder


@pytest.mark.parametrize(("change", "message"), CHANGED)
@pytest.mark.parametrize("how", ["set_env", "load and replay", "load"])
def test_wrong_rewards_are_refused_whenever_they_come_in(
    how: str, change: Callable[[], Any], message: str, saved: Path
) -> None:
    if how == "load" and "family" in message:
        # Nothing was collected, and so another family is a new beginning
        loaded = PEARL.load(saved / "model", env=change())
        assert loaded.replay_buffer is not None and vars(loaded.replay_buffer.task_family)["goal_distance"] == 0.5
        return
    with pytest.raises(ValueError, match=message):
        model = PEARL.load(saved / "model", env=near() if how == "set_env" else change())
        if how != "load":
            model.load_replay_buffer(saved / "buffer")
        if how == "set_env":
            model.set_env(change())
        model.learn(10 * ROLLOUT, reset_num_timesteps=False)


def test_another_family_replaces_the_one_of_which_nothing_was_collected(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 3.0}))
    model.learn(ROLLOUT)
    assert model.replay_buffer is not None and model.task_bank is not None
    for family in (model.replay_buffer.task_family, model.task_bank.task_family):
        assert vars(family)["goal_distance"] == 3.0


class Band:
    """An object that has no text of its own."""

    def __init__(self, width: float) -> None:
        self.width, self.itself = width, self


def test_families_are_compared_by_all_that_is_in_them() -> None:
    def facts(value: Any) -> dict[str, str]:
        family = PointRobotFamily()
        vars(family)["part"] = value
        return family_facts(family)

    tensor = th.arange(2000.0)
    for one, other in (
        (Band(0.2), Band(0.3)),
        ([Band(0.2)], [Band(0.3)]),
        ({"x": (Band(0.2),)}, {"x": (Band(0.3),)}),
        (tensor, tensor + (tensor == 1000)),
        ({0, 8}, {0, 16}),
        (np.array(["room", [1]], dtype=object), np.array(["room", [2]], dtype=object)),
    ):
        assert facts(one) != facts(other)
        assert facts(one) == facts(copy.deepcopy(one))
    # Neither where it is in memory, nor the order of a set, which another process may have otherwise
    assert facts(np.random.default_rng(0)) == facts(np.random.default_rng(0))
    assert list({0, 8}) != list({8, 0}) and facts({0, 8}) == facts({8, 0})


@pytest.mark.parametrize("how", ["set_env", "load_replay_buffer"])
def test_rewards_of_which_no_attribute_tells_are_compared(
    how: str, tiny_pearl: MakePEARL, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_pearl(near())
    model.load_replay_buffer(saved / "buffer")
    own = PointRobotFamily.compute_reward
    monkeypatch.setattr(PointRobotFamily, "compute_reward", lambda *args, **kwargs: 2 * own(*args, **kwargs))
    with pytest.raises(ValueError, match=r"What was collected is of another task family .* its compute_reward gives"):
        if how == "set_env":
            model.set_env(near())
        else:
            tiny_pearl(near()).load_replay_buffer(saved / "buffer")


def test_an_env_that_is_refused_leaves_the_model_as_it_was(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    before = model.env
    with pytest.raises(ValueError, match="The env has no task_family"):
        model.set_env(DummyVecEnv([lambda: gym.wrappers.TimeLimit(Robot(20), 20)] * 4))
    assert model.env is before and model.learn(ROLLOUT)._n_updates > 0


def test_a_longer_time_limit_needs_other_room(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    with pytest.raises(ValueError, match="time limit is 40 steps, and what was collected has room for episodes of 20"):
        model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"max_episode_steps": 40}))


def test_an_entropy_coefficient_of_another_kind_than_the_files(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    for theirs, ours in (("auto", 0.01), (0.01, "auto")):
        tiny_pearl(ent_coef=theirs).save(tmp_path / "model")
        with pytest.raises(ValueError, match=f"ent_coef is {ours!r}, and that of the file is of the other kind"):
            PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4), ent_coef=ours)


def test_a_stranger_s_model_on_an_env_of_other_spaces(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    with pytest.raises(ValueError, match="The action space is Discrete"):
        load_untrusted(tmp_path / "model", gym.make("CartPole-v1"))


def test_a_model_file_that_is_not_there_is_not_damaged(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    assert load_untrusted(tmp_path / "model", ENV_ID).policy.latent_dim == 3
    with pytest.raises(FileNotFoundError):
        load_untrusted(tmp_path / "nothing", ENV_ID)


def test_a_model_that_acted_unadapted_warns_again_when_it_was_loaded(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    for _ in range(2):
        with pytest.warns(UserWarning, match="This PEARL is not adapted to any task"):
            model.predict(np.zeros(2, dtype=np.float32))
        model.save(tmp_path / "model")
        model = PEARL.load(tmp_path / "model")
