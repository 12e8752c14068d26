"""Tensors, numbers and text from files of unknown origin."""

import os
import zipfile
from collections.abc import Iterator
from typing import IO, Any

import torch as th

# What a file may unpack to
MAX_BYTES = 2**30


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
        size = sum(info.file_size for info in archive.infolist())
        if size > MAX_BYTES:
            raise ValueError(f"it unpacks to more than {MAX_BYTES} bytes.")
        # torch does not look at the checksums
        if archive.testzip() is not None:
            raise ValueError("it is not what was written.")
    if not isinstance(file, str | os.PathLike):
        file.seek(0)
    content = th.load(file, map_location="cpu", weights_only=True)
    # Of one stored number, torch makes a tensor of any shape, and of one tensor several, without memory until they are
    # copied. An exported model has two of one: its target critics are its critics
    tensors = list(_tensors(content))
    enlarged = any(tensor.nbytes > tensor.untyped_storage().nbytes() for tensor in tensors)
    if enlarged or sum(tensor.nbytes for tensor in tensors) > 2 * size:
        raise ValueError("its tensors are larger than what is stored of them.")
    return content


def _tensors(content: Any) -> Iterator[th.Tensor]:
    if isinstance(content, th.Tensor):
        yield content
    elif isinstance(content, dict | list | tuple):
        for part in content.values() if isinstance(content, dict) else content:
            yield from _tensors(part)
