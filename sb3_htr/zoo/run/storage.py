"""Where a study of ``sb3-htr optimize`` is kept: the file of a journal (``.log``), or the URL of a database."""

from pathlib import Path

SQLITE = "sqlite:///"


def _file(storage: str) -> str | None:
    """The file of a journal or of SQLite; None for a server, and for what is kept in memory."""
    if storage.endswith(".log"):
        return storage
    name = storage.removeprefix(SQLITE)
    return None if name == storage or name in ("", ":memory:") else name


def absolute(storage: str) -> str:
    """
    :param storage: as given
    :return: the same from any folder
    """
    file = _file(storage)
    return storage if file is None else storage.removesuffix(file) + str(Path(file).resolve())


def check_is_there(storage: str) -> None:
    """
    :param storage: to read a study of
    :raises ValueError: if it is a file that is not there, of which reading would make an empty one
    """
    file = _file(storage)
    if file is not None and not Path(file).exists():
        raise ValueError(f"--storage is {storage}, and there is no file {file}: give that of `sb3-htr optimize`.")
