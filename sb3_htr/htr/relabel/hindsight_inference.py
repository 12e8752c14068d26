"""Hindsight Inference for Policy Improvement (HIPI): the task that experience looks optimal for, by inverse RL."""

import numpy as np

from sb3_htr.htr.groups import first_rows
from sb3_htr.htr.relabel.training_task import TrainingTaskRelabelling


class HindsightInference(TrainingTaskRelabelling):
    """
    Maximum-entropy inverse RL: how probable is it that an episode is an optimal agent's on a training task, by its return?
    Eysenbach, Geng, Levine and Salakhutdinov, 2020, https://arxiv.org/abs/2002.11089. Their agent is told its task, and
    transitions get one; here it adapts, and contexts are episodes.

    :param temperature: see :class:`TrainingTaskRelabelling`
    """

    def utilities(self, rows: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        family = self.buffer.task_family
        rewards = family.compute_reward(self.buffer.transitions.trajectory(rows), family.train_tasks)
        return np.add.reduceat(rewards, first_rows(lengths), axis=1, dtype=np.float64).T
