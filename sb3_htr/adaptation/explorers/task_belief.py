"""Which of the known tasks is an unknown task like? A belief, updated by nothing but the rewards of an adaptation."""

import numpy as np

from sb3_htr.adaptation.knowledge import KnownTasks

# Chance that a visit finds a task that it should find
DETECTION_PROBABILITY = 0.8
# Chance that it finds a task that it should not find, or finds one with any other return than expected
SURPRISE_PROBABILITY = 0.02
# Standard deviation of returns around those expected, relative to the largest of them; 0.05 and 0.2 are as good
RELATIVE_DEVIATION = 0.1
# A visit may take that much longer, and one step more, than the episode that it is known from. By measurement on the Point
# Robot (two models, 200 tasks drawn anew), episodes to the first success with 1.0 2.5, with 1.2 2.1, with 1.5 2.6
PATIENCE = 1.2
# Share of the known tasks, the most similar ones, that a visit may turn to when another has failed within the same episode
NEARBY = 0.25


class TaskBelief:
    """
    A probability for each of n known tasks, for several unknown tasks (envs) side by side.

    To *visit* a known task is to act as if it were the unknown one. What each visit returns under each known task is known
    from meta-training, so what a visit really returned tells the known tasks apart: two that are equally near to where the
    reward was found differ in what earlier visits should have returned.

    :param known: the known tasks, at least one
    :param n_envs: number of unknown tasks
    """

    def __init__(self, known: KnownTasks, n_envs: int) -> None:
        self.known = known
        self._finds = np.isfinite(known.first_success).astype(np.float64)
        # A task that few others resemble stands for more of the task space than one of many alike
        belief = 1 / np.maximum(self._finds.sum(axis=0), 1)
        self.belief = np.tile(belief / belief.sum(), (n_envs, 1))
        self._patience = PATIENCE * known.first_success + 1
        distance = np.square(known.z[:, None] - known.z).sum(axis=-1)
        n_nearby = max(int(NEARBY * len(known.z)), 1)
        self._nearby = distance <= np.partition(distance, n_nearby - 1, axis=1)[:, n_nearby - 1 : n_nearby]
        # (n_envs, n), visits that failed or returned something: another would show the same
        self._visited = np.zeros((n_envs, len(belief)), dtype=bool)

    def has_failed(self, task: np.ndarray, n_steps: np.ndarray) -> np.ndarray:
        """
        :param task: (k,) int, what is visited
        :param n_steps: (k,) for how long
        :return: (k,) bool, whether it should have found its task by now
        """
        return n_steps >= self._patience[task, task]

    def missed(self, envs: np.ndarray, task: np.ndarray, n_steps: np.ndarray) -> None:
        """
        Learn from visits without reward.

        :param envs: (k,) int, where
        :param task: (k,) int, what was visited
        :param n_steps: (k,) for how long
        """
        should_find = self.known.first_success[task] < n_steps[:, None]
        self._update(envs, np.where(should_find, 1 - DETECTION_PROBABILITY, 1.0))
        self._visited[envs, task] |= self.has_failed(task, n_steps)

    def found(self, envs: np.ndarray, task: np.ndarray, returns: np.ndarray) -> None:
        """
        Learn from visits with rewards.

        :param envs: (k,) int, where
        :param task: (k,) int, what was visited
        :param returns: (k,) return of the episode, without the task-free part; NaN where the visit is only a part of it
        """
        expected = self.known.returns[task]
        difference = (returns[:, None] - expected) / (RELATIVE_DEVIATION * self.known.returns.max())
        as_expected = np.where(np.isnan(difference), 1.0, np.exp(-0.5 * difference**2))
        self._update(envs, SURPRISE_PROBABILITY + np.where(expected > 0, DETECTION_PROBABILITY * as_expected, 0.0))
        self._visited[envs, task] |= np.isfinite(returns)

    def _update(self, envs: np.ndarray, likelihood: np.ndarray) -> None:
        belief = self.belief[envs] * likelihood
        self.belief[envs] = belief / belief.sum(axis=1, keepdims=True)

    def to_find(self, envs: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """
        :param envs: (k,) int
        :param near: (k,) int, consider the known tasks near these only
        :return: (k,) int, the visit that most probably finds the unknown task
        """
        # Among equals, the visit that does best: its z is the most certain
        preference = 1e-6 * np.diag(self.known.returns) / self.known.returns.max()
        value = self.belief[envs] @ self._finds.T + preference
        return self._best_unvisited(envs, value if near is None else np.where(self._nearby[near], value, -1.0))

    def to_exploit(self, envs: np.ndarray) -> np.ndarray:
        """
        :param envs: (k,) int
        :return: (k,) int, the visit with the largest expected return
        """
        return self._best_unvisited(envs, self.belief[envs] @ self.known.returns.T)

    def _best_unvisited(self, envs: np.ndarray, value: np.ndarray) -> np.ndarray:
        exhausted = self._visited[envs].all(axis=1)
        self._visited[envs[exhausted]] = False
        return np.asarray(np.where(self._visited[envs], -np.inf, value).argmax(axis=1))
