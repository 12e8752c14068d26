"""Checksums of files and code."""

import hashlib
import sys
import zipfile
from collections.abc import Iterable
from pathlib import Path


def sha256(*files: Path) -> str:
    """
    :param files: to read
    :return: SHA-256 of their contents one after the other, in hexadecimal
    :raises OSError: if one of them cannot be read
    """
    digest = hashlib.sha256()
    for path in files:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def digest_of_code(modules: Iterable[str]) -> str:
    """
    :param modules: names of modules and packages that are imported
    :return: SHA-256 of their files; of a module within a package, of all files of the package: the module may import or read
        any of them
    """
    files: list[Path] = []
    for module in modules:
        outermost = sys.modules[module.partition(".")[0]]
        folders = [Path(folder) for folder in getattr(outermost, "__path__", ())]
        inside = [file for folder in folders for file in sorted(folder.rglob("*")) if file.parent.name != "__pycache__"]
        files += [file for file in inside if file.is_file()] if folders else [Path(outermost.__file__ or "")]
    return sha256(*files)


def is_whole_zip(path: Path) -> bool:
    """
    :param path: of a zip file, as models are
    :return: whether it is there, and what its checksums say
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except Exception:  # whatever a damaged one makes of it
        return False
