"""Exceptions by what they are about, what they say in one line, and those that stop no training."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Of a path that cannot be opened, whatever is in the file
OPEN_ERRORS = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


def last_line(error: Exception) -> str:
    """
    :param error: torch's say what is wrong in their last line
    :return: that line, of 200 characters at most; the type of an error that says nothing
    """
    return (str(error).splitlines() or [type(error).__name__])[-1].strip()[:200]


def reason(error: OSError) -> str:
    """
    :param error: of writing a file
    :return: in a few words
    """
    return error.strerror or last_line(error)


@contextmanager
def memory_for(what: Any) -> Iterator[None]:
    """
    :param what: file that is read within, for the message
    :raises MemoryError: if there is too little memory for it, of which torch has no exception of its own: the file is whole
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "can't allocate memory" not in str(error):
            raise
        raise MemoryError(f"There is too little memory to read {what}: free some, and try again.") from None


@contextmanager
def training_goes_on(what: str, done: str = "written") -> Iterator[None]:
    """
    Warn where a file cannot be written, as on a disk that is full, in place of an error. What follows within is not done.

    :param what: file, for the message
    :param done: what should be done with it, likewise
    """
    try:
        yield
    except OSError as error:
        warnings.warn(f"{what} could not be {done} ({reason(error)}). Training goes on.", stacklevel=3)
