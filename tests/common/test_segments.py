"""Sums over rows of tasks, and values spread to them."""

import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_htr.common.segments import repeat_segments, segment_sum


@given(lengths=st.lists(st.integers(0, 4), min_size=1, max_size=6), columns=st.integers(1, 3), seed=st.integers(0, 99))
def test_each_row_has_the_value_of_its_segment_and_gradients_are_sums(lengths: list[int], columns: int, seed: int) -> None:
    generator, n = th.Generator().manual_seed(seed), sum(lengths)
    values = th.randn(len(lengths), columns, generator=generator, requires_grad=True)
    grad = th.randn(n, columns, generator=generator)
    rows = repeat_segments(values, th.tensor(lengths), n)
    owners = [i for i, length in enumerate(lengths) for _ in range(length)]
    assert rows.tolist() == [values[i].tolist() for i in owners]
    rows.backward(grad)
    assert values.grad is not None
    for i, own in enumerate(values.grad):
        expected = sum((grad[j] for j, owner in enumerate(owners) if owner == i), th.zeros(columns))
        th.testing.assert_close(own, expected)
    th.testing.assert_close(segment_sum(grad, th.tensor(lengths)), values.grad)


def test_of_a_transposed_gradient_too() -> None:
    """What comes from behind may lie in memory as it likes."""
    values = th.ones(2, 3, requires_grad=True)
    (repeat_segments(values, th.tensor([1, 2]), 3) * th.arange(9.0).reshape(3, 3).T).sum().backward()
    assert values.grad is not None and values.grad.tolist() == [[0, 3, 6], [3, 9, 15]]
