"""Whole episodes of all tasks in one contiguous array."""

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_htr.htr.groups import positions


class EpisodeIndex(NamedTuple):
    """
    The stored transitions as one virtual list, ordered by task and within a task from the oldest to the newest episode.

    Ranges are half-open: task i owns rows ``task_row[i]:task_row[i + 1]``.

    :param rows: (n_transitions,) int, position of each transition in ``EpisodeStore.rows``
    :param episode_row: (n_episodes + 1,) int, first virtual row of each episode
    :param task_episode: (n_tasks + 1,) int, first episode of each task
    :param task_row: (n_tasks + 1,) int, first virtual row of each task
    :param tasks: (k,) int, the tasks that have at least one episode
    """

    rows: np.ndarray
    episode_row: np.ndarray
    task_episode: np.ndarray
    task_row: np.ndarray
    tasks: np.ndarray

    def latest_episodes(self, tasks: np.ndarray, n_episodes: int) -> np.ndarray:
        """
        :param tasks: (m,) int
        :param n_episodes: how many of each task's newest episodes, at most
        :return: (m, 2) int, their virtual rows as half-open ranges
        """
        first, end = self.task_episode[tasks], self.task_episode[tasks + 1]
        return self.episode_row[np.stack([np.maximum(end - n_episodes, first), end], axis=1)]

    def task_of(self, episodes: np.ndarray) -> np.ndarray:
        """
        :param episodes: (m,) int
        :return: (m,) int, the task that each is of
        """
        return np.searchsorted(self.task_episode, episodes, side="right") - 1

    def all_episodes(self, tasks: np.ndarray) -> np.ndarray:
        """
        :param tasks: (m,) int
        :return: (m, 2) int, the virtual rows of each task as half-open ranges
        """
        return np.stack([self.task_row[tasks], self.task_row[tasks + 1]], axis=1)


