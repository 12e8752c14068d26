"""Hindsight Inference for Policy Improvement (HIPI): the task that experience looks optimal for, by inverse RL."""

import numpy as np
import torch as th

from sb3_htr.common.settings import check_numbers
from sb3_htr.htr.groups import evenly_spread, first_rows
from sb3_htr.htr.relabel.training_task import TrainingTaskRelabelling

LEVELS = ("episode", "transition")
# Pairs of a transition and a task that networks look at together, to bound memory
CHUNK = 65536


class HindsightInference(TrainingTaskRelabelling):
    """
    Maximum-entropy inverse RL: how probable is it that experience is an optimal agent's on a training task? Eysenbach, Geng,
    Levine and Salakhutdinov, 2020, https://arxiv.org/abs/2002.11089. Their agent is told its task; here it adapts.

    :param temperature: see :class:`TrainingTaskRelabelling`
    :param level: what gets a task. ``"episode"`` (default): an episode, by its return under the task, the posterior of
        maximum-entropy inverse RL over trajectories. ``"transition"``: each step on its own, by the critics' Q(s, a, z), where
        z is the posterior mean of the task given its latest experience; HIPI's code relabels transitions, and HFR's code has
        HIPI in this form; targets of these are of one step, whatever ``n_steps``. Contexts of PEARL are episodes, which is why
        the other is the default
    :param context_size: for ``"transition"``: steps that z is inferred from, at most
    :raises ValueError: for an unknown level, or a number that is out of its range
    """

    def __init__(self, temperature: float = 0.01, level: str = "episode", context_size: int = 20) -> None:
        super().__init__(temperature)
        if level not in LEVELS:
            raise ValueError(f'level is {level!r}, expected "episode" or "transition".')
        check_numbers(context_size=(context_size, 1))
        self.level = level
        self.in_order = level == "episode"
        self.context_size = context_size

    def utilities(self, rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        if self.level == "episode":
            family = self.buffer.task_family
            rewards = family.compute_reward(self.buffer.transitions.trajectory(rows), family.train_tasks)
            return np.add.reduceat(rewards, first_rows(lengths), axis=1, dtype=np.float64).T
        z, columns = self._task_variables(), self.buffer.transitions
        n = max(CHUNK // len(z), 1)
        values = [
            self.policy.values(chunk[:, columns.observation], z.expand(len(chunk), *z.shape), actions=chunk[:, columns.action])
            for chunk in np.split(rows, range(n, len(rows), n))
        ]
        return np.asarray(th.cat(values).cpu().numpy(), dtype=np.float64)

    def _task_variables(self) -> th.Tensor:
        """(n_tasks, latent_dim), z of the training tasks: given what was relabelled to them last, or else their own replay."""
        buffer, tasks = self.buffer, np.arange(self.buffer.n_tasks)
        relabelled, own = (
            store.index().latest_episodes(tasks, buffer.context_episodes) for store in (self.episodes, buffer.episodes)
        )
        is_relabelled = relabelled[:, 1] > relabelled[:, 0]
        ranges = np.where(is_relabelled[:, None], relabelled, own)
        steps, lengths = evenly_spread(ranges[:, 1] - ranges[:, 0], self.context_size)
        virtual = steps + np.repeat(ranges[:, 0], lengths)
        rows = buffer.take(virtual, np.repeat(is_relabelled, lengths), self.episodes)
        return self.policy.infer(buffer.transitions.context(rows, lengths, self.policy.device))[0]
