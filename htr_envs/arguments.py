"""Numbers among the arguments of envs, which come from YAML files and command lines and may be text there."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np


def are_numbers(*values: Any) -> bool:
    """Whether comparing these with a number says something.

    :param values: arguments of an env.
    :return: whether each of them is a number.
    """
    return all(isinstance(value, Real) and not isinstance(value, bool) for value in values)


def are_whole(*values: Any) -> bool:
    """The same of whole numbers.

    :param values: arguments of an env.
    :return: whether each of them is a whole number.
    """
    return are_numbers(*values) and all(isinstance(value, int | np.integer) for value in values)


def finite_float(name: str, value: float) -> np.float32:
    """A number of float32, such as the weight of a cost.

    :param name: of it.
    :param value: the number.
    :return: the same.
    :raises ValueError: if it is not finite.
    """
    if not are_numbers(value) or not abs(value) <= np.finfo(np.float32).max:
        raise ValueError(f"{name} is {value!r}, expected a finite number of float32.")
    return np.float32(value)
