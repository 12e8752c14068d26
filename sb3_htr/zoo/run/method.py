"""What is compared: a method, by one name."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import yaml

from sb3_htr.zoo.run.shipped import hyperparams_file

DEFAULT = "htr-ser"
PRIOR = "-prior"


@dataclass(frozen=True)
class Method:
    """
    Everything that two methods may differ in; all else is a setting of the env.

    :param name: in commands, folders, tables and pictures
    :param label: for people
    :param relabeller: name of a :class:`sb3_htr.htr.Relabeller`
    :param relabel_probability: K
    :param rl_reward_type: reward of the RL batch
    :param train_explorer: name of the :class:`sb3_htr.adaptation.Explorer` of rollouts
    :param explorer: the same at meta-test
    """

    name: str
    label: str
    relabeller: str
    relabel_probability: float
    rl_reward_type: str
    train_explorer: str
    explorer: str

    def hyperparams(self) -> dict[str, Any]:
        """
        :return: arguments of PEARL
        """
        return {
            "train_explorer": {"name": self.train_explorer},
            "explorer": {"name": self.explorer},
            "replay_buffer_kwargs": {
                "relabeller": {"name": self.relabeller},
                "relabel_probability": self.relabel_probability,
                "rl_reward_type": self.rl_reward_type,
            },
        }

    def under_prior(self) -> "Method":
        """
        :return: the same method under PEARL's own protocol
        """
        return replace(
            self,
            name=f"{self.name}{PRIOR}",
            label=f"{self.label}, PEARL's protocol",
            train_explorer="prior",
            explorer="prior",
        )


@cache
def methods() -> dict[str, Method]:
    """
    :return: all methods by their names, in the order in which tables and pictures have them
    """
    content = yaml.safe_load(hyperparams_file("methods.yml").read_text())
    own = [Method(name, **settings) for name, settings in content.items()]
    return {method.name: method for method in (*own, *(method.under_prior() for method in own))}


def get_method(name: str) -> Method:
    """
    :param name: of a method
    :return: the method
    :raises ValueError: if there is none of this name
    """
    if name not in methods():
        raise ValueError(f"The method is {name!r}, expected one of {', '.join(methods())}.")
    return methods()[name]


def merged(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """
    :param first: settings
    :param second: win where both have one; dicts are joined, and so are a name and the settings of what it names
    :return: both
    """
    result = dict(first)
    for key, value in second.items():
        before = result.get(key)
        if isinstance(before, str) and isinstance(value, dict):
            before = {"name": before}
        result[key] = merged(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return result
