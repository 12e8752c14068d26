"""Settings that a user gives: numbers and keywords that are checked, and objects chosen by a name or brought along."""

import difflib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar, cast

import numpy as np

Kind = TypeVar("Kind")
# Of a number that may be as small as it likes
LOWEST = -sys.float_info.max
# What SB3 reads as an entropy coefficient that is learnt, with a first value above 0
LEARNT_ENT_COEF = r"auto(_(?=[^e]*[1-9])\d+(\.\d+)?(e-?\d)?)?"
VARIADIC = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)


def name_of(value: Any) -> Any:
    """
    :param value: a name, or a mapping with ``name`` and keyword arguments
    :return: the name; None for a mapping without one, any other value as it is
    """
    return value.get("name") if isinstance(value, Mapping) else value


def make(setting: str, value: Any, kinds: Mapping[str, Callable[..., Kind]], base: Any) -> Kind:
    """
    :param setting: what is chosen, for messages
    :param value: a name, a mapping with ``name`` and keyword arguments, or an object, which is returned as it is
    :param kinds: classes by their names
    :param base: what an object must be an instance of
    :return: the object
    :raises ValueError: for an unknown name or keyword, or any other value
    """
    if isinstance(value, base):
        return cast(Kind, value)
    name = name_of(value)
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(
            f"{setting} is {value!r}, expected one of {sorted(kinds)}, {{'name': one of them, and its settings}}, or an "
            f"object derived from {base.__name__}."
        )
    settings = {key: item for key, item in value.items() if key != "name"} if isinstance(value, Mapping) else {}
    check_keywords(f"{setting} {name!r}", settings, kinds[name])
    return kinds[name](**settings)


def register(
    setting: str, kind: type[Kind], base: type, kinds: dict[str, Any], spell: Callable[[str], str] = str
) -> type[Kind]:
    """
    Let a setting name a class of one's own.

    :param setting: that chooses such a class, for messages
    :param kind: the class
    :param base: what it is to be derived from
    :param kinds: classes by their names, to which it is added; again, if a notebook defines it again
    :param spell: makes the name of that of the class
    :return: the class, so that this can decorate it
    :raises ValueError: for what is no such class, or a name that another one has
    """
    check_class(f"What is registered as {setting}", kind, base)
    name = spell(kind.__name__)
    check_own_name(setting, kind, kinds.get(name, kind), name)
    kinds[name] = kind
    return kind


def check_own_name(setting: str, kind: type, known: type, name: str) -> None:
    """
    :param setting: that chooses such a class, for messages
    :param kind: a class
    :param known: the one that the setting has under this name
    :param name: of both
    :raises ValueError: if they are two
    """
    if (kind.__module__, kind.__qualname__) != (known.__module__, known.__qualname__):
        raise ValueError(
            f"The {setting} {kind.__module__}.{kind.__qualname__} has the name {name!r}, which is that of "
            f"{known.__module__}.{known.__qualname__}: give the class another name."
        )


def check_numbers(**numbers: tuple[Any, float] | tuple[Any, float, float]) -> None:
    """
    :param numbers: name of a setting, its value, and the smallest and, if there is one, the largest value that it may have,
        which may be infinite; with an int as the smallest one, it must be a whole number
    :raises ValueError: for the first one that is none, or out of its range
    """
    for name, (given, low, *largest) in numbers.items():
        value = plain(given)  # compared in its own type, a float32 would make infinity of the limits
        high = largest[0] if largest else sys.float_info.max
        whole = isinstance(low, int)
        kind = int if whole else int | float
        # written so that nan, which compares with nothing, is refused too
        if isinstance(value, bool) or not (isinstance(value, kind) and low <= value <= high):
            is_infinite = isinstance(value, float) and np.isinf(value) and high < np.inf
            article = "a whole number" if whole else "a finite number" if is_infinite else "a number"
            # Whole numbers in full: of a large one, the first digits are another number
            least, most = (limit if isinstance(limit, int) else f"{limit:g}" for limit in (low, high))
            limits = f" of at least {least}" if high >= sys.float_info.max else f" from {least} to {most}"
            raise ValueError(f"{name} is {given!r}, expected {article}{'' if low == LOWEST else limits}.")


