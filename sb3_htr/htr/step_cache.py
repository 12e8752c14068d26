"""What is asked of a stored step again and again, but answered once."""

from collections.abc import Callable

import numpy as np

from sb3_htr.htr.episode_store import EpisodeStore

UNKNOWN = -1


class StepCache:
    """
    What a function says of the steps of a store. A step is asked about when it is first looked at; the answer holds until
    another episode is written in its place.

    :param ask: (n,) int, rows of :attr:`EpisodeStore.rows`, to (n,) int, from 0 to 127
    """

    def __init__(self, ask: Callable[[np.ndarray], np.ndarray]) -> None:
        self._ask = ask
        self._store: EpisodeStore | None = None
        self._written = np.zeros(0, dtype=np.int64)

    def look_up(self, store: EpisodeStore, rows: np.ndarray) -> np.ndarray:
        """
        :param store: holds the steps
        :param rows: int, any shape, rows of :attr:`EpisodeStore.rows` that hold data
        :return: int8, same shape, what the function says of them
        """
        # Another store, or one that was loaded with fewer slots
        if store is not self._store or len(store.written) < len(self._written):
            self._store, self._n_written = store, 0
            self._known, self._written = np.zeros((0, store.episode_length), dtype=np.int8), np.zeros(0, dtype=np.int64)
        if store.n_written != self._n_written:
            self._n_written = store.n_written
            new = len(store.written) - len(self._written)
            self._known, self._written = np.pad(self._known, ((0, new), (0, 0))), np.pad(self._written, (0, new))
            changed = self._written != store.written
            self._known[changed], self._written[changed] = UNKNOWN, store.written[changed]
        known = self._known.reshape(-1)
        unknown = np.unique(rows[known[rows] == UNKNOWN])
        if len(unknown):
            known[unknown] = self._ask(unknown)
        return known[rows]
