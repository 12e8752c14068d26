"""Exceptions by what they are about, and what they say in one line."""

import struct

# Of a path that cannot be opened, whatever is in the file
OPEN_ERRORS = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
# What writing a file can end in: a full disk (of which torch makes a RuntimeError), a clock that zip files do not know
WRITE_ERRORS = (OSError, RuntimeError, ValueError, struct.error)


def last_line(error: Exception) -> str:
    """
    :param error: torch's say what is wrong in their last line
    :return: that line, of 200 characters at most; the type of an error that says nothing
    """
    return (str(error).splitlines() or [type(error).__name__])[-1].strip()[:200]


def reason(error: Exception) -> str:
    """
    :param error: of writing a file
    :return: in a few words
    """
    if isinstance(error, RuntimeError):
        return "torch could not write it, as on a full disk"
    return (isinstance(error, OSError) and error.strerror) or last_line(error)
