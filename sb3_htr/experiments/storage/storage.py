"""Where the runs of experiments are: a folder, or an object store, that all nodes see."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.storage.folder import SharedFolder
from sb3_htr.experiments.storage.objects import ObjectStore


class Storage(Protocol):
    """What a driver asks, and a command. What is said of a cell is as of the latest look, or newer."""

    def prepare(self) -> None:
        """
        Before anything is run.

        :raises OSError: if nothing can be written there
        """

    def look(self, cells: Sequence[Cell]) -> None:
        """
        :param cells: that will be asked about
        """

    def is_finished(self, cell: Cell) -> bool:
        """
        :param cell: of an experiment
        :return: whether it has a result
        """

    def is_claimed(self, cell: Cell) -> bool:
        """
        :param cell: of an experiment
        :return: whether a process runs it
        """

    def n_steps(self, cell: Cell) -> int:
        """
        :param cell: of an experiment
        :return: env steps before its latest checkpoint
        """

    def call(self, cell: Cell) -> tuple[Any, ...]:
        """
        :param cell: of an experiment
        :return: what an executor is to call, a function and its arguments. It says whether there is a result; if not, another
            process runs the cell
        """

    def fetch_results(self, cells: Sequence[Cell]) -> Path:
        """
        :param cells: of experiments
        :return: folder of this machine that has the results of those that are finished
        :raises OSError: if they cannot be read
        """

    def send_results(self, cells: Sequence[Cell]) -> None:
        """
        :param cells: of which the folder of :meth:`fetch_results` may have results that were not there
        :raises OSError: if they cannot be written
        """


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
