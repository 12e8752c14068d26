"""Precision of float32 matrix products."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

PRECISIONS = ("highest", "high", "medium")


@contextmanager
def matmul_precision(precision: str) -> Iterator[None]:
    """
    Set ``torch.set_float32_matmul_precision`` for a while. It belongs to the process, and others may have set it.

    :param precision: ``"highest"``, ``"high"`` or ``"medium"``
    """
    before = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        th.set_float32_matmul_precision(before)
