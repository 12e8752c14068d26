"""The folder of a run: it has one owner."""

import os
from pathlib import Path

from filelock import FileLock, Timeout

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
    os.makedirs(log_folder, exist_ok=True)
    number = max((run_number(path, stem) for path in Path(log_folder).iterdir() if path.name.startswith(stem)), default=0)
    while True:
        number += 1
        folder = Path(log_folder, f"{stem}_{number}{suffix}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder


def lock(folder: Path) -> FileLock:
    """
    :param folder: of a run
    :return: to be kept as long as the run is trained; the end of the process releases it, too
    :raises ValueError: if another process trains it
    """
    # Without locks of the system, a marker would outlive a killed process
    owner = FileLock(folder / LOCK, fallback_to_soft=False)
    try:
        owner.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"{folder} is being trained by another process: wait for its end, or begin a new run.") from None
    return owner
