"""Models whose files are never half written."""

import io
import pathlib
from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_htr.common.atomic import atomic_path


def with_suffix(path: Any, suffix: str) -> pathlib.Path:
    """
    :param path: of a file, a string or an ``os.PathLike``
    :param suffix: of such files
    :return: the path, with the suffix if it had none
    """
    path = pathlib.Path(path)
    return path if path.suffix else path.with_suffix(suffix)


class AtomicSave(BaseAlgorithm):
    """A Stable-Baselines3 algorithm whose ``save`` is atomic."""

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        :param path: file, ``.zip`` is added to a name without suffix; it is replaced at the end or not at all
        :param exclude: attributes to leave out
        :param include: attributes to save that would be left out
        """
        if isinstance(path, io.IOBase):
            return super().save(path, exclude, include)
        with atomic_path(with_suffix(path, ".zip")) as temporary:
            super().save(temporary, exclude, include)
