"""Search for an unknown task among the known ones, episode by episode and within an episode."""

import numpy as np

from sb3_htr.adaptation.explorers.task_belief import TaskBelief
from sb3_htr.adaptation.knowledge import KnownTasks


class TaskSearch:
    """
    Which known task to visit, for several unknown tasks (envs) side by side.

    A visit that has found nothing in the time that it should take turns to a similar known task within the same episode:
    what is near in z is near in the env, and the rest of an episode that has failed is lost time otherwise.

    :param known: the known tasks, at least one
    :param n_envs: number of unknown tasks
    """

    def __init__(self, known: KnownTasks, n_envs: int) -> None:
        self.known = known
        self._belief = TaskBelief(known, n_envs)
        # The known task that is visited, -1 for none
        self._task = np.full(n_envs, -1, dtype=np.int64)
        self._n_steps = np.zeros(n_envs, dtype=np.int64)
        self._since_start = np.zeros(n_envs, dtype=bool)

    @property
    def belief(self) -> np.ndarray:
        """Probability of each known task, (n_envs, n)."""
        return self._belief.belief

    def begin(self, envs: np.ndarray, exploring: np.ndarray) -> np.ndarray:
        """
        Visit known tasks in the episodes that begin.

        :param envs: (k,) int
        :param exploring: (k,) bool, to find the unknown task for the first time, instead of returning as much as possible
        :return: (k, latent_dim), z of the visits
        """
        self._task[envs[exploring]] = self._belief.to_find(envs[exploring])
        self._task[envs[~exploring]] = self._belief.to_exploit(envs[~exploring])
        self._n_steps[envs] = 0
        self._since_start[envs] = True
        return np.asarray(self.known.z[self._task[envs]])

    def observe(self, returns: np.ndarray, ended: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Take in one step of each env.

        :param returns: (n_envs,), return of the episode so far, without the task-free part, 0 without reward
        :param ended: (n_envs,) bool, whether this step ended it; then the env visits nothing until the next :meth:`begin`
        :return: (k,) int and (k, latent_dim), the envs that visit another known task from now on, and its z
        """
        self._n_steps += 1
        visiting = self._task >= 0
        failed = visiting & self._belief.has_failed(self._task, self._n_steps)
        missed = np.flatnonzero(visiting & (returns == 0) & (failed | ended))
        self._belief.missed(missed, self._task[missed], self._n_steps[missed])
        found = np.flatnonzero(visiting & (returns > 0) & ended)
        # What an episode of several visits should return is not known
        self._belief.found(found, self._task[found], np.where(self._since_start, returns, np.nan)[found])
        turning = missed[~ended[missed]]
        self._task[turning] = self._belief.to_find(turning, near=self._task[turning])
        self._n_steps[turning] = 0
        self._since_start[turning] = False
        self._task[ended] = -1
        return turning, self.known.z[self._task[turning]]
