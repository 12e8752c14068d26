"""How much the rewards of steps without success vary at meta-test, as those that a sensor measures do."""

import numpy as np

# In thresholds: what differs less is the same, and what is further from 0 than FARTHEST is as far. From NEAR on, bins are the
# wider the further they are: if all beyond it were as far, much noise would have quantiles that are the same, as none has
WIDTH, NEAR, FARTHEST = 1 / 16, 4.0, 1000.0
N_FAR = 32
# Before so many steps of an env, nothing is said of it. Our choice
MIN_STEPS = 40


class RewardNoise:
    """
    Estimates the standard deviation of what steps without success return, of each env by its own steps.

    It is the distance from the median to the quantiles of .16 and .84, the smaller one, so that neither an offset counts as
    noise, nor a penalty, however many of the steps have it.

    :param n_envs: number of envs
    :param threshold: above 0, what a success returns more than
    """

    def __init__(self, n_envs: int, threshold: float) -> None:
        self._width = WIDTH * threshold
        # Middles of the bins above 0, and of all, in this width
        above = np.append(np.arange(1, NEAR / WIDTH), np.geomspace(NEAR, FARTHEST, N_FAR) / WIDTH)
        self._bins = np.concatenate([-above[::-1], [0.0], above])
        self._edges = (self._bins[:-1] + self._bins[1:]) / 2
        self._counts = np.zeros((n_envs, len(self._bins)), dtype=np.int64)
        #: (n_envs,), in steps of a sixteenth of the threshold, and in larger ones from four thresholds on
        self.deviation = np.zeros(n_envs)
        #: (n_envs,), 0 or less: the median, where costs are larger than the model says
        self.level = np.zeros(n_envs)

    def observe(self, beside: np.ndarray, unrewarded: np.ndarray) -> None:
        """
        :param beside: (n_envs,), what a step of each env returned beside what the model says of steps without success
        :param unrewarded: (n_envs,) bool, envs whose step had none
        """
        envs = np.flatnonzero(unrewarded)
        self._counts[envs, self._edges.searchsorted(beside[envs] / self._width)] += 1
        below = self._counts[envs].cumsum(axis=1)
        n_steps = below[:, -1:]
        low, median, high = (self._bins[(below >= share * n_steps).argmax(axis=1)] for share in (0.16, 0.5, 0.84))
        least = np.minimum(median - low, high - median)
        self.level[envs] = self._width * np.minimum(median, 0)
        self.deviation[envs] = np.where(n_steps[:, 0] < MIN_STEPS, 0.0, self._width * least)
