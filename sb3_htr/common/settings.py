"""Objects that a user chooses by a name, by a name with settings (as YAML files do), or brings along."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

from sb3_htr.common.checks import check_keywords

Kind = TypeVar("Kind")


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
    given = {"name": value} if isinstance(value, str) else value
    name = given.get("name") if isinstance(given, Mapping) else None
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(
            f"{setting} is {value!r}, expected one of {sorted(kinds)}, {{'name': one of them, and its settings}}, or an "
            f"object derived from {base.__name__}."
        )
    settings = {key: item for key, item in given.items() if key != "name"}
    check_keywords(f"{setting} {name!r}", settings, kinds[name])
    return kinds[name](**settings)
