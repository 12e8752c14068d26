"""Files that run code when they are unpickled."""

import io
import pickle
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import torch as th


class Bomb:
    """A pickle that runs code: it makes a file."""

    def __init__(self, fuse: Path) -> None:
        self.fuse = fuse

    def __reduce__(self) -> Any:
        return Path.touch, (self.fuse,)


def bombs(fuse: Path) -> list[bytes]:
    """As SB3's buffers, as torch saves, and hidden in a state dict."""
    nested = io.BytesIO()
    th.save({"replay": Bomb(fuse), "task_bank": {}}, nested)
    alone = io.BytesIO()
    th.save(Bomb(fuse), alone)
    return [pickle.dumps(Bomb(fuse)), cloudpickle.dumps({"replay": Bomb(fuse)}), nested.getvalue(), alone.getvalue()]
