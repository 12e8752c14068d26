"""An update as one CUDA graph: launched as a whole, and not operation by operation."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import TypeAlias

import torch as th

from sb3_htr.common.errors import last_line
from sb3_htr.common.type_aliases import MultiTaskSamples
from sb3_htr.pearl.packed import Packed, map_tensors, tensors_of

# Posterior means, and what to log by its name
Outcome: TypeAlias = tuple[th.Tensor, dict[str, th.Tensor]]
# Learns from a meta-batch; whether target networks follow
GradientStep: TypeAlias = Callable[[MultiTaskSamples, bool], Outcome]


class FixedUpdate:
    """
    An update whose meta-batches are in the same memory each time, where one copy brings them.

    :param gradient_step: of all networks; it waits for no value that it computes
    :param device: of the networks
    """

    def __init__(self, gradient_step: GradientStep, device: th.device) -> None:
        self._gradient_step, self._device = gradient_step, device
        self._memory: Packed | None = None

    def __call__(self, data: MultiTaskSamples, update_target: bool) -> Outcome:
        """
        :param data: of the same shapes each time, on the CPU
        :param update_target: whether target networks follow
        :return: posterior means and what to log, as ``gradient_step`` returns them
        """
        given = tensors_of(data)
        assert self._memory is None or [t.shape for t in given] == [t.shape for t in self._memory.tensors]
        if self._memory is None:
            self._memory = Packed(given, self._device)
            views = iter(self._memory.tensors)
            self._data = map_tensors(lambda _: next(views), data)
        # Other memory each time, which is given back when it was read: nothing waits for the copy
        host = Packed(given, "cpu", pin_memory=self._device.type == "cuda")
        for own, tensor in zip(host.tensors, given, strict=True):
            own.copy_(tensor)
        self._memory.block.copy_(host.block, non_blocking=True)
        return self._run(update_target)

    def _run(self, update_target: bool) -> Outcome:
        return self._gradient_step(self._data, update_target)


class GraphedUpdate(FixedUpdate):
    """
    The same, captured as a CUDA graph and replayed.

    A graph has settings, learning rates among them, as constants, so it is made anew in each call of ``train``. The first
    update is one as any other, in which libraries and optimizers make what they need.

    :param gradient_step: of all networks; it waits for no value that it computes
    :param device: of the networks, a GPU
    :param optimizers: of what learns
    """

    def __init__(self, gradient_step: GradientStep, device: th.device, optimizers: Sequence[th.optim.Optimizer]) -> None:
        super().__init__(gradient_step, device)
        self._optimizers = optimizers
        self._is_first = True
        self._replays: dict[bool, Callable[[], None]] = {}
        self._outcomes: dict[bool, tuple[th.Tensor, list[str], th.Tensor]] = {}

    def _run(self, update_target: bool) -> Outcome:
        if self._is_first:
            self._is_first = False
            return aside(partial(super()._run, update_target), self._device)
        if update_target not in self._replays:
            with capturable(self._optimizers):
                try:
                    self._replays[update_target] = capture(partial(self._record, update_target), self._device)
                except RuntimeError as error:
                    raise RuntimeError(
                        f"An update cannot be captured as a CUDA graph ({last_line(error)}): give cuda_graph=False."
                    ) from error
        self._replays[update_target]()
        # The next replay overwrites it
        mean, names, log = self._outcomes[update_target]
        return mean.clone(), dict(zip(names, log.clone(), strict=True))

    def _record(self, update_target: bool) -> None:
        mean, log = super()._run(update_target)
        self._outcomes[update_target] = mean, list(log), th.stack([*log.values()])


@cache
def side_stream(device: th.device) -> th.cuda.Stream:
    """
    :param device: a GPU
    :return: the same each time: torch keeps memory for the matrix products of each stream
    """
    return th.cuda.Stream(device)


def capture(function: Callable[[], None], device: th.device) -> Callable[[], None]:
    """
    :param function: what it asks of the GPU is recorded, and not done
    :param device: the GPU
    :return: does it
    """
    graph = th.cuda.CUDAGraph()
    with th.cuda.device(device), th.cuda.graph(graph, stream=side_stream(device)):
        function()
    return graph.replay


def aside(function: Callable[[], Outcome], device: th.device) -> Outcome:
    """
    :param function: done beside the current stream, as torch asks of what comes before a capture
    :param device: the GPU
    :return: what it returns
    """
    stream = side_stream(device)
    stream.wait_stream(th.cuda.current_stream(device))
    with th.cuda.stream(stream):
        result = function()
    th.cuda.current_stream(device).wait_stream(stream)
    return result


def can_be_captured(optimizers: Sequence[th.optim.Optimizer]) -> bool:
    """
    :param optimizers: of what learns
    :return: whether they are known to count no steps on the CPU, as Adam and AdamW
    """
    return all("capturable" in group for optimizer in optimizers for group in optimizer.param_groups)


@contextmanager
def capturable(optimizers: Sequence[th.optim.Optimizer]) -> Iterator[None]:
    """
    Within, optimizers can be captured: all of their state, as Adam's count of steps, is where the parameters are. Files say
    nothing of it, for they may be read where there is no GPU.

    :param optimizers: have made a step before
    :raises ValueError: for one that counts steps on the CPU
    """
    for optimizer in optimizers:
        for parameter, state in optimizer.state.items():
            if "step" in state and any("capturable" not in group for group in optimizer.param_groups):
                raise ValueError(
                    f"{type(optimizer).__name__} cannot be captured as a CUDA graph: take Adam or AdamW as optimizer_class, "
                    "or cuda_graph=False."
                )
            state.update((k, v.to(parameter.device)) for k, v in state.items() if isinstance(v, th.Tensor))
    groups = [group for optimizer in optimizers for group in optimizer.param_groups if "capturable" in group]
    before = [group["capturable"] for group in groups]
    for group in groups:
        group["capturable"] = True
    try:
        yield
    finally:
        for group, value in zip(groups, before, strict=True):
            group["capturable"] = value
