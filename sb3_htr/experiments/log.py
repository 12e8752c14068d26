"""What a cell would print goes to a file."""

import io
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path


class PatientLog(io.TextIOBase):
    """
    Writes as long as that is possible: a full disk stops no training.

    :param file: to append to
    """

    def __init__(self, file: Path) -> None:
        self._file = open(file, "ab", buffering=0)

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._file.write(text.encode(errors="backslashreplace"))
        return len(text)

    def close(self) -> None:
        self._file.close()
        super().close()


@contextmanager
def logged(file: Path) -> Iterator[None]:
    """
    :param file: that gets what would be printed, and where it fails
    """
    with PatientLog(file) as log, redirect_stdout(log), redirect_stderr(log):
        try:
            yield
        except Exception:
            traceback.print_exc()
            raise
