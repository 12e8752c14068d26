"""Runs in a folder that all nodes see under one name, with the locks of its file system."""

import errno
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import Timeout

from sb3_htr.common.checkpoint import n_steps_done
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.runner import lock_of, run_cell

# What a server says, or its client, that is out of reach for a while
AWAY = (errno.ESTALE, errno.EIO, errno.ETIMEDOUT, errno.EHOSTDOWN)


class SharedFolder:
    """
    What a driver asks, and a command, of a folder. What is said of a cell is as of the latest look, or newer.

    :param runs: folder of all experiments' runs
    """

    def __init__(self, runs: Path) -> None:
        # As all nodes name it: where a link leads may be known here alone
        self.runs = Path(os.path.abspath(runs))
        self._listed: dict[Path, set[str]] = {}
        self._n_steps: dict[str, int] = {}
        # Folders that do not answer
        self._away: set[Path] = set()

    def __str__(self) -> str:
        return str(self.runs)

    def prepare(self) -> None:
        """Make it."""
        self.runs.mkdir(parents=True, exist_ok=True)

    def look(self, cells: Sequence[Cell]) -> None:
        """
        A listing is fresh where answers about single files may be remembered, as by NFS.

        :param cells: that will be asked about
        """
        for folder in {cell.result(self.runs).parent for cell in cells}:
            with self._patient(folder):
                self._listed[folder] = set(os.listdir(folder)) if folder.exists() else set()

    @contextmanager
    def _patient(self, folder: Path) -> Iterator[None]:
        """What was seen before holds where a server does not answer, until it does."""
        try:
            yield
        except OSError as error:
            if error.errno not in AWAY:
                raise
            print(f"{folder} does not answer: {error}", file=sys.stderr, flush=True)
            self._away.add(folder)
        else:
            self._away.discard(folder)

    def is_finished(self, cell: Cell) -> bool:
        """Whether it has a result."""
        result = cell.result(self.runs)
        return result.name in self._listed.get(result.parent, ())

    def is_claimed(self, cell: Cell) -> bool:
        """Whether a process has its lock, or nobody can tell."""
        folder = cell.result(self.runs).parent
        if folder in self._away:
            return True
        with self._patient(folder):
            if not cell.run_folder(self.runs).exists():
                return False
            try:
                lock_of(cell, self.runs).acquire(timeout=0).lock.release()
            except Timeout:
                return True
            except PermissionError as error:
                raise PermissionError(
                    f"{error}: the lock of this cell is another user's alone. Share the folder in a common group, with umask "
                    "002 where the cells run, or give --runs of your own."
                ) from None
            return False
        return True

    def n_steps(self, cell: Cell) -> int:
        """Env steps before its latest checkpoint."""
        with self._patient(cell.result(self.runs).parent):
            runs = cell.run_folder(self.runs).glob("*/*")
            self._n_steps[cell.label] = max((n_steps_done(run) for run in runs), default=0)
        return self._n_steps.get(cell.label, 0)

    def call(self, cell: Cell) -> tuple[Any, ...]:
        """
        :param cell: of an experiment
        :return: what an executor is to call, a function and its arguments. It says whether there is a result; if not, another
            process runs the cell
        """
        return run_cell, cell, self.runs

    def fetch_results(self, cells: Sequence[Cell]) -> Path:
        """
        :param cells: of experiments
        :return: folder of this machine that has the results of those that are finished
        """
        return self.runs

    def send_results(self, cells: Sequence[Cell]) -> None:
        """:param cells: of which that folder may have results that were not there, which a folder has at once"""
