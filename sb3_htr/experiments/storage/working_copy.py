"""A folder of a store on the disk of the node that works on it."""

from collections.abc import Callable
from pathlib import Path, PurePosixPath

from fsspec import AbstractFileSystem

from sb3_htr.common.resume import CHECKPOINTS


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
        """What the store has, but for hidden files."""
        for path in self.files.find(self.there):
            name = path.removeprefix(f"{self.there}/")
            if not _is_hidden(name):
                (self.here / name).parent.mkdir(parents=True, exist_ok=True)
                self.files.get_file(path, str(self.here / name))
                self._sent[name] = _version(self.here / name)

    def send(self) -> None:
        """
        What changed, so that the store has at any time what a killed run leaves: a checkpoint, and all else as new as it, or
        newer; an older checkpoint until the next one is whole.
        """
        # Listed before anything is read: what is written in the meantime comes the next time
        names = [path.relative_to(self.here).as_posix() for path in self.here.rglob("*") if path.is_file()]
        for name in sorted(names, key=_is_of_checkpoint):
            try:
                version = _version(self.here / name)
                if not _is_hidden(name) and self._sent.get(name) != version and self.is_ours():
                    self.files.put_file(str(self.here / name), f"{self.there}/{name}")
                    self._sent[name] = version
            except FileNotFoundError:
                # Removed since it was listed; or the store says so
                if (self.here / name).exists():
                    raise
        self._remove(list(filter(_is_of_checkpoint, self._sent)))

    def prune(self) -> None:
        """Remove there all else that was sent and is here no more."""
        self._remove(list(self._sent))

    def _remove(self, names: list[str]) -> None:
        for name in names:
            if not (self.here / name).exists() and self.is_ours():
                if self.files.exists(f"{self.there}/{name}"):
                    self.files.rm_file(f"{self.there}/{name}")
                del self._sent[name]


def _is_of_checkpoint(name: str) -> bool:
    return CHECKPOINTS in PurePosixPath(name).parts


def _is_hidden(name: str) -> bool:
    """Locks, claims, and what is being written."""
    return any(part.startswith(".") for part in PurePosixPath(name).parts)


def _version(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_size
