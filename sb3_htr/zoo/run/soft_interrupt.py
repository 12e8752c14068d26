"""Ctrl-C during a training, and what a scheduler sends before it kills."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from sb3_htr.common.checkpoint_callback import CheckpointCallback


@contextlib.contextmanager
def soft_interrupt(checkpointing: CheckpointCallback | None) -> Iterator[None]:
    """Let the first Ctrl-C or SIGTERM end the training before the next rollout, with a checkpoint, the second one at once."""
    if checkpointing is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    before = {signal_: signal.getsignal(signal_) for signal_ in (signal.SIGINT, signal.SIGTERM)}

    def stop(signum: int, frame: Any) -> None:
        # One of the other kind may be the same wish, as a scheduler tells all processes, and one of them tells others
        handler = before[signal.Signals(signum)]
        # Shells have the background commands of a script ignore Ctrl-C
        signal.signal(signum, signal.default_int_handler if handler is signal.SIG_IGN else handler)
        print("Stopping after this rollout, with a checkpoint. Press Ctrl-C again to stop at once.")
        checkpointing.stop()

    try:
        for signal_ in before:
            signal.signal(signal_, stop)
        yield
    finally:
        for signal_, handler in before.items():
            signal.signal(signal_, handler)


@contextlib.contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM, which schedulers send before they kill, be as Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
