"""Episode Clustering (EC): relabelling when the data comes in."""

from typing import Any, Protocol

import numpy as np
import torch as th

from sb3_htr.htr.episode_store import EpisodeIndex
from sb3_htr.htr.hindsight_task import choose_rare, select_step
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class Discretiser(Protocol):
    """Maps tasks to representatives; tasks with one representative share a hindsight buffer."""

    def __call__(self, tasks: np.ndarray) -> np.ndarray:
        """(n, task_dim) tasks to their (n, task_dim) representatives, float32."""
        ...


class GridDiscretiser:
    """
    Rounds tasks to a grid.

    :param cell_size: width of a cell in each dimension; at most the radius of a goal, so that an episode that reached a goal
        has reached the middle of its cell too
    :raises ValueError: if a width is not positive
    """

    def __init__(self, cell_size: float | list[float]) -> None:
        try:
            self.cell_size = np.asarray(cell_size, dtype=np.float32)
        except (TypeError, ValueError):
            raise ValueError(f"cell_size is {cell_size!r}, expected positive widths.") from None
        if not ((self.cell_size > 0) & np.isfinite(self.cell_size)).all() or self.cell_size.size == 0:
            raise ValueError(f"cell_size is {self.cell_size.tolist()}, expected positive widths.")

    def __call__(self, tasks: np.ndarray) -> np.ndarray:
        """
        :param tasks: (n, task_dim)
        :return: (n, task_dim) float32, middles of their cells
        """
        # adding 0 turns -0 into 0, the same cell with other bytes
        return (np.round(tasks / self.cell_size) * self.cell_size + 0).astype(np.float32)


