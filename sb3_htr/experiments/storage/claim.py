"""Who works on something in a store that has no locks."""

import time
from contextlib import suppress
from typing import Any
from uuid import uuid4

from fsspec import AbstractFileSystem

# Seconds between two signs of life, and without any, after which an owner is taken for dead
RENEW, VOID = 20.0, 180.0
FREE = b"free"

Objects = dict[str, dict[str, Any]]


def claims_among(objects: Objects) -> Objects:
    """
    :param objects: paths, and what the store says of them
    :return: those that are claims
    """
    return {path: info for path, info in objects.items() if path.rpartition("/")[2].isdecimal()}


class Claim:
    """
    A lock on a folder: its newest object belongs to the owner, who rewrites it while at work, and writes :data:`FREE` into it
    at the end. A claim that was not rewritten for long, as :class:`Watch` tells, may be taken over as a free one may.

    :param files: of the store
    :param folder: in it
    """

    def __init__(self, files: AbstractFileSystem, folder: str) -> None:
        self.files, self.folder = files, folder
        self._path, self._token, self._count = "", uuid4().hex, 0

    def take(self, void: bytes | None = None) -> bool:
        """
        :param void: content of a claim whose owner is gone; one that was renewed since has another
        :return: whether it is ours now
        """
        if self._path and self.is_ours():
            # Taken before, where the answer was lost
            return True
        claims = self._claims()
        newest = max(claims, default=None)
        if newest is not None and self._content_of(newest) not in (FREE, void):
            return False
        # A number is never used again, so that whoever comes back sees that it was taken for dead
        self._path = f"{self.folder}/{int(newest.rpartition('/')[2]) + 1 if newest else 0:08}"
        try:
            self.files.pipe_file(self._path, self._content(), mode="create")
        except OSError:
            # That there is one is not said alike everywhere, nor always of two at once
            if self._claims().keys() <= claims.keys():
                raise
        # Where a store knows no "create", the latest of several at once has it
        if not self.is_ours():
            return False
        for path in claims:
            with suppress(FileNotFoundError):
                self.files.rm_file(path)
        return True

    def is_ours(self) -> bool:
        """
        :return: whether nobody took it over
        """
        newest = max(self._claims(), default=None)
        return newest == self._path and self._content_of(newest).startswith(self._token.encode())

    def renew(self) -> bool:
        """
        Show that its owner lives.

        :return: whether nobody took it over
        """
        if self.is_ours():
            self._count += 1
            self.files.pipe_file(self._path, self._content())
            return True
        return max(self._claims(), default="") <= self._path

    def release(self) -> None:
        """Leave it to whoever comes."""
        if self.is_ours():
            self.files.pipe_file(self._path, FREE)

    def _claims(self) -> Objects:
        # Others write, too
        self.files.invalidate_cache()
        return claims_among(self.files.find(self.folder, detail=True))

    def _content_of(self, path: str) -> bytes:
        try:
            return bytes(self.files.cat_file(path))
        except FileNotFoundError:
            # Another claim took its place
            return b""

    def _content(self) -> bytes:
        return f"{self._token} {self._count}".encode()


class Watch:
    """Tells claims that are renewed from those of the dead, by a clock of its own: those of several nodes may differ."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, float]] = {}

    def is_alive(self, path: str, info: dict[str, Any]) -> bool:
        """
        :param path: of a claim
        :param info: what its store says of it now
        :return: whether it is not free, and changed within the last :data:`VOID` seconds; what is seen for the first time did
        """
        now, shown = time.monotonic(), str(info)
        if path not in self._seen or self._seen[path][0] != shown:
            self._seen[path] = shown, now
        return info["size"] != len(FREE) and now - self._seen[path][1] < VOID
