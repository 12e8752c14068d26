"""Checksums of files."""

import hashlib
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
