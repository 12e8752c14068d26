"""Runs in a folder that all nodes see under one name, with the locks of its file system."""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import Timeout

from sb3_htr.common.checkpoint import n_steps_done
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.runner import lock_of, run_cell


class SharedFolder:
    """
    A :class:`sb3_htr.experiments.storage.Storage`.

    :param runs: folder of all experiments' runs
    """

    def __init__(self, runs: Path) -> None:
        # As all nodes name it: where a link leads may be known here alone
        self.runs = Path(os.path.abspath(runs))
        self._listed: dict[Path, set[str]] = {}

    def __str__(self) -> str:
        return str(self.runs)

    def prepare(self) -> None:
        """Make it."""
        self.runs.mkdir(parents=True, exist_ok=True)

    def look(self, cells: Sequence[Cell]) -> None:
        """A listing is fresh where answers about single files may be remembered, as by NFS."""
        for folder in {cell.result(self.runs).parent for cell in cells}:
            try:
                self._listed[folder] = set(os.listdir(folder))
            except FileNotFoundError:
                self._listed[folder] = set()
            except OSError as error:  # a server that is out of reach for a while: what was seen before holds
                print(f"{folder} could not be read: {error}", file=sys.stderr, flush=True)

    def is_finished(self, cell: Cell) -> bool:
        """Whether it has a result."""
        result = cell.result(self.runs)
        return result.name in self._listed.get(result.parent, ())

    def is_claimed(self, cell: Cell) -> bool:
        """Whether a process has its lock."""
        if not cell.run_folder(self.runs).exists():
            return False
        try:
            lock_of(cell, self.runs).acquire(timeout=0).lock.release()
        except (Timeout, OSError):  # what cannot be asked cannot be begun either
            return True
        return False

    def n_steps(self, cell: Cell) -> int:
        """Env steps before its latest checkpoint."""
        with suppress(OSError):
            return max((n_steps_done(run) for run in cell.run_folder(self.runs).glob("*/*")), default=0)
        return 0

    def call(self, cell: Cell) -> tuple[Any, ...]:
        """See :func:`sb3_htr.experiments.runner.run_cell`."""
        return run_cell, cell, self.runs

    def fetch_results(self, cells: Sequence[Cell]) -> Path:
        """They are there."""
        return self.runs

    def send_results(self, cells: Sequence[Cell]) -> None:
        """They are there."""
