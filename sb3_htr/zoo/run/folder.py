"""The folder of a run: it has one owner."""

import os
from pathlib import Path

from filelock import FileLock, Timeout
from rl_zoo3.utils import get_latest_run_id

LOCK = ".lock"


def claim(log_folder: str, env_id: str, suffix: str) -> Path:
    """
    :param log_folder: of all runs of a method
    :param env_id: env of the run
    :param suffix: behind the number of the run
    :return: a new folder, ``<env_id>_<number><suffix>``, that no other process has, however many begin at once
    """
    number = get_latest_run_id(log_folder, env_id)
    while True:
        number += 1
        folder = Path(log_folder, f"{env_id}_{number}{suffix}")
        try:
            os.makedirs(folder)
        except FileExistsError:
            continue
        return folder


def lock(folder: Path) -> FileLock:
    """
    :param folder: of a run
    :return: to be kept as long as the run is trained; the end of the process releases it, too
    :raises ValueError: if another process trains it
    """
    owner = FileLock(folder / LOCK)
    try:
        owner.acquire(timeout=0)
    except Timeout:
        raise ValueError(f"{folder} is being trained by another process: wait for its end, or begin a new run.") from None
    return owner
