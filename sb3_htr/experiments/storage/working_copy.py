"""A folder of a storage on the disk of the node that works on it."""

from pathlib import Path, PurePosixPath

from fsspec import AbstractFileSystem

from sb3_htr.common.resume import CHECKPOINTS


class WorkingCopy:
    """
    :param files: of the storage
    :param there: folder in it
    :param here: folder of this machine
    """

    def __init__(self, files: AbstractFileSystem, there: str, here: Path) -> None:
        self.files, self.there, self.here = files, there, here
        self._sent: dict[str, tuple[int, int]] = {}

    def fetch(self) -> None:
        """What the storage has, but for hidden files."""
        for path in self.files.find(self.there):
            name = path.removeprefix(f"{self.there}/")
            if not _is_hidden(PurePosixPath(name)):
                (self.here / name).parent.mkdir(parents=True, exist_ok=True)
                self.files.get_file(path, str(self.here / name))
                self._sent[name] = _version(self.here / name)

    def send(self) -> None:
        """
        What changed, so that the storage has at any time what a killed run leaves: a checkpoint, and all else as new as it, or
        newer; an older checkpoint until the next one is whole.
        """
        names = [path.relative_to(self.here).as_posix() for path in self.here.rglob("*") if path.is_file()]
        names = [name for name in names if not _is_hidden(PurePosixPath(name))]
        # Listed before all else is read
        for name in sorted(names, key=lambda name: CHECKPOINTS in PurePosixPath(name).parts):
            try:
                version = _version(self.here / name)
                if self._sent.get(name) != version:
                    self._sent[name] = version
                    self._put(name)
            except FileNotFoundError:
                # Removed since, which is seen below
                if (self.here / name).exists():
                    raise
            except BaseException:
                del self._sent[name]
                raise
        for name in [name for name in self._sent if not (self.here / name).exists()]:
            if self.files.exists(f"{self.there}/{name}"):
                self.files.rm_file(f"{self.there}/{name}")
            del self._sent[name]

    def _put(self, name: str) -> None:
        path = f"{self.there}/{name}"
        self.files.makedirs(path.rpartition("/")[0], exist_ok=True)
        self.files.put_file(str(self.here / name), path)


def _is_hidden(name: PurePosixPath) -> bool:
    """Locks, claims, and what is being written."""
    return any(part.startswith(".") for part in name.parts)


def _version(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_size
