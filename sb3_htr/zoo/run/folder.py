"""The folder of a run: it has one owner."""

import errno
import os
from pathlib import Path
from typing import Any

from filelock import FileLock, SoftFileLock, Timeout

LOCK = ".lock"


def run_number(run: Path, stem: str) -> int:
    """
    :param run: folder
    :param stem: env of the run, in names of files
    :return: of rl_zoo3's ``<stem>_<number>``, or with a unique id behind it; 0 for another folder
    """
    number = run.name.removeprefix(f"{stem}_").split("_")[0]
    return int(number) if number.isdecimal() else 0


def claim(log_folder: str, stem: str, suffix: str) -> Path:
    """
    :param log_folder: of all runs of a method
    :param stem: env of the run, in names of files
    :param suffix: behind the number of the run
    :return: a new folder, ``<stem>_<number><suffix>``, that no other process has, however many begin at once
    """
    try:
        names = os.listdir(log_folder)
    except FileNotFoundError:  # or another process, whose training was refused, has just removed it
        names = []
    number = max((run_number(Path(name), stem) for name in names if name.startswith(stem)), default=0)
    while True:
        number += 1
        folder = Path(log_folder, f"{stem}_{number}{suffix}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder


class SystemLock(FileLock):
    """A file lock that the operating system takes back when its process ends, however it does."""

    def acquire(self, *args: Any, **kwargs: Any) -> Any:
        """
        :param args: of filelock's
        :param kwargs: likewise
        :return: what filelock's returns
        :raises OSError: if the file system has no locks. filelock then becomes one that leaves a marker in a file, which would
            outlive a process that is killed on another node
        """
        acquired = super().acquire(*args, **kwargs)
        if isinstance(self, SoftFileLock):
            self.release()
            raise OSError(errno.ENOSYS, "The file system has no locks: mount it with flock", self.lock_file)
        return acquired


def lock(folder: Path) -> SystemLock:
    """
    :param folder: of a run
    :return: to be kept as long as the run is trained; the end of the process releases it, too
    :raises ValueError: if another process trains it
    """
    owner = SystemLock(folder / LOCK)
    try:
        owner.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"{folder} is being trained by another process: wait for its end, or begin a new run.") from None
    return owner