def plain(value: Any) -> Any:
    """
    :param value: a setting
    :return: the same, numbers of numpy in it as Python's: others SB3 writes as pickles, which only those read who trust a file
    """
    if isinstance(value, np.generic):
        return float(value) if isinstance(value, np.floating) else value.item()
    if type(value) is dict:
        return {key: plain(part) for key, part in value.items()}
    return type(value)(map(plain, value)) if type(value) in (list, tuple) else value


def check_flags(**flags: Any) -> None:
    """
    :param flags: name of a setting and its value
    :raises ValueError: for the first one that is neither True nor False, as a word in a YAML file is
    """
    for name, value in flags.items():
        if not isinstance(plain(value), bool):
            raise ValueError(f"{name} is {value!r}, expected True or False.")


def check_mappings(**mappings: Any) -> None:
    """
    :param mappings: name of a setting and its value
    :raises ValueError: for the first one that is neither None nor names with values
    """
    for name, value in mappings.items():
        if value is not None and not isinstance(value, Mapping):
            raise ValueError(f"{name} is {value!r}, expected names and values, as in {{'name': value}}.")


def check_layers(**networks: Any) -> None:
    """
    :param networks: name of a setting and its value
    :raises ValueError: for the first one that is no list of whole numbers
    """
    for name, units in networks.items():
        whole = isinstance(units, list | tuple) and all(type(plain(n)) is int and n >= 1 for n in units)
        if not whole:
            raise ValueError(f"{name} is {units!r}, expected the hidden units of each layer, as in [128, 128].")


def check_entropy(ent_coef: Any, target_entropy: Any) -> None:
    """
    SAC's two settings that are a number or a word.

    :param ent_coef: a number, or ``"auto"`` or ``"auto_0.1"``, by which one is learnt
    :param target_entropy: a number or ``"auto"``
    :raises ValueError: for anything else
    """
    if not isinstance(ent_coef, str):
        check_numbers(ent_coef=(ent_coef, 0.0))
    elif not re.fullmatch(LEARNT_ENT_COEF, ent_coef):
        raise ValueError(
            f'ent_coef is the text {ent_coef!r}, expected a number, or "auto" or "auto_0.1", by which one is learnt. '
            "In YAML, 1.0e-3 is a number, and 1e-3 is not."
        )
    if not (isinstance(target_entropy, str) and target_entropy == "auto"):
        check_numbers(target_entropy=(target_entropy, LOWEST))


def check_class(name: str, value: Any, base: type) -> None:
    """
    :param name: of a setting
    :param value: that it has
    :param base: a class
    :raises ValueError: for what is no class derived from it, such as the name of one
    """
    if not (isinstance(value, type) and issubclass(value, base)):
        raise ValueError(f"{name} is {value!r}, expected a class derived from {base.__module__}.{base.__qualname__}.")


def keywords_of(function: Callable[..., Any]) -> set[str]:
    """
    :param function: or a class
    :return: names of the arguments that it takes
    """
    known: set[str] = set()
    for part in getattr(function, "__mro__", (function,)):
        own = vars(part).get("__init__") if isinstance(part, type) else part
        if own is None:
            continue
        # A class that hands its keywords on has those of its parent too
        parameters = inspect.signature(own).parameters
        known |= {name for name, parameter in parameters.items() if parameter.kind not in VARIADIC}
        if not any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    return known - {"self"}


def check_keywords(
    owner: str, given: Iterable[str], function: Callable[..., Any], also: Iterable[str] = (), without: Iterable[str] = ()
) -> None:
    """
    :param owner: whose keywords they are, for the message
    :param given: names that a user gave
    :param function: that takes them, or a class
    :param also: names that are known elsewhere
    :param without: names that are not for the user to give
    :raises ValueError: for the first name that is not known, with the one most like it
    """
    known = (keywords_of(function) | set(also)) - set(without)
    for name in given:
        if name not in known:
            public = sorted(name for name in known if not name.startswith("_"))
            nearest = difflib.get_close_matches(str(name), public, n=1)  # in a YAML file, it may be a number
            advice = f"did you mean {nearest[0]}?" if nearest else f"expected one of {public}."
            raise ValueError(f"{owner} has no setting {name!r}: {advice}")
