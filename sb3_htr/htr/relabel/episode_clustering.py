"""Episode Clustering (EC): relabelling when the data comes in."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_htr.common.settings import check_flags, plain
from sb3_htr.common.type_aliases import Trajectory
from sb3_htr.htr.relabel.base import HindsightDraw
from sb3_htr.htr.relabel.hindsight_buffers import HindsightBuffers
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy, solved_at_start
from sb3_htr.htr.reward_hook import check_achieved

if TYPE_CHECKING:
    from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class EpisodeClustering(HindsightBuffers):
    """
    Relabels each finished episode at once (HTR paper, B.3 and Algorithm 2), and keeps hindsight buffers of its own.

    A copy of the episode, with the rewards of a discretised hindsight task, goes to the hindsight buffer of that task. A
    relabelled row of a meta-batch is drawn as PEARL draws it, from a random hindsight buffer in place of the task's own.
    (Algorithm 2, line 12 has the inequality inverted: B.3 swaps "according to probability K".)

    Hindsight buffers need memory: it grows with their number, see ``replay/n_hindsight_buffers`` and
    ``replay/hindsight_megabytes`` in the logs.

    :param cell_size: width of the cells of a grid of the task space, one for all dimensions, or one for each; tasks of a cell
        share a hindsight buffer. Our choice for the Point Robot: 0.1, half the goal radius
    :param exploratory_fraction: share of the episodes of a hindsight buffer that are exploratory, i.e. were not chosen for
        having solved its task, in [0, 1). Real buffers hold many such; B.3 found the balance to matter and gives no value, 0.3
        is our choice
    :param hindsight_task_strategy: which state of an episode is the hindsight task, before discretisation: ``"random"``,
        ``"final"``, or ``"even"`` (default), of several the one whose buffer has few episodes
    :param prefer_unsolved: of several candidates, a task that was solved already where the episode began is chosen only if all
        are
    :raises ValueError: for a value that is out of its range
    """

    def __init__(
        self,
        cell_size: float | list[float] = 0.1,
        exploratory_fraction: float = 0.3,
        hindsight_task_strategy: HindsightTaskStrategy | str = "even",
        prefer_unsolved: bool = True,
    ) -> None:
        fraction = plain(exploratory_fraction)
        if isinstance(fraction, bool) or not (isinstance(fraction, int | float) and 0 <= fraction < 1):
            raise ValueError(f"exploratory_fraction is {exploratory_fraction!r}, expected a number from 0 to below 1.")
        check_flags(prefer_unsolved=prefer_unsolved)
        try:
            self.cell_size = np.asarray(cell_size, dtype=np.float32)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"cell_size is {cell_size!r}, expected positive widths.") from None
        if not ((self.cell_size > 0) & np.isfinite(self.cell_size)).all() or self.cell_size.size == 0:
            raise ValueError(f"cell_size is {self.cell_size.tolist()}, expected positive widths.")
        self.exploratory_fraction = fraction
        self.hindsight_task_strategy = HindsightTaskStrategy.of(hindsight_task_strategy)
        self.prefer_unsolved = prefer_unsolved

    def bind(self, buffer: "MultiTaskReplayBuffer") -> None:
        super().bind(buffer)
        task_dim = buffer.task_family.train_tasks.shape[1]
        if self.cell_size.shape not in ((), (1,), (task_dim,)):
            raise ValueError(
                f"cell_size has {self.cell_size.size} widths, expected one, or {task_dim}, one for each dimension of a task."
            )

    def cells(self, tasks: np.ndarray) -> np.ndarray:
        """
        :param tasks: (n, task_dim)
        :return: (n, task_dim) float32, the middles of their cells
        """
        # adding 0 turns -0 into 0, the same cell with other bytes
        return (np.round(tasks / self.cell_size) * self.cell_size + 0).astype(np.float32)

    def reset(self) -> None:
        self.make_buffers(0)
        self._tasks: list[np.ndarray] = []
        self._buffer_of: dict[bytes, int] = {}

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "tasks": th.from_numpy(np.array(self._tasks, dtype=np.float32))}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        tasks = state["tasks"].numpy().copy()
        # Those of another grid would stay, and be drawn beside the cells of this one. Cells of one's own need not be their own
        # middles to the bit
        is_grid = type(self).cells is EpisodeClustering.cells
        if is_grid and len(tasks) and (self.cells(tasks) != tasks).any():
            raise ValueError(
                f"The hindsight buffers that were saved are of another grid than that of cell_size "
                f"{self.cell_size.tolist()}: make the model with the cell_size that they were saved with."
            )
        super().load_state_dict(state)
        self._tasks = list(tasks)
        self._buffer_of = {task.tobytes(): i for i, task in enumerate(self._tasks)}

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        buffer, strategy = self.buffer, self.hindsight_task_strategy
        rng = buffer.relabel_rng
        steps = strategy.steps(np.full(strategy.n_candidates, len(episode)), rng)
        traj = buffer.transitions.trajectory(episode)
        tasks = buffer.task_family.hindsight_task(traj, steps)
        check_achieved(tasks, (len(steps), buffer.task_family.train_tasks.shape[1]))
        representatives = self.cells(tasks)
        count = np.array([[1 + self._n_episodes_of(representative) for representative in representatives]])
        is_solved = None
        if self.prefer_unsolved:
            first = Trajectory(*(values[:1] for values in traj))
            is_solved = solved_at_start(buffer.task_family, first, representatives)[None]
        reached_task = representatives[strategy.choose(count, rng, is_solved)[0]]
        self._add(reached_task, episode)
        # As many exploratory episodes as make up their share: this one, under tasks that others reached, each once
        n_exploratory = self.exploratory_fraction / (1 - self.exploratory_fraction)
        others = np.delete(np.arange(self.n_hindsight_buffers), self._buffer_of[reached_task.tobytes()])
        for other in rng.permutation(others)[: int(n_exploratory + rng.random())]:
            self._add(self._tasks[other], episode)

    def _n_episodes_of(self, hindsight_task: np.ndarray) -> int:
        buffer = self._buffer_of.get(hindsight_task.tobytes())
        return 0 if buffer is None else int(self.episodes.n_added[buffer])

    def _add(self, hindsight_task: np.ndarray, episode: np.ndarray) -> None:
        key = hindsight_task.tobytes()
        if key not in self._buffer_of:
            self._buffer_of[key] = self.episodes.add_task()
            self._tasks.append(hindsight_task)
        relabelled = episode.copy()
        tasks = np.broadcast_to(hindsight_task, (len(episode), len(hindsight_task)))
        self.buffer.write_rewards(relabelled, np.arange(len(episode)), tasks)
        self.episodes.add(self._buffer_of[key], relabelled)

    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        chosen = self.buffer.relabel_rng.integers(self.n_hindsight_buffers, size=len(tasks))
        return self.draw_from(chosen, np.stack([self._tasks[i] for i in chosen]))