class EpisodeStore:
    """
    One float32 array of slots; a slot holds one episode, and each task owns a ring of slots. Tasks can be added later.

    Slots are allocated when first needed and the array grows by doubling, so an empty store costs nothing.

    :param n_tasks: number of tasks
    :param episodes_per_task: capacity of each task's ring, in episodes; then the oldest episode is overwritten
    :param episode_length: largest number of steps of an episode
    :param row_dim: number of columns of a transition
    """

    #: How often something was written
    n_written: int
    #: (n_slots,) int, which of these times is that of the episode in a slot
    written: np.ndarray

    def __init__(self, n_tasks: int, episodes_per_task: int, episode_length: int, row_dim: int) -> None:
        self.episodes_per_task = episodes_per_task
        self.episode_length = episode_length
        self.n_added = np.zeros(n_tasks, dtype=np.int64)
        self._slots = np.full((n_tasks, episodes_per_task), -1, dtype=np.int64)
        self._n_slots = 0
        self._lengths = np.zeros(0, dtype=np.int64)
        self.n_written = 0
        self.written = np.zeros(0, dtype=np.int64)
        self._data = np.zeros((0, episode_length, row_dim), dtype=np.float32)
        self._index: EpisodeIndex | None = None

    @property
    def rows(self) -> np.ndarray:
        """All slots as (n_slots * episode_length, row_dim); see :class:`EpisodeIndex` for the rows that hold data."""
        return self._data.reshape(-1, self._data.shape[-1])

    def take(self, virtual: np.ndarray) -> np.ndarray:
        """
        :param virtual: (n,) int, virtual rows, see :class:`EpisodeIndex`
        :return: (n, row_dim) float32, copies of these transitions
        """
        return self.rows.take(self.index().rows.take(virtual), axis=0)

    @property
    def n_tasks(self) -> int:
        """Number of tasks, those added later among them."""
        return len(self.n_added)

    @property
    def nbytes(self) -> int:
        """Bytes of memory allocated for transitions."""
        return self._data.nbytes

    def add(self, task: int, episode: np.ndarray) -> None:
        """
        Append an episode to a task's ring.

        :param task: task index
        :param episode: (length, row_dim) float32
        """
        position = self.n_added[task] % self.episodes_per_task
        slot = self._slots[task, position]
        if slot < 0:
            slot = self._slots[task, position] = self._allocate()
        self._data[slot, : len(episode)] = episode
        self._lengths[slot] = len(episode)
        self.n_written += 1
        self.written[slot] = self.n_written
        self.n_added[task] += 1
        self._index = None

    def add_task(self) -> int:
        """
        :return: index of a new task, without episodes
        """
        if self.n_tasks == len(self._slots):
            more = np.full((max(self.n_tasks, 1), self.episodes_per_task), -1, dtype=np.int64)
            self._slots = np.concatenate([self._slots, more])
        self.n_added = np.append(self.n_added, 0)
        self._index = None
        return self.n_tasks - 1

    def state_dict(self) -> dict[str, Any]:
        """
        :return: all episodes, for :meth:`load_state_dict`
        """
        arrays = {
            "n_added": self.n_added,
            "slots": self._slots[: self.n_tasks],
            "lengths": self._lengths[: self._n_slots],
            "data": self._data[: self._n_slots],
        }
        return {
            **{name: th.tensor(array) for name, array in arrays.items()},
            "capacity": th.tensor(len(self._data)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict` of a store of the same shape
        :raises ValueError: if it is of a store of another shape
        """
        arrays = {name: tensor.cpu().numpy().copy() for name, tensor in state.items()}
        if arrays["data"].shape[1:] != self._data.shape[1:] or arrays["slots"].shape[1] != self.episodes_per_task:
            raise ValueError(
                f"The saved episodes have {arrays['slots'].shape[1]} slots a task of shape {arrays['data'].shape[1:]}, this "
                f"buffer has {self.episodes_per_task} of {self._data.shape[1:]}: "
                "use the settings that they were saved with, and the same time limit."
            )
        self.n_added, self._slots = arrays["n_added"], arrays["slots"]
        self._n_slots = len(arrays["data"])
        free = int(arrays["capacity"]) - self._n_slots
        self._lengths = np.pad(arrays["lengths"], (0, free))
        self._data = np.pad(arrays["data"], ((0, free), (0, 0), (0, 0)))
        self.n_written += 1
        self.written = np.full(len(self._data), self.n_written)
        self._index = None

    def _allocate(self) -> int:
        if self._n_slots == len(self._data):
            n_slots = min(max(16, 2 * len(self._data)), self.n_tasks * self.episodes_per_task)
            data = np.zeros((n_slots, *self._data.shape[1:]), dtype=np.float32)
            data[: self._n_slots] = self._data
            self._data = data
            self._lengths = np.append(self._lengths, np.zeros(n_slots - len(self._lengths), dtype=np.int64))
            self.written = np.append(self.written, np.zeros(n_slots - len(self.written), dtype=np.int64))
        self._n_slots += 1
        return self._n_slots - 1

    def index(self) -> EpisodeIndex:
        """
        :return: the index of what is stored now; rebuilt only after an ``add``
        """
        if self._index is None:
            count = np.minimum(self.n_added, self.episodes_per_task)
            age = np.arange(count.max(initial=0))
            position = ((self.n_added - count)[:, None] + age) % self.episodes_per_task
            slots = np.take_along_axis(self._slots[: self.n_tasks], position, axis=1)[age < count[:, None]]
            lengths = self._lengths[slots]
            task_episode = np.concatenate([[0], np.cumsum(count)])
            episode_row = np.concatenate([[0], np.cumsum(lengths)])
            self._index = EpisodeIndex(
                rows=np.repeat(slots * self.episode_length, lengths) + positions(lengths),
                episode_row=episode_row,
                task_episode=task_episode,
                task_row=episode_row[task_episode],
                tasks=np.flatnonzero(count),
            )
        return self._index
