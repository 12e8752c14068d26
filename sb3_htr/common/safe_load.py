"""Tensors, numbers and text from files of unknown origin."""

import io
import json
import os
import pickletools
import re
import zipfile
from collections.abc import Iterable, Iterator
from typing import IO, Any

import numpy as np
import torch as th
from gymnasium import spaces

# What a file may unpack to
MAX_BYTES = 2**30
# What its pickle may call, beside types of storages
CALLED = ("torch._utils _rebuild_tensor_v2", "collections OrderedDict")


class Refused(ValueError):
    """A file whose content is read, and not wanted: its words are our own."""


def read_model(path: str | os.PathLike[str], names: Iterable[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Read a model file without running code of it.

    :param path: file of SB3's ``save``
    :param names: of the weights in it
    :return: its settings, where what is no plain JSON is text, and state dicts by name
    :raises ValueError: as :func:`load_plain`
    :raises Exception: of many kinds, for a file that is damaged or of another kind
    """
    with zipfile.ZipFile(path) as archive:
        _check_size(archive)
        data = json.loads(archive.read("data"))
        weights = {name: load_plain(io.BytesIO(archive.read(f"{name}.pth"))) for name in names}
    if not all(isinstance(value, dict) for value in (data, *weights.values())):
        raise TypeError
    return data, weights


def box_in_words(record: Any) -> spaces.Box | None:
    """
    :param record: of a space, as SB3 writes an object beside its pickle: its arrays are text, as numpy prints them
    :return: the space of these bounds; None where it is no box, or one too long to be printed in full
    """
    try:
        printed = (re.sub(r"[\[\]]", " ", record[name]).split() for name in ("low", "high"))
        low, high = (np.array(numbers, np.float64).reshape(record["_shape"]) for numbers in printed)
        # Rounded when they were printed, each array to digits of its own, they may cross
        return spaces.Box(low, np.maximum(low, high), dtype=np.float64)
    except (KeyError, TypeError, ValueError, AssertionError):
        return None


def load_plain(file: str | os.PathLike[str] | IO[bytes]) -> Any:
    """
    ``torch.load`` that runs no code, and takes no more memory than the file says that it has.

    :param file: of ``torch.save``
    :return: nested dicts, lists and tuples of tensors, numbers, strings, None
    :raises ValueError: for a file that is not what was written, that unpacks to too much, or whose tensors are larger than
        what is stored of them
    :raises Exception: of many kinds, for a file that is damaged or of another kind
    """
    with zipfile.ZipFile(file) as archive:
        assert archive.fp is not None
        archive.fp.seek(0)
        # A zip may have something before it, which torch would read in its place
        if archive.fp.read(4) != b"PK\x03\x04":
            raise Refused("it does not begin as a file of torch.")
        size = _check_size(archive)
        # torch does not look at the checksums
        if archive.testzip() is not None:
            raise Refused("it is not what was written.")
        for name in archive.namelist():
            if name.lower().endswith("data.pkl"):  # torch finds it in any case
                _check_pickle(archive.read(name))
    if not isinstance(file, str | os.PathLike):
        file.seek(0)
    content = th.load(file, map_location="cpu", weights_only=True)
    # Of one stored number, torch makes a tensor of any shape, and of one tensor several, without memory until they are
    # copied. An exported model has two of one: its target critics are its critics
    tensors = list(_tensors(content))
    enlarged = any(tensor.nbytes > tensor.untyped_storage().nbytes() for tensor in tensors)
    if enlarged or sum(tensor.nbytes for tensor in tensors) > 2 * size:
        raise Refused("its tensors are larger than what is stored of them.")
    return content


def _check_size(archive: zipfile.ZipFile) -> int:
    """Bytes that it unpacks to."""
    size = sum(info.file_size for info in archive.infolist())
    if size > MAX_BYTES:
        raise Refused(f"it unpacks to more than {MAX_BYTES} bytes.")
    return size


def _check_pickle(data: bytes) -> None:
    """torch lets a file call more than that, of which some take any memory at once."""
    for opcode, argument, _ in pickletools.genops(data):
        named = opcode.name == "GLOBAL" and (argument in CALLED or re.fullmatch(r"torch \w+Storage", str(argument)))
        if opcode.name in ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4") or (opcode.name == "GLOBAL" and not named):
            raise Refused("it calls what no tensor needs.")


def _tensors(content: Any) -> Iterator[th.Tensor]:
    if isinstance(content, th.Tensor):
        yield content
    elif isinstance(content, dict | list | tuple):
        for part in content.values() if isinstance(content, dict) else content:
            yield from _tensors(part)
