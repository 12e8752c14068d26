"""Evaluations of a final model are kept as they end: all of them together may take longer than its training."""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.digest import sha256
from sb3_htr.experiments.cell import KwArgs, file_name

FOLDER = "evaluated"


class EvaluationCache:
    """
    Evaluations of one model, in files of its run's folder.

    :param run: folder of the run
    :param model: file of its final model
    :param about: what else the evaluations depend on
    """

    def __init__(self, run: Path, model: Path, *about: str) -> None:
        self.folder = run / FOLDER
        self._of = json.dumps([sha256(model), *about])

    def __call__(self, name: str, make: Callable[[], KwArgs]) -> KwArgs:
        """
        :param name: of an evaluation
        :param make: makes it
        :return: its arrays, from a file where there is one of the same model and of the same of all else
        """
        path = self.folder / f"{file_name(name)}.npz"
        arrays: KwArgs = {}
        with contextlib.suppress(OSError, ValueError):  # not there yet, or damaged
            arrays = load_arrays(path)
        if str(arrays.pop("of", "")) != self._of:
            arrays = make()
            self.folder.mkdir(exist_ok=True)
            with atomic_path(path) as new:
                np.savez_compressed(new, of=self._of, **arrays)
        return arrays
