"""Rewards at meta-test that are none of those of meta-training."""

import re
import warnings
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest

from helpers import ENV_ID
from helpers.runs import SHIPPED
from sb3_htr import PEARL
from sb3_htr.adaptation import Step
from sb3_htr.adaptation.reward_watch import RewardWatch


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda reward: 100 * reward, r"A step returned [89]\d more than .*, expected up to about 0\.9"),
        (lambda reward: reward - 1, r"the steps of an episode returned -(1|0\.[5-9]\d?) more than .*, expected about 0"),
        (
            lambda reward: reward / 10,
            r"another scale than in meta-training: .* rewarded step returned 0\.[01]\d* more .*, and at least 0\.[45]\d*",
        ),
        (
            lambda reward: reward + 1,
            r"Each step returned (1|0\.9\d*) more than .*, expected about 0, unless the task is solved",
        ),
        (lambda reward: reward, ""),
    ],
    ids=["of another scale", "by another convention", "too small", "with something for each step", "as in training"],
)
def test_rewards_unlike_those_of_training_are_warned_of(given: Callable[[float], float], message: str) -> None:
    """An agent for which a goal is 1 would never find one that is 0 in place of -1."""
    env = gym.wrappers.TransformReward(gym.make(ENV_ID), given)  # type: ignore[arg-type]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        PEARL.load(SHIPPED).adapt(env, n_episodes=8)
    about = [text for text in (str(warning.message) for warning in caught) if "meta-training" in text]
    assert len([text for text in about if re.search(message, text)]) == (1 if message else 0)


def test_ends_of_episodes_may_be_numbers() -> None:
    adaptation = PEARL.load(SHIPPED).start_adaptation(3)
    obs = np.zeros((3, 2), dtype=np.float32)
    with pytest.warns(UserWarning, match="On average, the steps of an episode returned -1") as caught:
        adaptation.observe(Step(obs, obs, np.array([0.0, 0.0, -1.0]), obs, np.array([0, 0, 1])))
    assert caught[0].filename == __file__


def test_steps_that_return_what_they_should_are_not_warned_of_where_a_success_may_be_below_0() -> None:
    """As where a step without success is -1, and the model of task-free rewards has not learnt it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        watch = RewardWatch(2, threshold=-0.5, worth=0.5)
        watch.rewarded(np.zeros(2), np.array([True, False]))
        watch.rewarded(np.zeros(2), np.array([True, True]))


def test_each_episode_has_a_mean_of_its_own() -> None:
    watch, ended = RewardWatch(1, threshold=0.5, worth=1.0), np.array([True])
    watch.rewarded(np.array([1.0]), ended)
    with pytest.warns(UserWarning, match="On average, the steps of an episode returned -1 more"):
        watch.rewarded(np.array([-1.0]), ended)


def test_rewards_are_warned_of_when_enough_of_them_was_seen() -> None:
    """Of one env alone, and of episodes of one step, all may be successes; and one step may return a little more."""
    rewarded, nobody, first, second = np.ones(2), *np.array([[False, False], [True, False], [False, True]])
    watch, of_one_step = (RewardWatch(2, threshold=0.5, worth=1.0) for _ in range(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_one_step.rewarded(rewarded, first | second)
        watch.rewarded(rewarded, nobody)
        watch.rewarded(np.array([4.9, 1.0]), first)
    with pytest.warns(UserWarning, match="Each step returned 1 more"):
        watch.rewarded(rewarded, second)
    with pytest.warns(UserWarning, match=r"A step returned 5\.1 more .*, expected up to about 1:"):
        watch.rewarded(np.array([5.1, 1.0]), nobody)


def test_rewards_that_no_network_could_take_are_refused() -> None:
    adaptation = PEARL.load(SHIPPED).start_adaptation(1)
    obs = np.zeros((1, 2), dtype=np.float32)
    with pytest.raises(ValueError, match=r"The rewards of env 0 are 1e\+30, expected finite numbers up to 1e\+18"):
        adaptation.observe(Step(obs, obs, np.array([1e30]), obs, np.array([False])))
