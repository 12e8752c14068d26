"""Where a process of this machine works on its copy."""

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import gettempdir, mkdtemp

from filelock import Timeout

from sb3_htr.zoo.run.folder import LOCK, SystemLock

PREFIX = "copy-"


def _own_place() -> Path:
    """Others can write where temporary folders are, and what they put there may be a link to a file of this user."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    place = Path(gettempdir(), f"sb3-htr-{user}")
    with suppress(FileExistsError):
        place.mkdir(mode=0o700)
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user:
        raise OSError(f"{place} is not this user's: set TMPDIR to a folder of your own.")
    return place


@contextmanager
def node_folder() -> Iterator[Path]:
    """
    A temporary folder, removed at the end. Those that killed processes of the same user have left are removed before.

    :return: context manager that gives the path of the folder
    :raises OSError: if another user has the place of such folders
    """
    place = _own_place()
    with SystemLock(place / LOCK).acquire():  # a new folder is not locked yet
        for left in place.glob(f"{PREFIX}*"):
            with suppress(Timeout, OSError), SystemLock(left / LOCK).acquire(timeout=0):
                shutil.rmtree(left)
        folder = Path(mkdtemp(prefix=PREFIX, dir=place))
        owner = SystemLock(folder / LOCK)
        owner.acquire(timeout=0)
    try:
        yield folder
    finally:
        owner.release()
        shutil.rmtree(folder, ignore_errors=True)
