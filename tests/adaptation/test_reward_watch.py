"""Rewards at meta-test that are none of those of meta-training."""

import re
import warnings
from collections.abc import Callable

import gymnasium as gym
import pytest

from helpers import ENV_ID
from helpers.runs import SHIPPED
from sb3_htr import PEARL


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda reward: 100 * reward, r"A step returned [89]\d more than .*, expected up to about 0\.9"),
        (lambda reward: reward - 1, r"the steps of an episode returned -(1|0\.[5-9]\d?) more than .*, expected about 0"),
        (lambda reward: reward / 10, r"rewarded step returned 0\.[01]\d* more .*, and 0\.[45]\d* would be a success"),
        (lambda reward: reward, ""),
    ],
    ids=["of another scale", "by another convention", "too small", "as in training"],
)
def test_rewards_unlike_those_of_training_are_warned_of(given: Callable[[float], float], message: str) -> None:
    """An agent for which a goal is 1 would never find one that is 0 in place of -1."""
    env = gym.wrappers.TransformReward(gym.make(ENV_ID), given)  # type: ignore[arg-type]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        PEARL.load(SHIPPED).adapt(env, n_episodes=8)
    about = [text for text in (str(warning.message) for warning in caught) if "meta-training" in text]
    assert len([text for text in about if re.search(message, text)]) == (1 if message else 0)
