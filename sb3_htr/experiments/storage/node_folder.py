"""Where a process of this machine works on its copy."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import gettempdir, mkdtemp

from filelock import Timeout

from sb3_htr.zoo.run.folder import LOCK, SystemLock

PREFIX = "sb3-htr-copy-"


@contextmanager
def node_folder() -> Iterator[Path]:
    """
    A temporary folder, removed at the end. Those that killed processes of the same user have left are removed before.

    :return: context manager that gives the path of the folder
    """
    user = Path(gettempdir(), f"sb3-htr-{os.getuid() if hasattr(os, 'getuid') else 0}{LOCK}")
    with SystemLock(user).acquire():  # a new folder is not locked yet
        for left in Path(gettempdir()).glob(f"{PREFIX}*"):
            with suppress(Timeout, OSError), SystemLock(left / LOCK).acquire(timeout=0):
                shutil.rmtree(left)
        folder = Path(mkdtemp(prefix=PREFIX))
        owner = SystemLock(folder / LOCK)
        owner.acquire(timeout=0)
    try:
        yield folder
    finally:
        owner.release()
        shutil.rmtree(folder, ignore_errors=True)
