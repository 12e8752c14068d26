"""Where the runs of experiments are: a folder, or an object store, that all nodes see."""

import re
from pathlib import Path

from sb3_htr.experiments.storage.folder import SharedFolder
from sb3_htr.experiments.storage.objects import ObjectStore

Storage = SharedFolder | ObjectStore


def storage_at(runs: str | Path) -> Storage:
    """
    :param runs: a folder, or a URL of fsspec, as ``s3://bucket/runs``
    :return: where the runs are
    :raises ValueError: if there can be none
    """
    if "://" in str(runs):
        return ObjectStore(str(runs))
    # Windows has drives of one letter
    if re.match(r"[A-Za-z][\w.+-]+:/", str(runs)):
        raise ValueError(
            f"The folder of the runs is {str(runs)!r}: give a URL as text, with two slashes, as s3://bucket/runs."
        )
    return SharedFolder(Path(runs))
