"""Where a study of ``sb3-htr optimize`` is kept: the file of a journal (``.log``), or the URL of a database."""

import json
import os
import time
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

# Seconds that one worker has to write a line of a journal
PAUSE = 0.5


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
            # Not what it is, as there may be a password in it
            "--storage is neither sqlite:///FILE, postgresql+psycopg://USER:PASSWORD@HOST/DATABASE nor FILE.log."
        ) from None


def journal(file: str) -> JournalFileBackend:
    """
    :param file: of a journal
    :return: for Optuna, whose own choice of a lock is a symbolic link, which users of Windows may not make
    """
    return JournalFileBackend(file, JournalFileOpenLock(file) if os.name == "nt" else None)


def opened(storage: str) -> JournalStorage | str:
    """
    :param storage: as given
    :return: for Optuna
    :raises ValueError: if it is neither journal nor database, a database without its package, or a journal with a line that is
        not whole
    """
    if (url := url_of(storage)) is not None:
        if url.get_backend_name() not in ("sqlite", "postgresql"):  # for which the command names the extra
            _check_driver(url)
        return storage
    file = Path(storage)
    file.parent.mkdir(parents=True, exist_ok=True)
    if _is_torn(file):
        time.sleep(PAUSE)
    try:
        if _is_torn(file):  # Optuna would write onto the same line
            raise ValueError
        return JournalStorage(journal(storage))
    except ValueError:
        raise ValueError(
            f"The storage {storage} cannot be used, as its last line, or one before, is damaged: remove that line."
        ) from None


def _check_driver(url: sqlalchemy.URL) -> None:
    try:
        url.get_dialect().import_dbapi()
    except (sqlalchemy.exc.ArgumentError, ImportError) as error:
        raise ValueError(
            f"--storage is a database of {url.drivername}, for which a package is missing ({error}): install it, or give "
            "sqlite:///FILE, postgresql+psycopg://USER:PASSWORD@HOST/DATABASE or FILE.log."
        ) from None


def _is_torn(file: Path) -> bool:
    """Whether its last line is not whole, or not yet."""
    lines = file.read_bytes().splitlines(keepends=True) if file.exists() else []
    try:
        return not all(line.endswith(b"\n") and json.loads(line) for line in lines[-1:])
    except ValueError:
        return True


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


def check_is_of(storage: str, name: str | None, facts: dict[str, Any], note: bool = False) -> None:
    """
    Trials of several envs, methods or settings have no best one, and settings of one are none of another.

    :param storage: as given
    :param name: of a study, which need not be there
    :param facts: what a training, or a search, is of: texts, and ``settings`` as JSON has them
    :param note: whether to write them into the study
    :raises ValueError: if the study is of others; older ones do not say
    """
    try:
        study = optuna.load_study(study_name=name, storage=opened(storage))
    except KeyError:  # it is said elsewhere that there is none
        return
    for fact, value in facts.items():
        if (known := study.user_attrs.get(fact, value)) != value:
            options = f"--{fact}"
            if fact == "settings":
                options = "-conf, -params, -n and --env-kwargs"
                known, value = _without(known, value), _without(value, known)
            raise ValueError(
                f"The study {study.study_name!r} is of {fact} {known}, and not {value}: give {options} as there, or search "
                "under another --study-name."
            )
        if note:
            study.set_user_attr(fact, value)


def _without(settings: dict[str, Any], others: dict[str, Any]) -> dict[str, Any]:
    """Those that the others do not have, or have otherwise."""
    return {name: value for name, value in settings.items() if (name, value) not in others.items()}


def check_has_no_password(storage: str | None) -> None:
    """
    :param storage: of a run that is uploaded, with its arguments
    :raises ValueError: if its password would be, too
    """
    if storage is not None and without_password(storage) != storage:
        raise ValueError(
            "--track would upload the password in --storage: leave it out there, and give it as PGPASSWORD or in ~/.pgpass."
        )


def without_password(storage: str) -> str:
    """
    :param storage: as given
    :return: the same, with *** in place of a password
    """
    url = url_of(storage)
    if url is None or (url.password is None and "password" not in url.query):
        return storage
    if "password" in url.query:
        url = url.update_query_dict({"password": "***"})
    return url.render_as_string()
