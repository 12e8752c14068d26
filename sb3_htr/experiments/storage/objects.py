"""Runs in an object store, by fsspec: a node works on a copy of a cell's folder, and sends what it becomes."""

import re
import signal
import sys
import time
from _thread import interrupt_main
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from threading import Event, Thread, current_thread, main_thread
from types import TracebackType
from typing import Any, TypeVar

from fsspec import AbstractFileSystem
from fsspec.core import url_to_fs

from sb3_htr.common.checkpoint import CHECKPOINTS, MANIFEST, n_steps_at
from sb3_htr.common.errors import last_line
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.runner import run_cell
from sb3_htr.experiments.storage.claim import RENEW, Claim, Objects, Watch, claims_among
from sb3_htr.experiments.storage.node_folder import node_folder
from sb3_htr.experiments.storage.working_copy import WorkingCopy

T = TypeVar("T")
# Seconds between two times that a node sends what is new
SEND = 60.0
# Seconds to wait between several tries of what must not be lost
PATIENCE = (2.0, 8.0, 30.0, 60.0)
# So many cells are looked at one by one, of more whole experiments
FEW = 8
CLAIMS = ".claims"


class ObjectStore:
    """
    The same as :class:`sb3_htr.experiments.storage.folder.SharedFolder`, of an object store.

    :param url: of fsspec
    :raises ValueError: if it cannot be opened here
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.files, self.root = _opened(url)
        self._watch = Watch()
        self._void: dict[str, bytes] = {}
        self._objects: dict[str, Objects] = {}

    def __str__(self) -> str:
        return _shown(self.url)

    def prepare(self) -> None:
        """
        Write to it.

        :raises OSError: if that is not possible, for whatever reason
        """
        try:
            self.files.pipe_file(f"{self.root}/.writable", b"")
        except Exception as error:  # each store has its own
            raise OSError(f"{self} cannot be written to: {last_line(error)}") from None

    def look(self, cells: Sequence[Cell]) -> None:
        """If the store is out of reach, what was seen before holds until the next look."""
        _unless_it_fails(lambda: _patiently(lambda: self._look(cells)))

    def _look(self, cells: Sequence[Cell]) -> None:
        folders = [*map(_folder, cells)]
        if len(cells) > FEW:
            folders = sorted({name for cell in cells for name in (cell.experiment, cell.models_of)})
        objects: Objects = {}
        with self._watched():
            for folder in folders:
                objects |= self.files.find(f"{self.root}/{folder}", detail=True)
            if len(cells) <= FEW:
                # Beside the folders
                objects |= {path: {} for path in map(self._path, cells) if self.files.exists(path)}
        seen: dict[str, Objects] = {name: {} for cell in cells for name in (_folder(cell), _result(cell))}
        for path, info in objects.items():
            name = "/".join(PurePosixPath(path.removeprefix(f"{self.root}/")).parts[:2])
            seen.setdefault(name, {})[path] = info
        self._objects |= seen

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """For owners that are silent, only time counts in which the store is within reach from here."""
        # Others write, too
        self.files.invalidate_cache()
        try:
            yield
        except Exception:
            self._watch = Watch()
            raise

    def is_finished(self, cell: Cell) -> bool:
        """Whether it has a result."""
        return bool(self._objects.get(_result(cell)))

    def is_claimed(self, cell: Cell) -> bool:
        """Whether the newest claim is renewed."""
        claims = claims_among({path: info for path, info in self._of(cell).items() if f"/{CLAIMS}/" in path})
        if not claims:
            return False
        newest = max(claims)
        if self._watch.is_alive(newest, claims[newest]):
            return True
        try:
            with self._watched():
                content = self.files.cat_file(newest)
                # It may have been renewed between that listing and this content
                claims = claims_among(self.files.find(newest.rpartition("/")[0], detail=True))
        except Exception as error:  # each store has its own
            _report(error)
            return True
        if max(claims, default="") != newest or self._watch.is_alive(newest, claims[newest]):
            return True
        self._void[cell.label] = content
        return False

    def n_steps(self, cell: Cell) -> int:
        """Env steps before its latest checkpoint."""
        paths = map(PurePosixPath, self._of(cell))
        whole = (path.parent for path in paths if path.name == MANIFEST and path.parent.parent.name == CHECKPOINTS)
        return max(map(n_steps_at, whole), default=0)

    def call(self, cell: Cell) -> tuple[Any, ...]:
        """See :func:`run_on_copy`."""
        return run_on_copy, cell, self.url, self._void.get(cell.label)

    @cached_property
    def _here(self) -> TemporaryDirectory[str]:
        return TemporaryDirectory(prefix="sb3-htr-results-")

    def fetch_results(self, cells: Sequence[Cell]) -> Path:
        """
        A folder that is gone with this process.

        :raises OSError: if the store cannot be read
        """
        here = Path(self._here.name)
        try:
            _patiently(lambda: self._look(cells))
            missing = [cell for cell in cells if self.is_finished(cell) and not cell.result(here).exists()]
            for cell in missing:
                cell.result(here).parent.mkdir(parents=True, exist_ok=True)
            # Many at once, where the store can
            paths = [self._path(cell) for cell in missing], [str(cell.result(here)) for cell in missing]
            _patiently(lambda: self.files.get(*paths))
        except Exception as error:  # each store has its own
            raise OSError(f"{self} cannot be read: {last_line(error)}") from None
        return here

    def send_results(self, cells: Sequence[Cell]) -> None:
        """
        Those that are not there.

        :raises OSError: if the store cannot be written to
        """
        here = Path(self._here.name)
        try:
            for cell in cells:
                if cell.result(here).exists() and not self.is_finished(cell):
                    self.files.put_file(str(cell.result(here)), self._path(cell))
        except Exception as error:  # each store has its own
            raise OSError(f"{self} cannot be written to: {last_line(error)}") from None

    def _of(self, cell: Cell) -> Objects:
        return self._objects.get(_folder(cell), {})

    def _path(self, cell: Cell) -> str:
        return f"{self.root}/{_result(cell)}"


def run_on_copy(cell: Cell, url: str, void: bytes | None = None) -> bool:
    """
    :func:`sb3_htr.experiments.runner.run_cell` on a copy of what the store has of the cell.

    :param cell: what to run
    :param url: of fsspec
    :param void: content of a claim on it whose owner is gone
    :return: whether there is a result; if not, another process runs the cell
    """
    files, root = _opened(url)
    there, result = f"{root}/{_folder(cell)}", f"{root}/{_result(cell)}"
    claim, lost = Claim(files, f"{there}/{CLAIMS}"), Event()
    in_main_thread = current_thread() is main_thread()

    def renew() -> None:
        if not claim.renew() and not lost.is_set():
            print(f"{cell.label} was taken over by another process: this one stops.", file=sys.stderr, flush=True)
            lost.set()
            if in_main_thread:
                # A script's background commands ignore SIGINT, and the command takes SIGTERM for it
                interrupt_main(signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT)

    try:
        if not _patiently(lambda: claim.take(void)):
            return False
        with _Every(RENEW, renew), node_folder() as runs:
            if _patiently(lambda: files.exists(result)):
                # Another process was sooner
                cell.result(runs).parent.mkdir(parents=True, exist_ok=True)
                _patiently(lambda: files.get_file(result, str(cell.result(runs))))
                return run_cell(cell, runs)
            copy = WorkingCopy(files, there, cell.run_folder(runs), claim.is_ours)
            _patiently(copy.fetch)
            try:
                with _Every(SEND, copy.send):
                    has_result = run_cell(cell, runs)
            except BaseException:
                # Where it is tried again, it goes on from here
                _unless_it_fails(copy.send)
                raise
            _patiently(copy.send)
            if not _patiently(claim.is_ours):
                # Taken for dead: whoever took it over goes on from what was sent before
                return False
            _patiently(lambda: files.put_file(str(cell.result(runs)), result))
            # Its evaluations were kept until now
            _unless_it_fails(copy.prune)
            return has_result
    except KeyboardInterrupt:
        if lost.is_set():
            return False
        raise
    finally:
        _unless_it_fails(claim.release)


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
            _unless_it_fails(self.call)

    def __enter__(self) -> None:
        self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        self.join()


def _unless_it_fails(call: Callable[[], None]) -> None:
    try:
        call()
    except Exception as error:  # each store has its own
        _report(error)


def _patiently(call: Callable[[], T]) -> T:
    for seconds in PATIENCE:
        try:
            return call()
        except Exception as error:  # each store has its own
            _report(error)
            time.sleep(seconds)
    return call()


def _report(error: Exception) -> None:
    print(f"The store was not reached: {last_line(error)}", file=sys.stderr, flush=True)


def _opened(url: str) -> tuple[AbstractFileSystem, str]:
    try:
        files, root = url_to_fs(url)
    except (ValueError, ImportError, OSError) as error:
        raise ValueError(f"{_shown(url)} cannot be opened ({last_line(error)}): give a folder, or a URL of fsspec.") from None
    if not root.strip("/"):
        raise ValueError(f"{_shown(url)} names no place in a store: give one, as in s3://bucket/runs.")
    return files, root.rstrip("/")


def _shown(url: str) -> str:
    """Without a password, as others read what is printed."""
    return re.sub(r"(?<=://)([^/:@]*):[^/]*@", r"\1:***@", url)


def _folder(cell: Cell) -> str:
    return cell.run_folder(Path()).as_posix()


def _result(cell: Cell) -> str:
    return cell.result(Path()).as_posix()
