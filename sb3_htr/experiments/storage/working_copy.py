"""A folder of a store on the disk of the node that works on it."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory

from fsspec import AbstractFileSystem

from sb3_htr.common.checkpoint import CHECKPOINTS, MANIFEST, checkpoints

# Version of what is there, and was not fetched
HALF = 0, 0


class WorkingCopy:
    """
    :param files: of the store
    :param there: folder in it
    :param here: folder of this machine
    :param is_ours: whether the folder may be written to, asked before each file
    """

    def __init__(self, files: AbstractFileSystem, there: str, here: Path, is_ours: Callable[[], bool]) -> None:
        self.files, self.there, self.here, self.is_ours = files, there, here, is_ours
        self._sent: dict[str, tuple[int, int]] = {}

    def fetch(self) -> None:
        """What the store has, but for hidden files, names that lead elsewhere, and checkpoints that did not arrive whole."""
        names = {path.removeprefix(f"{self.there}/") for path in self.files.find(self.there)}
        for name in names:
            path = PurePosixPath(name)
            if _is_of_checkpoint(name) and (path.parent / MANIFEST).as_posix() not in names:
                self._sent[name] = HALF
            elif not _is_hidden(name) and _is_inside(name):
                (self.here / name).parent.mkdir(parents=True, exist_ok=True)
                self.files.get_file(f"{self.there}/{name}", str(self.here / name))
                self._sent[name] = _version(self.here / name)

    def send(self) -> None:
        """
        What changed, so that the store has at any time what a killed run leaves: a checkpoint, and all else as new as it, or
        newer; an older checkpoint until the next one is whole.
        """
        with self._latest_checkpoints() as of_checkpoints:
            for path in [Path(inside, name) for inside, _, names in os.walk(self.here) for name in names]:
                name = path.relative_to(self.here).as_posix()
                if not _is_hidden(name) and not _is_of_checkpoint(name):
                    try:
                        self._put(name, path)
                    except FileNotFoundError:
                        # Removed since it was listed; or the store says so
                        if path.exists():
                            raise
            for name, path in of_checkpoints.items():
                self._put(name, path)
            if of_checkpoints:
                self._remove([name for name in self._sent if _is_of_checkpoint(name) and name not in of_checkpoints])

    def prune(self) -> None:
        """Remove there all else that was sent and is here no more."""
        self._remove([name for name in self._sent if not (self.here / name).exists()])

    @contextmanager
    def _latest_checkpoints(self) -> Iterator[dict[str, Path]]:
        """
        Files of the latest one of each run, by their names there, with the manifest at the end. Training may remove it in the
        meantime.
        """
        self.here.mkdir(parents=True, exist_ok=True)
        # Beside it: who lists it must not see a folder come and go
        with TemporaryDirectory(prefix=".sending-", dir=self.here.parent) as folder:
            held: dict[str, Path] = {}
            # Unlike rglob, this takes it calmly that folders go
            runs = [Path(run) for run, folders, _ in os.walk(self.here) if CHECKPOINTS in folders]
            for checkpoint in [latest for run in runs for latest in checkpoints(run)[:1]]:
                with suppress(FileNotFoundError):  # then there is a later one the next time
                    files = sorted(checkpoint.iterdir(), key=lambda file: file.name == MANIFEST)
                    links = {file: Path(folder, str(len(held) + i)) for i, file in enumerate(files)}
                    for file, link in links.items():
                        _hold(file, link)
                    held |= {file.relative_to(self.here).as_posix(): link for file, link in links.items()}
            yield held

    def _put(self, name: str, path: Path) -> None:
        version = _version(path)
        if self._sent.get(name) != version and self.is_ours():
            self.files.put_file(str(path), f"{self.there}/{name}")
            self._sent[name] = version

    def _remove(self, names: list[str]) -> None:
        for name in names:
            if self.is_ours():
                if self.files.exists(f"{self.there}/{name}"):
                    self.files.rm_file(f"{self.there}/{name}")
                del self._sent[name]


def _hold(file: Path, link: Path) -> None:
    try:
        os.link(file, link)
    except OSError:  # some file systems have no links
        shutil.copy2(file, link)


def _is_of_checkpoint(name: str) -> bool:
    return CHECKPOINTS in PurePosixPath(name).parts


def _is_hidden(name: str) -> bool:
    """Locks, claims, and what is being written."""
    return any(part.startswith(".") for part in PurePosixPath(name).parts)


def _is_inside(name: str) -> bool:
    """Whoever can write to a store must not write anywhere on the nodes."""
    return not ({"", ".."} & {*name.split("/")} or "\\" in name or PureWindowsPath(name).drive)


def _version(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_size
