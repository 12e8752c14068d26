"""Which state of which episode becomes the hindsight task."""

from enum import Enum

import numpy as np

from sb3_htr.common.type_aliases import TaskFamily, Trajectory


class HindsightTaskStrategy(Enum):
    """
    The paper leaves the choice open ("e.g., select a state reached in t", Algorithm 2, line 7).
    """

    #: A uniformly random step of the episode
    RANDOM = "random"
    #: The last step of the episode
    FINAL = "final"
    #: Of several random steps one, with probabilities that even out how often similar tasks are drawn
    EVEN = "even"

    @classmethod
    def of(cls, strategy: "HindsightTaskStrategy | str") -> "HindsightTaskStrategy":
        """
        :param strategy: a member or its name
        :return: the member
        :raises ValueError: for an unknown name
        """
        try:
            return cls(strategy)
        except ValueError:
            names = sorted(member.value for member in cls)
            raise ValueError(f"hindsight_task_strategy is {strategy!r}, expected one of {names}.") from None

    @property
    def n_candidates(self) -> int:
        """Number of steps that one is chosen from. By measurement: with 8, a search of the Point Robot widens fast enough."""
        return 8 if self is HindsightTaskStrategy.EVEN else 1

    def steps(self, lengths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """
        :param lengths: int, number of steps of each episode, any shape
        :param rng: source of randomness
        :return: int, same shape, for each episode the index of the step whose achieved task is a candidate
        """
        if self is HindsightTaskStrategy.FINAL:
            return lengths - 1
        return (rng.random(lengths.shape) * lengths).astype(np.int64)

    @staticmethod
    def choose(count: np.ndarray, rng: np.random.Generator, demerits: np.ndarray | None = None) -> np.ndarray:
        """
        Choose among candidates with probabilities inverse to how common they are.

        :param count: (n, n_candidates), how often something like the candidate was seen, more than 0
        :param rng: source of randomness
        :param demerits: (n, n_candidates), candidates that have more than others of their row are not chosen
        :return: (n,) int, index of the chosen candidate in each row
        """
        if count.shape[1] == 1:
            return np.zeros(len(count), dtype=np.int64)
        weight = 1 / count
        if demerits is not None:
            weight = np.where(demerits > demerits.min(axis=1, keepdims=True), 0.0, weight)
        cumulative = np.cumsum(weight, axis=1)
        return (rng.random((len(count), 1)) * cumulative[:, -1:] > cumulative).sum(axis=1)


def solved_at_start(family: TaskFamily, first: Trajectory, tasks: np.ndarray) -> np.ndarray:
    """
    Whether tasks are solved before anything was done. Hindsight teaches nothing of them: their real episodes are rewarded.

    A task is solved by the state that a step leads to. So the first state is seen as if a step had led to it. (What the first
    step led to would be another question: it may have solved a task that is one step away.)

    :param family: tells successes
    :param first: first steps of episodes, arrays of shape (..., 1, dim)
    :param tasks: (..., task_dim)
    :return: (...) bool
    """
    before = Trajectory(first.observations, first.actions, first.observations, first.task_free_reward)
    return np.asarray(family.is_success(before, tasks)[..., 0])
