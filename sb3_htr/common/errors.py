"""Exceptions by what they are about, and what they say in one line."""

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
