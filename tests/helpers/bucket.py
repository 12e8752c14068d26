"""An object store in a folder: its objects appear whole, and one that is to be new is made once, by several processes, too."""

import os
import shutil
from pathlib import Path
from typing import Any
from uuid import uuid4

import fsspec
from fsspec.implementations.local import LocalFileSystem

PROTOCOL = "bucket"


class Bucket(LocalFileSystem):
    """``bucket:///folder``."""

    protocol = PROTOCOL

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        # Earlier versions of fsspec do so for "file://" alone
        return str(super()._strip_protocol(str(path).removeprefix(f"{PROTOCOL}://")))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **_: Any) -> None:
        part = self._part(path)
        part.write_bytes(value)
        if mode == "create":
            try:
                os.link(part, path)
            finally:
                part.unlink()
        else:
            os.replace(part, path)

    def put_file(self, lpath: str, rpath: str, **_: Any) -> None:
        part = self._part(rpath)
        shutil.copyfile(lpath, part)
        os.replace(part, rpath)

    def find(self, path: str, *args: Any, **kwargs: Any) -> Any:
        found = super().find(path, *args, **kwargs)
        names = [name for name in found if not name.endswith(".part")]
        return {name: found[name] for name in names} if isinstance(found, dict) else names

    def _part(self, path: str) -> Path:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        return Path(path).with_name(f".{uuid4().hex}.part")


fsspec.register_implementation(PROTOCOL, Bucket, clobber=True)
