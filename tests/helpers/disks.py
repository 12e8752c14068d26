"""Small disks, for whoever may mount one, and files that are half written."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def disk(folder: Path, kilobytes: int, options: str = "rw") -> Iterator[Path]:
    """A disk of its own in memory, of so many kilobytes; skips the test where none can be mounted."""
    path = folder / f"disk_{kilobytes}_{options}"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"{options},size={kilobytes}k", "tmpfs", str(path)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no disk can be mounted")
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


def half_written(path: str | Path, *_: Any, **__: Any) -> None:
    """In the place of what writes a file: whoever does so is stopped half-way."""
    Path(path).write_bytes(b"half")
    raise KeyboardInterrupt
