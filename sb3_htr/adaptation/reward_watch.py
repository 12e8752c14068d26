"""Which steps are rewarded at meta-test, and whether rewards are given otherwise there than in meta-training."""

import numpy as np

from sb3_htr.adaptation.reward_noise import RewardNoise
from sb3_htr.common.warn_once import WarnOnce

# Times what a success is worth: that of one step may be more than their mean, but not by so much
LARGER = 5.0
# Standard deviations by which a reward must be more than noise, which that is in one step of 30,000. Our choice
CERTAIN = 4.0
# By which one is to be less, to count as one without success: between the two, it may be a success that noise made small. Our
# choice, by drawn rewards
LIKELY = 2.5


class RewardWatch:
    """
    Tells which steps are rewarded: those above the threshold of meta-training, and above the noise of this robot's rewards.
    Warns, once each, of rewards that are too large, and of those by which a success cannot be told.

    Where a goal is reached for 0 in place of -1, the agent would take all that it does for a failure, and where each step
    returns something more, all for a success.

    :param n_envs: number of envs
    :param threshold: above which a step is taken for a success, by what it returns beside what the model says of steps without
    :param worth: largest reward that is known of a success, likewise
    """

    def __init__(self, n_envs: int, threshold: float, worth: float) -> None:
        self._threshold = threshold
        self._worth = worth
        # Where a success may be below 0, meta-training has not learnt what steps without it return
        self._noise = RewardNoise(n_envs, threshold) if threshold > 0 else None
        self._sum = np.zeros(n_envs)
        self._n_steps = np.zeros(n_envs, dtype=np.int64)
        # Of all steps so far; of one env alone, they may be successes
        self._least = np.inf
        self._has_ended = np.zeros(n_envs, dtype=bool)
        self._warn_once = WarnOnce()

    def rewarded(self, beside: np.ndarray, dones: np.ndarray) -> np.ndarray:
        """
        :param beside: (n_envs,), what a step of each env returned beside what the model says of steps without success
        :param dones: (n_envs,) bool, where an episode ended
        :return: (n_envs,) bool, which of these steps are rewarded
        """
        self._check(beside, dones)
        if self._noise is None:
            return np.asarray(beside > self._threshold)
        level, deviation = self._noise.level, self._noise.deviation
        if 2 * (largest := deviation.max()) > self._worth:
            self._warn_once(
                "noise",
                f"The rewards of steps without success have a standard deviation of {largest:.2g}, among which a success of "
                f"up to {self._worth:.2g} can hardly be told: filter them, or pay for what is sure.",
                stacklevel=4,
            )
        # A step that returns as much as a success does passes for one, however large the noise is
        likely, certain = (np.clip(level + times * deviation, self._threshold, self._worth) for times in (LIKELY, CERTAIN))
        self._noise.observe(beside, beside <= likely)
        return np.asarray(beside > certain)

    def _check(self, beside: np.ndarray, dones: np.ndarray) -> None:
        if (largest := beside.max()) > LARGER * self._worth:
            self._warn("A step", largest, f"up to about {self._worth:.2g}")
        self._sum += beside
        self._n_steps += 1
        self._least = min(self._least, beside.min())
        if dones.any():
            self._has_ended |= dones
            if self._has_ended.all() and self._n_steps.max() > 1 and self._least > max(self._threshold, 0.0):
                self._warn("Each step", self._least, "about 0, unless the task is solved from the first step on")
            if (lowest := (self._sum[dones] / self._n_steps[dones]).min()) < -abs(self._threshold):
                self._warn("On average, the steps of an episode", lowest, f"about 0, and a success up to {self._worth:.2g}")
            self._sum[dones] = self._n_steps[dones] = 0

    def _warn(self, what: str, value: float, expected: str) -> None:
        self._warn_once(
            what,
            f"{what} returned {value:.2g} more than meta-training has taught of steps without success, expected "
            f"{expected}: give rewards as in meta-training, or the agent cannot make sense of them.",
            stacklevel=6,
        )
