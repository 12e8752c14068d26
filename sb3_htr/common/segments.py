"""
Rows of several tasks in one list, those of the first task first.

Sums over a task's rows have one order, on a GPU too, where torch's own gradient of ``repeat_interleave`` adds rows in the
order in which threads come: two trainings of one seed would differ.
"""

from typing import Any

import torch as th


def segment_sum(rows: th.Tensor, lengths: th.Tensor) -> th.Tensor:
    """
    :param rows: (n, ...), the first ``lengths[0]`` of which are one segment, and so on
    :param lengths: (M,) int64, which sum to n; not checked, as that would wait for a GPU
    :return: (M, ...), zeros for an empty segment
    """
    return th.segment_reduce(rows, "sum", lengths=lengths, axis=0, unsafe=True)


class _RepeatSegments(th.autograd.Function):
    """``repeat_interleave`` with another backward pass."""

    @staticmethod
    def forward(ctx: Any, values: th.Tensor, lengths: th.Tensor, n: int) -> th.Tensor:
        ctx.save_for_backward(lengths)
        return values.repeat_interleave(lengths, dim=0, output_size=n)

    @staticmethod
    def backward(ctx: Any, *grads: th.Tensor) -> tuple[th.Tensor, None, None]:
        (lengths,) = ctx.saved_tensors
        return segment_sum(grads[0].contiguous(), lengths), None, None


def repeat_segments(values: th.Tensor, lengths: th.Tensor, n: int) -> th.Tensor:
    """
    :param values: (M, ...), one of each segment
    :param lengths: (M,) int64, which sum to ``n``
    :param n: number of rows, given so that nothing waits for a GPU
    :return: (n, ...), of each row, the value of its segment; its gradient is a :func:`segment_sum`
    """
    result: th.Tensor = _RepeatSegments.apply(values, lengths, n)
    return result
