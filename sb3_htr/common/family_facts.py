"""Whether two task families reward alike."""

import hashlib
import re
import sys
from typing import Any

import numpy as np
import torch as th

from sb3_htr.common.type_aliases import TaskFamily


def family_facts(family: TaskFamily) -> dict[str, str]:
    """
    :param family: of an env, or of a replay buffer
    :return: its class and its attributes in words, arrays as checksums: the same for two families that reward alike
    """

    inside: list[Any] = [family]

    def fact(value: Any) -> str:
        if isinstance(value, th.Tensor):
            value = value.detach().cpu().numpy()
        if isinstance(value, np.ndarray) and value.dtype.hasobject:
            value = value.tolist()  # its bytes are addresses
        if isinstance(value, np.ndarray):
            return f"array of shape {value.shape}, {hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:12]}"
        if isinstance(value, set | frozenset):
            return f"{type(value).__name__} of {sorted(map(fact, value))}"  # its order differs between processes
        if type(value) in (list, tuple, dict) or _says_nothing(value):
            return of_parts(value)
        with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
            # The text of an object may end in its address, which differs between processes; numpy writes it in capitals
            return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))

    def of_parts(value: Any) -> str:
        if any(value is outer for outer in inside):
            return "itself"
        inside.append(value)
        if isinstance(value, list | tuple):
            parts = ", ".join(map(fact, value))
            text = f"[{parts}]" if isinstance(value, list) else f"({parts}{',' * (len(value) == 1)})"
        elif isinstance(value, dict):
            text = f"{{{', '.join(f'{fact(key)}: {fact(part)}' for key, part in value.items())}}}"
        else:
            text = f"{type(value).__qualname__} with {of_parts(vars(value))}"
        inside.pop()
        return text

    # Attributes of a class and slots are in no __dict__
    tasks = {name: getattr(family, name, None) for name in ("train_tasks", "validation_tasks", "test_tasks")}
    attributes = tasks | getattr(family, "__dict__", {})
    return {"class": type(family).__qualname__, **{name: fact(value) for name, value in sorted(attributes.items())}}


def _says_nothing(value: Any) -> bool:
    """Whether it is an object that has attributes, and no text of its own."""
    return type(value).__repr__ is object.__repr__ and hasattr(value, "__dict__")


def check_same_family(before: dict[str, str], now: dict[str, str], what: str, known: str = "the collected experience") -> None:
    """
    :param before: :func:`family_facts` of what was collected
    :param now: of what comes in
    :param what: comes in, for the message
    :param known: what it is compared with, for the message
    :raises ValueError: if they differ, naming the first difference
    """
    different = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if different:
        name = different[0]
        raise ValueError(
            f"{what} has another task family: its {name} is {now.get(name)}, that of {known} is {before.get(name)}. "
            "Relabelled rewards would be wrong: make all envs of a model alike, or make a new model."
        )
