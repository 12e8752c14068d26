"""Files that are never half written."""

import errno
import os
import re
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from sb3_htr.common.errors import last_line

# What torch says of a disk that is full, and zip files of a clock that they do not know, in errors that are no OSError
OF_A_DISK = re.compile(r"PytorchStreamWriter|inline_container|iostream error")
OF_A_CLOCK = re.compile(r"\bZIP\b")
# Errors that Python raises without the name of the file that is written
OF_A_FULL_DISK = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Write to a temporary name and rename at the end, so that a killed process leaves the old file or the new one, or
    none where a folder replaces a folder.

    :param path: file or folder to make; its parent folders are made too
    :return: path to write to, with the same suffix; removed if writing fails
    :raises OSError: if the folder, or the file to its end, cannot be written to
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(errno.ENOTDIR, "This is a file, expected a folder", str(path.parent)) from error
    if not os.access(path.parent, os.W_OK):  # before whoever writes has done any work
        raise PermissionError(errno.EACCES, "The folder cannot be written to", str(path.parent))
    # In a container, each process may be number 1
    temporary = path.with_name(f".{path.stem}.{uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        yield temporary
        for file in temporary.rglob("*") if temporary.is_dir() else [temporary]:
            with open(file, "r+b") as handle:  # Windows syncs no file that is open for reading only
                os.fsync(handle.fileno())
        # A folder replaces a folder; a file does not
        if temporary.is_dir() and path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
        # The new name is to survive a power cut too, where a folder can be opened and synced: the file is there either way
        with suppress(OSError):
            parent = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(parent)
            finally:
                os.close(parent)
    except OSError as error:
        if error.errno in OF_A_FULL_DISK and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    except (RuntimeError, ValueError, struct.error) as error:
        if OF_A_DISK.search(str(error)):
            raise OSError(errno.EIO, "torch could not write it, as on a full disk", str(path)) from error
        if isinstance(error, struct.error) or OF_A_CLOCK.search(str(error)):
            raise OSError(last_line(error)) from error
        raise
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)
