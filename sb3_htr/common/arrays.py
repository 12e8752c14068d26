"""Arrays in files that may be damaged."""

import os
from collections.abc import Iterable

import numpy as np

from sb3_htr.common.errors import OPEN_ERRORS


def load_arrays(path: str | os.PathLike[str], needed: Iterable[str] = (), advice: str = "") -> dict[str, np.ndarray]:
    """
    :param path: of an npz file; it is closed again
    :param needed: names that must be in it
    :param advice: for the message, what to do if it cannot be used
    :return: its arrays
    :raises OSError: if there is no such file, or it cannot be opened
    :raises ValueError: if it is damaged, or lacks something
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except OPEN_ERRORS:
        raise
    except Exception:  # whatever numpy and zipfile make of damage
        raise ValueError(f"{path} is damaged, or no npz file. {advice}".strip()) from None
    if missing := sorted(set(needed) - set(arrays)):
        raise ValueError(f"{path} lacks {missing}. {advice}".strip())
    return arrays
