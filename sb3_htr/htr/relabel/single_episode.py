"""Single Episode Relabelling (SER): relabelling when experience is drawn."""

import numpy as np

from sb3_htr.common.checks import check_flags, check_numbers
from sb3_htr.common.type_aliases import Trajectory
from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy, solved_at_start

# Rows that candidates for hindsight tasks are compared with: enough to tell common from rare, in linear time
MAX_COMPARED = 64


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
        are. An object that nobody touched is where it was, and ``"even"`` does not see it where objects begin elsewhere in
        each episode. Of one candidate (``"random"``, ``"final"``) there is nothing to prefer
    :raises ValueError: for an unknown strategy or source, or a share out of [0, 1]
    """

    def __init__(
        self,
        hindsight_task_strategy: HindsightTaskStrategy | str = "even",
        rl_batch_source: str = "episode",
        elsewhere: float = 0.25,
        prefer_unsolved: bool = True,
    ) -> None:
        check_numbers(elsewhere=(elsewhere, 0.0, 1.0))
        check_flags(prefer_unsolved=prefer_unsolved)
        self.elsewhere = elsewhere
        self.hindsight_task_strategy = HindsightTaskStrategy.of(hindsight_task_strategy)
        if rl_batch_source not in ("episode", "task"):
            raise ValueError(f'rl_batch_source is {rl_batch_source!r}, expected "episode" or "task".')
        self.rl_batch_source = rl_batch_source
        self.prefer_unsolved = prefer_unsolved

    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        buffer, strategy = self.buffer, self.hindsight_task_strategy
        rng, index = buffer.relabel_rng, buffer.episodes.index()
        first, end = index.task_episode[tasks, None], index.task_episode[tasks + 1, None]
        episode = first + (rng.random((len(tasks), strategy.n_candidates)) * (end - first)).astype(np.int64)
        start, end = index.episode_row[episode], index.episode_row[episode + 1]
        reached = self._steps(start + strategy.steps(end - start, rng))
        hindsight_task = buffer.task_family.hindsight_task(reached, 0)
        count, is_solved = self._count_alike(reached, hindsight_task), None
        if self.prefer_unsolved and strategy.n_candidates > 1:
            is_solved = solved_at_start(buffer.task_family, self._steps(start), hindsight_task)
        chosen = np.arange(len(tasks)), strategy.choose(count, rng, is_solved)
        context = np.stack([start[chosen], end[chosen]], axis=1)
        batch = context if self.rl_batch_source == "episode" else index.all_episodes(tasks)
        return HindsightDraw(buffer.episodes, context, batch, hindsight_task[chosen], False, self.elsewhere)

    def _steps(self, virtual: np.ndarray) -> Trajectory:
        """(..., 1, dim), each virtual row as a trajectory of its own."""
        episodes = self.buffer.episodes
        return self.buffer.transitions.trajectory(episodes.rows[episodes.index().rows[virtual]][..., None, :])

    def _count_alike(self, reached: Trajectory, task: np.ndarray) -> np.ndarray:
        """(n, n_candidates), how many of some other rows solve each candidate's task with their first candidate, plus 1."""
        if task.shape[1] == 1:
            return np.ones(task.shape[:2])
        first = Trajectory(*(values[:MAX_COMPARED, 0] for values in reached))
        return 1 + self.buffer.task_family.is_success(first, task[:, :, None])[..., 0].sum(axis=-1)