class EpisodeClustering(MultiTaskReplayBuffer):
    """
    Replay buffer that relabels each finished episode at once (HTR paper, B.3 and Algorithm 2).

    Episodes are kept for their own task as in the parent. A copy, with the rewards of a discretised hindsight task, goes to
    the hindsight buffer of that task. :meth:`sample` draws as PEARL does, from the task's own buffer, or, with probability K,
    from a random hindsight buffer in its place. (Algorithm 2, line 12 has the inequality inverted: B.3 swaps "according to
    probability K".)

    Hindsight buffers need memory: it grows with their number, see :attr:`n_hindsight_buffers` and :attr:`hindsight_nbytes`.

    :param args: as for the parent
    :param cell_size: grid of the task space, see :class:`GridDiscretiser`. Our choice for the Point Robot: 0.1, half the goal
        radius
    :param discretiser: in place of a grid
    :param exploratory_fraction: share of the episodes of a hindsight buffer that are exploratory, i.e. were not chosen for
        having solved its task, in [0, 1). Real buffers hold many such; B.3 found the balance to matter and gives no value, 0.3
        is our choice
    :param kwargs: as for the parent; ``rl_batch_source`` has no meaning here
    """

    relabels_at_sample_time = False

    def __init__(
        self,
        *args: Any,
        cell_size: float | list[float] = 0.1,
        discretiser: Discretiser | None = None,
        exploratory_fraction: float = 0.3,
        **kwargs: Any,
    ) -> None:
        if not (isinstance(exploratory_fraction, int | float) and 0 <= exploratory_fraction < 1):
            raise ValueError(f"exploratory_fraction is {exploratory_fraction!r}, expected a number from 0 to below 1.")
        self.discretiser = GridDiscretiser(cell_size) if discretiser is None else discretiser
        self.exploratory_fraction = exploratory_fraction
        self._forget_hindsight()
        super().__init__(*args, **kwargs)

    def _forget_hindsight(self) -> None:
        # The hindsight buffers follow the training tasks in the store
        self._buffer_of: dict[bytes, int] = {}
        self._hindsight_tasks: list[np.ndarray] = []

    @property
    def n_hindsight_buffers(self) -> int:
        """Number of hindsight tasks that were reached so far, after discretisation."""
        return len(self._hindsight_tasks)

    @property
    def hindsight_nbytes(self) -> int:
        """Bytes of memory that the episodes of all hindsight buffers take."""
        index = self.episodes.index()
        rows = index.task_row[-1] - index.task_row[self.n_tasks]
        return int(rows) * self.episodes.rows.itemsize * self.episodes.rows.shape[1]

    def rewarded_fraction(self) -> tuple[float, float]:
        """
        :return: share of the stored episodes with a reward beside the task-free one, in the real and in the hindsight buffers
        """
        index = self.episodes.index()
        if len(index.rows) == 0:
            return 0.0, 0.0
        rows = self.episodes.rows[index.rows]
        task_part = np.abs(rows[:, self._reward] - rows[:, self._task_free_reward]) > 0
        rewarded = np.add.reduceat(task_part, index.episode_row[:-1]) > 0
        split = index.task_episode[self.n_tasks]
        real, hindsight = rewarded[:split], rewarded[split:]
        return float(real.mean()), float(hindsight.mean()) if len(hindsight) else 0.0

    def stats(self) -> dict[str, float]:
        """
        :return: those of the parent, and the balance of rewarded episodes and the memory of the hindsight buffers
        """
        real, hindsight = self.rewarded_fraction()
        return {
            **super().stats(),
            "replay/rewarded_fraction_real": real,
            "replay/rewarded_fraction_hindsight": hindsight,
            "replay/n_hindsight_buffers": self.n_hindsight_buffers,
            "replay/hindsight_megabytes": self.hindsight_nbytes / 1e6,
        }

    def state_dict(self) -> dict[str, Any]:
        """
        :return: as that of the parent, and the tasks of the hindsight buffers
        """
        tasks = np.array(self._hindsight_tasks, dtype=np.float32)
        return {**super().state_dict(), "hindsight_tasks": th.from_numpy(tasks)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict` of a buffer with the same settings
        """
        super().load_state_dict(state)
        self._hindsight_tasks = list(state["hindsight_tasks"].numpy().copy())
        self._buffer_of = {task.tobytes(): self.n_tasks + i for i, task in enumerate(self._hindsight_tasks)}

    def reset(self) -> None:
        """Remove all episodes."""
        super().reset()
        self._forget_hindsight()

    def _end_episode(self, task: int, episode: np.ndarray) -> None:
        super()._end_episode(task, episode)
        lengths = np.full(self.hindsight_task_strategy.n_candidates, len(episode))
        step = select_step(self.hindsight_task_strategy, lengths, self._relabel_rng)
        representatives = self.discretiser(self.task_family.hindsight_task(self.trajectory(episode), step))
        count = np.array([1 + self._n_episodes_of(representative) for representative in representatives])
        representative = representatives[choose_rare(count[None], self._relabel_rng)[0]]
        self._add_hindsight(representative, episode)
        # As many exploratory episodes as make up their share: this one, under a task that others reached
        n_exploratory = self.exploratory_fraction / (1 - self.exploratory_fraction)
        for _ in range(int(n_exploratory + self._relabel_rng.random())):
            other = self._hindsight_tasks[self._relabel_rng.integers(self.n_hindsight_buffers)]
            self._add_hindsight(other, episode)

    def _n_episodes_of(self, hindsight_task: np.ndarray) -> int:
        buffer = self._buffer_of.get(hindsight_task.tobytes())
        return 0 if buffer is None else int(self.episodes.n_added[buffer])

    def _add_hindsight(self, hindsight_task: np.ndarray, episode: np.ndarray) -> None:
        key = hindsight_task.tobytes()
        if key not in self._buffer_of:
            self._buffer_of[key] = self.episodes.add_task()
            self._hindsight_tasks.append(hindsight_task)
        relabelled = episode.copy()
        tasks = np.broadcast_to(hindsight_task, (len(episode), len(hindsight_task)))
        self._write_rewards(relabelled, np.arange(len(episode)), tasks, "sparse")
        self.episodes.add(self._buffer_of[key], relabelled)

    def _draw_relabelled(self, meta_batch_size: int) -> np.ndarray:
        return super()._draw_relabelled(meta_batch_size) & (self.n_hindsight_buffers > 0)

    def _draw_hindsight(self, index: EpisodeIndex, tasks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A random hindsight buffer in place of each real one."""
        chosen = self._relabel_rng.integers(self.n_hindsight_buffers, size=len(tasks))
        return self._task_sources(index, self.n_tasks + chosen), np.stack(self._hindsight_tasks)[chosen]
