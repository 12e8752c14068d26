"""Which state of an episode becomes the hindsight task."""

from enum import Enum

import numpy as np


class HindsightTaskStrategy(Enum):
    """
    The paper leaves the choice open ("e.g., select a state reached in t", Algorithm 2, line 7).
    """

    # A uniformly random step of the episode
    RANDOM = 0
    # The last step of the episode
    FINAL = 1


# For convenience, so that YAML files can use strings
KEY_TO_HINDSIGHT_TASK_STRATEGY = {
    "random": HindsightTaskStrategy.RANDOM,
    "final": HindsightTaskStrategy.FINAL,
}


def to_hindsight_task_strategy(strategy: HindsightTaskStrategy | str) -> HindsightTaskStrategy:
    """
    :param strategy: a member of :class:`HindsightTaskStrategy` or its lower-case name
    :return: the member
    :raises ValueError: for an unknown name
    """
    if isinstance(strategy, HindsightTaskStrategy):
        return strategy
    try:
        return KEY_TO_HINDSIGHT_TASK_STRATEGY[strategy.lower()]
    except KeyError:
        raise ValueError(
            f"hindsight_task_strategy is {strategy!r}, expected one of {sorted(KEY_TO_HINDSIGHT_TASK_STRATEGY)}."
        ) from None


def select_step(strategy: HindsightTaskStrategy, lengths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    :param strategy: how to choose
    :param lengths: (n,) int, number of steps of each episode
    :param rng: source of randomness
    :return: (n,) int, for each episode the index of the step whose achieved task becomes the hindsight task
    """
    if strategy is HindsightTaskStrategy.FINAL:
        return lengths - 1
    return (rng.random(len(lengths)) * lengths).astype(np.int64)
