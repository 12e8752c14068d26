"""Checkpoints, folders of plain data: never half written, damage is noticed, and reading one runs no code."""

import json
import os
import warnings
from collections import OrderedDict
from pathlib import Path, PurePath
from typing import Any

import torch as th

from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.digest import sha256
from sb3_htr.common.errors import memory_for
from sb3_htr.common.versions import versions

FORMAT = 1
STATE, MANIFEST = "state.pt", "manifest.json"
# In the folder of a run
CHECKPOINTS = "checkpoints"


# What is read again without running code: these types themselves, as a subclass is written by its name
LEAVES = (bool, int, float, complex, str, type(None))


class DamagedCheckpoint(ValueError):
    """A folder that cannot be read, with the reason."""


def check_state(owner: str, value: Any, place: str = "") -> None:
    """
    :param owner: whose state it is, for the message
    :param value: the state, or a part of it
    :param place: of the part
    :raises ValueError: for what could not be read again, as an array of numpy
    """
    if type(value) in (dict, OrderedDict):
        for key, part in value.items():
            check_state(owner, key, f"{place}, a key,")
            check_state(owner, part, f"{place}[{key!r}]")
    elif type(value) in (list, tuple, set):
        for i, part in enumerate(value):
            check_state(owner, part, f"{place}[{i}]")
    elif type(value) not in LEAVES and not (type(value) in (th.Tensor, th.nn.Parameter) and not vars(value)):
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        raise ValueError(
            f"The state_dict() of {owner} cannot be saved: {place or 'it'} is a {kind}. It may hold tensors (torch.from_numpy "
            "makes one of an array), numbers of Python, texts and None, in lists, tuples and dicts."
        )


def write_checkpoint(folder: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """
    :param folder: to make; its files appear all at once or not at all
    :param state: nested dicts, lists and tuples of tensors, numbers, strings, None
    :raises OSError: if it cannot be written; nothing is left behind
    :raises ValueError: for a state that could not be read again
    """
    check_state("this training", state)
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        with open(temporary / STATE, "wb") as file:  # whose errors are those of the system, unlike torch's own
            th.save(state, file)
        manifest = {
            "format": FORMAT,
            "versions": versions(),
            "sha256": {STATE: sha256(temporary / STATE)},
        }
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1))


def read_checkpoint(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """
    :param folder: of :func:`write_checkpoint`
    :return: the state, on the CPU
    :raises DamagedCheckpoint: if it is incomplete, changed, or of another format
    :raises MemoryError: if there is too little memory for it
    """
    folder = Path(folder)
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        found, expected = manifest["format"], manifest["sha256"][STATE]
        writer = manifest["versions"].get("sb3_htr", "of an unknown version")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise DamagedCheckpoint(f"{folder} has no readable {MANIFEST}: it is damaged, or no checkpoint.") from None
    if found != FORMAT:
        raise DamagedCheckpoint(f"{folder} has format {found}, expected {FORMAT}: read it with sb3_htr {writer}, its writer.")
    try:
        intact = sha256(folder / STATE) == expected
    except OSError:
        intact = False
    if not intact:
        raise DamagedCheckpoint(f"{folder / STATE} is missing or not what was written: the checkpoint is damaged.")
    try:
        with memory_for(folder / STATE):
            state: dict[str, Any] = th.load(folder / STATE, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception:  # whatever a stranger can put into a file, with its checksum beside it
        raise DamagedCheckpoint(f"{folder / STATE} is not what sb3-htr writes, and may run code: it was not read.") from None
    return state


def checkpoints(run: Path) -> list[Path]:
    """
    :param run: folder of a run
    :return: its checkpoints, the latest first
    """
    folders = [path for path in (run / CHECKPOINTS).glob("*_steps") if path.name.removesuffix("_steps").isdecimal()]
    return sorted(folders, key=n_steps_at, reverse=True)


def n_steps_at(checkpoint: PurePath) -> int:
    """
    :param checkpoint: folder
    :return: env steps before it
    """
    return int(checkpoint.name.removesuffix("_steps"))


def n_steps_done(run: Path) -> int:
    """
    :param run: folder of a run
    :return: env steps before its latest checkpoint, 0 without one
    """
    return next(map(n_steps_at, checkpoints(run)), 0)


def load_latest(run: Path) -> tuple[Path, dict[str, Any]]:
    """
    :param run: folder of a run
    :return: the latest checkpoint that is whole, and its state; those that are not are warned of
    :raises FileNotFoundError: if there is none
    :raises MemoryError: if there is too little memory for it
    """
    for folder in checkpoints(run):
        try:
            return folder, read_checkpoint(folder)
        except DamagedCheckpoint as error:
            warnings.warn(f"{error} The next older checkpoint is tried.", stacklevel=2)
    raise FileNotFoundError(
        f"There is no checkpoint to go on from in {run / CHECKPOINTS}: move {run} away, and train again, with --save-freq."
    )
