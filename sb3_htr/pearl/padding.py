"""Meta-batches of one shape, whatever the lengths of episodes."""

import torch as th
from torch.nn import functional as F

from sb3_htr.common.type_aliases import Context, MultiTaskSamples, RewardLabels


def padded(data: MultiTaskSamples, n_context: int, n_rows: int, n_labelled: int) -> MultiTaskSamples:
    """
    Fill a meta-batch up to a fixed number of rows, by one task more, which has rows of zeros and weighs nothing.

    :param data: a meta-batch of M tasks
    :param n_context: rows of the context, more than there are
    :param n_rows: transitions for actor and critics, more than there are
    :param n_labelled: transitions under all tasks, as many as there are, or more
    :return: the same meta-batch of M + 1 tasks, whose losses are those of ``data``; what is no tensor stays as it is
    """
    return data._replace(
        context=Context(
            observations=_filled(data.context.observations, n_context),
            actions=_filled(data.context.actions, n_context),
            rewards=_filled(data.context.rewards, n_context),
            next_observations=_filled(data.context.next_observations, n_context),
            lengths=_closed(data.context.lengths, n_context),
        ),
        observations=_filled(data.observations, n_rows),
        actions=_filled(data.actions, n_rows),
        next_observations=_filled(data.next_observations, n_rows),
        rewards=_filled(data.rewards, n_rows),
        dones=_filled(data.dones, n_rows),
        discounts=_filled(data.discounts, n_rows),
        lengths=_closed(data.lengths, n_rows),
        task_weights=_filled(data.task_weights, len(data.task_weights) + 1),
        labels=None if data.labels is None else _padded_labels(data.labels, n_labelled),
    )


def _padded_labels(labels: RewardLabels, n: int) -> RewardLabels:
    return RewardLabels(
        rows=_filled(labels.rows, n),
        weights=_filled(labels.weights, n),
        next_observations=_filled(labels.next_observations, n),
        reward=F.pad(_filled(labels.reward, n), (0, 1)),
        task_free=_filled(labels.task_free, n),
        inferred=_filled(labels.inferred, len(labels.inferred) + 1),
    )


def _filled(rows: th.Tensor, n: int) -> th.Tensor:
    """(k, ...) to (n, ...), with zeros behind."""
    assert n >= len(rows), "torch would leave the others out"
    return F.pad(rows, [0, 0] * (rows.dim() - 1) + [0, n - len(rows)])


def _closed(lengths: th.Tensor, n: int) -> th.Tensor:
    """(M,) to (M + 1,), the last of which is what is missing to ``n``."""
    return th.cat([lengths, n - lengths.sum(dim=0, keepdim=True)])
