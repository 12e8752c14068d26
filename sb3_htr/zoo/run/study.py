"""Where a study of ``sb3-htr optimize`` is kept: the file of a journal (``.log``), or the URL of a database."""

from pathlib import Path

import sqlalchemy
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend


def url_of(storage: str) -> sqlalchemy.URL | None:
    """
    :param storage: as given
    :return: URL of a database, None for a journal
    :raises ValueError: if it is neither
    """
    if storage.endswith(".log"):
        return None
    try:
        return sqlalchemy.make_url(storage)
    except sqlalchemy.exc.ArgumentError:
        raise ValueError(
            f"--storage is {storage!r}, expected sqlite:///FILE, postgresql+psycopg://USER:PASSWORD@HOST/DATABASE or FILE.log."
        ) from None


def opened(storage: str) -> JournalStorage | str:
    """
    :param storage: as given
    :return: for Optuna
    :raises ValueError: if it is neither journal nor database
    """
    if url_of(storage) is not None:
        return storage
    Path(storage).parent.mkdir(parents=True, exist_ok=True)
    return JournalStorage(JournalFileBackend(storage))


def _file(storage: str) -> str | None:
    """The file of a journal or of SQLite; None for a server, and for what is kept in memory."""
    url = url_of(storage)
    if url is None:
        return storage
    return url.database if url.get_backend_name() == "sqlite" and url.database not in ("", ":memory:") else None


def absolute(storage: str) -> str:
    """
    :param storage: as given
    :return: the same from any folder
    """
    file, url = _file(storage), url_of(storage)
    if file is None:
        return storage
    whole = str(Path(file).resolve())
    return whole if url is None else url.set(database=whole).render_as_string()


def check_is_there(storage: str) -> None:
    """
    :param storage: to read a study of
    :raises ValueError: if it is a file that is not there, of which reading would make an empty one
    """
    file = _file(storage)
    if file is not None and not Path(file).exists():
        raise ValueError(f"--storage is {storage}, and there is no file {file}: give that of `sb3-htr optimize`.")


def without_password(storage: str) -> str:
    """
    :param storage: as given
    :return: the same, with *** in place of a password
    """
    url = url_of(storage)
    return storage if url is None or url.password is None else url.render_as_string()
