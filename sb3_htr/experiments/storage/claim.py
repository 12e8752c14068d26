"""Who works on something in a storage that has no locks."""

import time
from contextlib import suppress
from typing import Any
from uuid import uuid4

from fsspec import AbstractFileSystem

# Seconds between two signs of life, and without any, after which an owner is taken for dead
RENEW, VOID = 20.0, 180.0


class Claim:
    """
    The newest object in a folder is its owner's, who renews it while at work, and empties it in the end. What is empty is
    nobody's, and neither is what :class:`Watch` saw nobody renew.

    :param files: of the storage
    :param folder: in it
    """

    def __init__(self, files: AbstractFileSystem, folder: str) -> None:
        self.files, self.folder = files, folder
        self._path, self._token, self._count = "", uuid4().hex, 0

    def take(self, void: str | None = None) -> bool:
        """
        :param void: path of a claim whose owner is gone
        :return: whether it is ours now
        """
        claims = self._claims()
        newest = max(claims, default=None)
        if newest is not None and newest != void and claims[newest]["size"]:
            return False
        # A number is never used again, so that whoever comes back sees that it was taken for dead
        self._path = f"{self.folder}/{int(newest.rpartition('/')[2]) + 1 if newest else 0:08}"
        self.files.makedirs(self.folder, exist_ok=True)
        try:
            self.files.pipe_file(self._path, self._content(), mode="create")
        except FileExistsError:
            return False
        for path in claims:
            with suppress(FileNotFoundError):
                self.files.rm_file(path)
        # Where a storage knows no "create", the latest of several at once has it
        return self.is_ours()

    def is_ours(self) -> bool:
        """
        :return: whether nobody took it over
        """
        newest = max(self._claims(), default="")
        return newest == self._path and self.files.cat_file(newest).startswith(self._token.encode())

    def renew(self) -> None:
        """Show that its owner lives."""
        if self.is_ours():
            self._count += 1
            self.files.pipe_file(self._path, self._content())

    def release(self) -> None:
        """Leave it to whoever comes."""
        if self.is_ours():
            self.files.pipe_file(self._path, b"")

    def _claims(self) -> dict[str, Any]:
        # Others write, too
        self.files.invalidate_cache()
        claims: dict[str, Any] = self.files.find(self.folder, detail=True)
        return claims

    def _content(self) -> bytes:
        return f"{self._token} {self._count}".encode()


class Watch:
    """Tells claims that are renewed from those of the dead, by a clock of its own: those of several nodes may differ."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, float]] = {}

    def is_alive(self, path: str, info: dict[str, Any]) -> bool:
        """
        :param path: of a claim
        :param info: what its storage says of it now
        :return: whether it changed within the last :data:`VOID` seconds; what is seen for the first time did
        """
        now, shown = time.monotonic(), str(info)
        if path not in self._seen or self._seen[path][0] != shown:
            self._seen[path] = shown, now
        return bool(info["size"]) and now - self._seen[path][1] < VOID
