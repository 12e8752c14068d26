"""Single Episode Relabelling (SER): relabelling when experience is drawn."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_htr.common.settings import check_flags, check_numbers
from sb3_htr.common.type_aliases import Trajectory
from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy, solved_at_start
from sb3_htr.htr.step_cache import StepCache

if TYPE_CHECKING:
    from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer

# Rows that candidates for hindsight tasks are compared with: enough to tell common from rare, in linear time
MAX_COMPARED = 64
# Training tasks, evenly spread in their list, that a step is compared with
MAX_TRAIN_TASKS = 1024
# Times that candidates are drawn anew, from episodes of all tasks, where none of them will do
MAX_REDRAWS = 7


class Candidates(NamedTuple):
    """
    For hindsight tasks.

    :param episode: (n, n_candidates) int
    :param step: (n, n_candidates) int, virtual row of one of its steps
    :param task: (n, n_candidates, task_dim) float32, what this step reached
    :param demerits: (n, n_candidates) int, where these are asked: 2 if the start of the episode solves that, 1 if this step
        solves no training task
    """

    episode: np.ndarray
    step: np.ndarray
    task: np.ndarray
    demerits: np.ndarray


class SingleEpisodeRelabelling(Relabeller):
    """
    ONE episode of the task's replay, ONE hindsight task that this episode reached: both context and RL batch are steps of that
    episode with the rewards of that task (HTR paper, B.2). Needs no memory.

    :param hindsight_task_strategy: which state of an episode is the hindsight task. ``"random"``: any; ``"final"``: the last;
        ``"even"`` (default): any, those that few others resemble being more probable. The paper says "e.g., select a state
        reached"; the default is our choice, by measurement. ``"even"`` differs from B.2 in one more thing: its candidates are
        states of several episodes of the task, and so the choice of the task is one of the episode too
    :param rl_batch_source: ``"episode"`` (B.2, default) draws the RL batch of a relabelled row from the same episode as its
        context; ``"task"`` is the ablation of B.2, the RL batch comes from all of the task's replay
    :param elsewhere: share of the RL batch that is drawn from all of the replay instead, under the same hindsight task. Of one
        episode alone, actor and critics never learn the way to a task from where other tasks lead. By measurement, on a
        two-link arm (one seed): acting with the z of each training task solves .97 of them at 0, all at .25 and .5
    :param prefer_unsolved: of several candidates, a task that was solved already where its episode began is chosen only if all
        are, and as many others from episodes of all tasks, drawn seven times. An object that nobody touched is where it was,
        and ``"even"`` does not see it where objects begin elsewhere in each episode. Of one candidate (``"random"``,
        ``"final"``) there is nothing to prefer
    :param like_training: share of the rows for which one of the candidates that are left is chosen whose step solves some
        training task, and others are drawn in the same way as long as there is none, once such are within reach. What was
        reached is not what will be asked for: objects fall off the table, and ``"even"`` draws what is rare. The other rows
        keep what is learnt as wide as what is reached
    :param context_episodes: at 1 (B.2, default) the context is that one episode. Above, it is a window of from 1 to so many
        neighbouring episodes of the task, all under the hindsight task, that contains this episode or ends right before it:
        what a posterior over all episodes of an adaptation has to make sense of, misses before the first success too. The
        model's ``context_size`` should be that of so many episodes
    :raises ValueError: for an unknown strategy or source, a share out of [0, 1], or no episode
    """

    def __init__(
        self,
        hindsight_task_strategy: HindsightTaskStrategy | str = "even",
        rl_batch_source: str = "episode",
        elsewhere: float = 0.25,
        prefer_unsolved: bool = True,
        like_training: float = 0.5,
        context_episodes: int = 1,
    ) -> None:
        check_numbers(
            elsewhere=(elsewhere, 0.0, 1.0),
            like_training=(like_training, 0.0, 1.0),
            context_episodes=(context_episodes, 1),
        )
        check_flags(prefer_unsolved=prefer_unsolved)
        self.elsewhere = elsewhere
        self.hindsight_task_strategy = HindsightTaskStrategy.of(hindsight_task_strategy)
        if rl_batch_source not in ("episode", "task"):
            raise ValueError(f'rl_batch_source is {rl_batch_source!r}, expected "episode" or "task".')
        self.rl_batch_source = rl_batch_source
        self.prefer_unsolved = prefer_unsolved
        self.like_training = like_training
        self.context_episodes = context_episodes

    def bind(self, buffer: "MultiTaskReplayBuffer") -> None:
        super().bind(buffer)
        self._demerits = StepCache(self._ask_demerits)

    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        buffer, strategy, index = self.buffer, self.hindsight_task_strategy, self.buffer.episodes.index()
        like_training = self._like_training(len(tasks))
        candidates = self._candidates(index.task_episode[tasks], index.task_episode[tasks + 1], like_training)
        if not (candidates.demerits[like_training] % 2 == 0).any():
            # Training tasks are not within reach yet
            like_training[:] = False
            candidates.demerits[:] &= ~1
        for _ in range(MAX_REDRAWS):
            again = np.flatnonzero(candidates.demerits.min(axis=1) > 0)
            if len(again) == 0:
                break
            anywhere = np.zeros_like(again), np.full_like(again, len(index.episode_row) - 1)
            others = self._candidates(*anywhere, like_training[again])
            better = others.demerits.min(axis=1) < candidates.demerits[again].min(axis=1)
            for values, drawn in zip(candidates, others, strict=True):
                values[again[better]] = drawn[better]
        episode, step, hindsight_task, demerits = candidates
        count = self._count_alike(self._steps(step[:MAX_COMPARED, 0]), hindsight_task, demerits)
        chosen = np.arange(len(tasks)), strategy.choose(count, buffer.relabel_rng, demerits)
        episode = episode[chosen]
        batch = context = np.stack([index.episode_row[episode], index.episode_row[episode + 1]], axis=1)
        if self.rl_batch_source == "task":
            batch = index.all_episodes(index.task_of(episode))
        if self.context_episodes > 1:
            context = self._window(episode)
        return HindsightDraw(buffer.episodes, context, batch, hindsight_task[chosen], False, self.elsewhere)

    def _window(self, episode: np.ndarray) -> np.ndarray:
        """(m, 2) int, virtual rows of the neighbouring episodes that contexts are drawn from."""
        rng, index = self.buffer.relabel_rng, self.buffer.episodes.index()
        task = index.task_of(episode)
        n = rng.integers(1, self.context_episodes + 1, size=len(episode))
        first = episode - rng.integers(0, n + 1)
        end = np.minimum(first + n, index.task_episode[task + 1])
        first = np.maximum(first, index.task_episode[task])
        # Nothing is before the first episode of a task
        end = np.maximum(end, first + 1)
        return np.stack([index.episode_row[first], index.episode_row[end]], axis=1)

    def _like_training(self, n: int) -> np.ndarray:
        """(n,) bool, for which rows a hindsight task like those of training is looked for."""
        if self.hindsight_task_strategy.n_candidates == 1 or self.like_training == 0:
            return np.zeros(n, dtype=bool)
        return self.buffer.relabel_rng.random(n) < self.like_training

    def _candidates(self, first: np.ndarray, end: np.ndarray, like_training: np.ndarray) -> Candidates:
        """Of each range of episodes (n,), some episodes and one step of each."""
        rng, index, strategy = self.buffer.relabel_rng, self.buffer.episodes.index(), self.hindsight_task_strategy
        n = len(first), strategy.n_candidates
        episode = first[:, None] + (rng.random(n) * (end - first)[:, None]).astype(np.int64)
        start, end = index.episode_row[episode], index.episode_row[episode + 1]
        step = start + strategy.steps(end - start, rng)
        task = self.buffer.task_family.hindsight_task(self._steps(step), 0)
        if strategy.n_candidates == 1:
            return Candidates(episode, step, task, np.zeros(n, dtype=np.int8))
        demerits = self._demerits.look_up(self.buffer.episodes, index.rows[step])
        demerits[~like_training] &= ~1
        return Candidates(episode, step, task, demerits)

    def _ask_demerits(self, rows: np.ndarray) -> np.ndarray:
        """(n,) int, of steps in these rows of the store, see :class:`Candidates`."""
        buffer, family = self.buffer, self.buffer.task_family
        demerits = np.zeros(len(rows), dtype=np.int8)
        step = buffer.transitions.trajectory(buffer.episodes.rows[rows, None])
        if self.prefer_unsolved:
            start = buffer.transitions.trajectory(buffer.episodes.rows[rows - rows % buffer.episodes.episode_length, None])
            demerits += 2 * solved_at_start(family, start, family.hindsight_task(step, 0))
        if self.like_training > 0:
            n_train = len(family.train_tasks)
            train = family.train_tasks[np.linspace(0, n_train - 1, min(n_train, MAX_TRAIN_TASKS)).astype(np.int64)]
            each = Trajectory(*(values[:, None] for values in step))
            demerits += ~family.is_success(each, train).any(axis=(1, 2))
        return demerits

    def _steps(self, virtual: np.ndarray) -> Trajectory:
        """(..., 1, dim), each virtual row as a trajectory of its own."""
        episodes = self.buffer.episodes
        return self.buffer.transitions.trajectory(episodes.rows[episodes.index().rows[virtual]][..., None, :])

    def _count_alike(self, first: Trajectory, task: np.ndarray, demerits: np.ndarray) -> np.ndarray:
        """
        (n, n_candidates), how many of some other rows solve each candidate's task with their first candidate, plus 1; where
        others of the row have fewer demerits, 1.
        """
        count = np.ones(task.shape[:2])
        if task.shape[1] > 1:
            row, column = np.nonzero(demerits == demerits.min(axis=1, keepdims=True))
            alike = self.buffer.task_family.is_success(first, task[row, column, None])[..., 0]
            own = np.flatnonzero((column == 0) & (row < alike.shape[1]))
            alike[own, row[own]] = False
            count[row, column] += alike.sum(axis=1)
        return count
