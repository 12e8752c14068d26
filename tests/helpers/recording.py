"""What a CUDA graph is, without a GPU: operations on memory that stays where it is, recorded once, and repeated."""

from collections.abc import Callable
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

# An operation, its arguments, and which tensors it made
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], list[th.Tensor]]


def tensors(value: Any) -> list[th.Tensor]:
    """All that are in it."""
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, th.Tensor)]


class Recording(TorchDispatchMode):
    """Records, and, unlike a GPU, does what is asked for while it records; so what changes in place is put back."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []
        self.before: dict[int, tuple[th.Tensor, th.Tensor]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        given = tensors((args, kwargs))
        if any(argument.alias_info is not None and argument.alias_info.is_write for argument in func._schema.arguments):
            for tensor in given:
                self.before.setdefault(tensor.untyped_storage().data_ptr(), (tensor, tensor.clone()))
        result = func(*args, **kwargs)
        owned = {tensor.untyped_storage().data_ptr() for tensor in given}
        made = [tensor for tensor in tensors(result) if tensor.untyped_storage().data_ptr() not in owned]
        self.calls.append((func, args, kwargs, made))
        return result

    def replay(self) -> None:
        """Into the same memory."""
        for func, args, kwargs, made in self.calls:
            places = {tensor.untyped_storage().data_ptr() for tensor in tensors((args, kwargs))}
            result = func(*args, **kwargs)
            new = [tensor for tensor in tensors(result) if tensor.untyped_storage().data_ptr() not in places]
            for own, tensor in zip(made, new, strict=True):
                own.copy_(tensor)


def capture(function: Callable[[], None], device: th.device) -> Callable[[], None]:
    """In the place of :func:`sb3_htr.pearl.graphed_update.capture`."""
    assert device.type == "cpu"
    with Recording() as recording:
        function()
    with th.no_grad():
        for tensor, before in recording.before.values():
            tensor.copy_(before)

    def replay() -> None:
        with th.no_grad():
            recording.replay()

    return replay
