"""Runs in a storage of fsspec, as S3, GCS or Azure: a node works on a copy of a cell's folder, and sends what it becomes."""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from threading import Event, Thread
from types import TracebackType
from typing import Any

from fsspec.core import url_to_fs

from sb3_htr.common.errors import last_line
from sb3_htr.common.resume import CHECKPOINTS, n_steps_at
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.runner import run_cell
from sb3_htr.experiments.storage.claim import RENEW, Claim, Watch
from sb3_htr.experiments.storage.working_copy import WorkingCopy

# Seconds between two times that a node sends what is new
SEND = 60.0
CLAIM = ".claim"


class ObjectStorage:
    """
    A :class:`sb3_htr.experiments.storage.Storage`. It has what a folder would have, but for what a node wrote since it last
    sent. Of two processes that begin a cell, one gets it; one that is taken for dead and comes back sends nothing any more.

    :param url: of fsspec
    :param void: of cells, by label, the claims whose owners are gone
    :raises ValueError: if it cannot be opened here
    """

    def __init__(self, url: str, void: Mapping[str, str] | None = None) -> None:
        self.url = url.rstrip("/")
        try:
            self.files, root = url_to_fs(self.url)
        except (ValueError, ImportError) as error:
            raise ValueError(f"{url} cannot be opened ({last_line(error)}): give a folder, or a URL of fsspec.") from None
        self.root = root.rstrip("/")
        self._void = dict(void or {})
        self._watch = Watch()
        self._objects: dict[str, dict[str, Any]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return ObjectStorage, (self.url, self._void)

    def __str__(self) -> str:
        return self.url

    def prepare(self) -> None:
        """
        Make it, and write to it.

        :raises OSError: if that is not possible, for whatever reason
        """
        try:
            self.files.makedirs(self.root, exist_ok=True)
            self.files.pipe_file(f"{self.root}/.writable", b"")
        except Exception as error:  # each storage has its own
            raise OSError(f"{self.url} cannot be written to: {last_line(error)}") from None

    def look(self, cells: Sequence[Cell]) -> None:
        """One listing for each experiment."""
        self._objects = {}
        # Others write, too
        self.files.invalidate_cache()
        for experiment in {name for cell in cells for name in (cell.experiment, cell.models_of)}:
            for path, info in self.files.find(f"{self.root}/{experiment}", detail=True).items():
                folder = PurePosixPath(path.removeprefix(f"{self.root}/")).parts[:2]
                self._objects.setdefault("/".join(folder), {})[path] = info

    def is_finished(self, cell: Cell) -> bool:
        """Whether it has a result."""
        return _result(cell) in self._objects

    def is_claimed(self, cell: Cell) -> bool:
        """Whether the newest claim is renewed."""
        claims = {path: info for path, info in self._objects_of(cell).items() if f"/{CLAIM}/" in path}
        if not claims:
            return False
        newest = max(claims)
        if self._watch.is_alive(newest, claims[newest]):
            return True
        self._void[cell.label] = newest
        return False

    def n_steps(self, cell: Cell) -> int:
        """Env steps before its latest checkpoint."""
        folders = (PurePosixPath(path).parent for path in self._objects_of(cell))
        return max((n_steps_at(folder) for folder in folders if folder.parent.name == CHECKPOINTS), default=0)

    def run(self, cell: Cell) -> bool:
        """:func:`sb3_htr.experiments.runner.run_cell` on a copy."""
        claim = Claim(self.files, f"{self.root}/{_folder(cell)}/{CLAIM}")
        if not claim.take(self._void.get(cell.label)):
            return False
        try:
            with _Every(RENEW, claim.renew), TemporaryDirectory(prefix="sb3-htr-") as runs:
                return self._run(cell, claim, Path(runs))
        finally:
            claim.release()

    def _run(self, cell: Cell, claim: Claim, here: Path) -> bool:
        copy = WorkingCopy(self.files, f"{self.root}/{_folder(cell)}", cell.run_folder(here))
        copy.fetch()
        if is_there := self.files.exists(f"{self.root}/{_result(cell)}"):
            self._fetch([cell], here)
        try:
            with _Every(SEND, lambda: copy.send() if claim.is_ours() else None):
                has_result = run_cell(cell, here)
        finally:
            # Whoever took it over goes on from what was sent before
            if is_ours := claim.is_ours():
                copy.send()
        if is_ours and not is_there:
            self._send(cell, here)
        return is_ours and has_result

    @cached_property
    def _here(self) -> TemporaryDirectory[str]:
        return TemporaryDirectory(prefix="sb3-htr-results-")

    def fetch_results(self, cells: Sequence[Cell]) -> Path:
        """
        A folder that is gone with this process.

        :raises OSError: if the storage cannot be read
        """
        here = Path(self._here.name)
        try:
            self.look(cells)
            self._fetch([cell for cell in cells if self.is_finished(cell) and not cell.result(here).exists()], here)
        except Exception as error:  # each storage has its own
            raise OSError(f"{self.url} cannot be read: {last_line(error)}") from None
        return here

    def send_results(self, cells: Sequence[Cell]) -> None:
        """Those that are not there."""
        here = Path(self._here.name)
        for cell in cells:
            if cell.result(here).exists() and not self.is_finished(cell):
                self._send(cell, here)

    def _objects_of(self, cell: Cell) -> dict[str, Any]:
        return self._objects.get(_folder(cell), {})

    def _fetch(self, cells: Sequence[Cell], here: Path) -> None:
        for cell in cells:
            cell.result(here).parent.mkdir(parents=True, exist_ok=True)
        # Many at once, where the storage can
        self.files.get([f"{self.root}/{_result(cell)}" for cell in cells], [str(cell.result(here)) for cell in cells])

    def _send(self, cell: Cell, here: Path) -> None:
        """Whole, where others look for it."""
        path = f"{self.root}/{_result(cell)}"
        self.files.makedirs(path.rpartition("/")[0], exist_ok=True)
        self.files.put_file(str(cell.result(here)), f"{path}.part")
        self.files.mv(f"{path}.part", path)


class _Every(Thread):
    """
    Calls a function again and again, beside what is done with it. What fails is tried again the next time.

    :param seconds: between two calls
    :param call: to be called
    """

    def __init__(self, seconds: float, call: Callable[[], None]) -> None:
        super().__init__(daemon=True)
        self.seconds, self.call, self._ended = seconds, call, Event()

    def run(self) -> None:
        while not self._ended.wait(self.seconds):
            try:
                self.call()
            except Exception as error:
                print(f"The storage was not reached, which is tried again: {last_line(error)}", file=sys.stderr)

    def __enter__(self) -> "_Every":
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self.join()


def _folder(cell: Cell) -> str:
    return cell.run_folder(Path()).as_posix()


def _result(cell: Cell) -> str:
    return cell.result(Path()).as_posix()
