"""Tensors that travel together: views of one block of memory, which one copy moves."""

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, TypeVar

import torch as th

# In bytes: where tensors begin, whatever their dtype
ALIGNMENT = 16

AnyTuple = TypeVar("AnyTuple", bound=tuple[Any, ...])


class Packed:
    """
    Memory for some tensors.

    :param like: of these shapes and dtypes
    :param device: where the memory is
    :param pin_memory: whether a GPU can read it by itself
    """

    def __init__(self, like: Sequence[th.Tensor], device: th.device | str, pin_memory: bool = False) -> None:
        sizes = [tensor.numel() * tensor.element_size() for tensor in like]
        starts = [0, *accumulate(-(-size // ALIGNMENT) * ALIGNMENT for size in sizes)]
        #: (n,) uint8, all of them
        self.block = th.zeros(starts[-1], dtype=th.uint8, device=device, pin_memory=pin_memory)
        #: Views of it
        self.tensors = [
            self.block[start : start + size].view(tensor.dtype).view(tensor.shape)
            for start, size, tensor in zip(starts, sizes, like, strict=False)
        ]


def tensors_of(structure: tuple[Any, ...]) -> list[th.Tensor]:
    """
    :param structure: tensors, tuples of what may be here, and anything else
    :return: its tensors
    """
    result: list[th.Tensor] = []
    map_tensors(lambda tensor: result.append(tensor) or tensor, structure)  # type: ignore[func-returns-value]
    return result


def map_tensors(function: Callable[[th.Tensor], th.Tensor], structure: AnyTuple) -> AnyTuple:
    """
    :param function: of a tensor
    :param structure: named tuple of tensors, of other such tuples, and of anything else
    :return: the same with the function's results in place of the tensors, which it is called with in their order
    """

    def mapped(part: Any) -> Any:
        if isinstance(part, th.Tensor):
            return function(part)
        return map_tensors(function, part) if isinstance(part, tuple) else part

    return type(structure)(*map(mapped, structure))
