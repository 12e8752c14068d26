"""Hindsight Foresight Relabelling (HFR): an episode goes where a policy that adapts to it would do well."""

import numpy as np
import torch as th

from sb3_htr.common.settings import check_numbers
from sb3_htr.common.task_reward import task_reward
from sb3_htr.htr.groups import evenly_spread, first_rows, positions
from sb3_htr.htr.relabel.training_task import TrainingTaskRelabelling

# Pairs of an episode and a task that networks look at together, to bound memory
CHUNK = 4096


class HindsightForesight(TrainingTaskRelabelling):
    """
    The utility of an episode for a training task is what the policy is worth that has adapted to it: the episode gets the
    rewards of the task (hindsight), z is inferred from it, and the critics say what acting with this z returns from the
    first states of episodes (foresight). Wan, Peng and Gangwani, 2022, https://arxiv.org/abs/2109.09031.

    :param temperature: see :class:`TrainingTaskRelabelling`
    :param context_size: steps of an episode that z is inferred from, evenly spread and one that the task rewards among them if
        there is any, at most. As many as the shortest contexts of training have, as each narrows the posterior; HFR's code
        takes all of them
    :param n_starts: first states that the value is a mean over. In HFR's code 64 to 1024; here all tasks begin alike
    :raises ValueError: for a number that is out of its range
    """

    def __init__(self, temperature: float = 0.01, context_size: int = 20, n_starts: int = 4) -> None:
        super().__init__(temperature)
        check_numbers(context_size=(context_size, 1), n_starts=(n_starts, 1))
        self.context_size = context_size
        self.n_starts = n_starts

    def utilities(self, rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        first = first_rows(lengths)
        starts = rows[self.buffer.relabel_rng.choice(first, self.n_starts), self.buffer.transitions.observation]
        n = max(CHUNK // self.buffer.n_tasks, 1)
        ends = np.cumsum(lengths)
        chunks = [(i, min(i + n, len(lengths))) for i in range(0, len(lengths), n)]
        return np.concatenate([self._values(rows[first[i] : ends[j - 1]], lengths[i:j], starts) for i, j in chunks])

    def _values(self, rows: np.ndarray, lengths: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """(n_episodes, n_tasks), of acting in ``starts`` (n_starts, obs_dim) with z of each episode under each task."""
        policy, columns, family = self.policy, self.buffer.transitions, self.buffer.task_family
        tasks = family.train_tasks
        n_episodes, n_tasks, n_starts = len(lengths), len(tasks), len(starts)
        rewards = np.asarray(family.compute_reward(columns.trajectory(rows), tasks), dtype=np.float32)
        # Each episode once for each task
        repeated = np.repeat(lengths, n_tasks)
        row = positions(repeated) + np.repeat(np.repeat(first_rows(lengths), n_tasks), repeated)
        task = np.repeat(np.tile(np.arange(n_tasks), n_episodes), repeated)
        gains = task_reward(rewards[task, row], rows[row, columns.task_free_reward])
        steps, taken = evenly_spread(repeated, self.context_size, gains)
        at = steps + np.repeat(first_rows(repeated), taken)
        row, task = row[at], task[at]
        context = columns.context(rows[row], taken, policy.device)
        mean, _ = policy.infer(context._replace(rewards=th.as_tensor(rewards[task, row], device=policy.device)))
        z = mean.reshape(n_episodes, n_tasks, -1).repeat(n_starts, 1, 1)
        values = policy.values(np.repeat(starts, n_episodes, axis=0), z)
        return np.asarray(values.reshape(n_starts, n_episodes, n_tasks).mean(dim=0).cpu().numpy(), dtype=np.float64)
