"""Ctrl-C during a training."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from sb3_htr.common.checkpoint_callback import CheckpointCallback


@contextlib.contextmanager
def soft_interrupt(checkpointing: CheckpointCallback | None) -> Iterator[None]:
    """Let the first Ctrl-C end the training before the next rollout, with a checkpoint, and the second one at once."""
    if checkpointing is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(signum: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        print("Stopping after this rollout, with a checkpoint. Press Ctrl-C again to stop at once.")
        checkpointing.stop()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
