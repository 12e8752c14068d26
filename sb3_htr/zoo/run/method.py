"""What is compared: a method, by one name."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import yaml

from sb3_htr.adaptation.explorers import EXPLORERS
from sb3_htr.common.settings import check_numbers, keywords_of, name_of
from sb3_htr.htr.relabel import RELABELLERS, TrainingTaskRelabelling
from sb3_htr.rivals.adaptation import OwnWay
from sb3_htr.zoo.run.algorithm import ALGORITHMS, Algorithm, PEARLAlgorithm, check_folder_name
from sb3_htr.zoo.run.search_space import OF_RELABELLERS
from sb3_htr.zoo.run.shipped import hyperparams_file

DEFAULT = "htr-ser"
PRIOR = "-prior"
# In place of an explorer's name, for agents that explore in a way of their own
OWN = OwnWay.name


@dataclass(frozen=True)
class Method:
    """
    An algorithm, and everything that two methods may differ in; all else is a setting of the env.

    :param name: in commands, folders, tables and pictures
    :param about: what it is, for model cards
    :param algorithm_name: of what trains it, see :data:`sb3_htr.zoo.run.algorithm.ALGORITHMS`
    """

    name: str
    about: str
    algorithm_name: str

    @property
    def algorithm(self) -> Algorithm:
        """What trains it."""
        return ALGORITHMS[self.algorithm_name]

    def settings(self, of_env: dict[str, Any]) -> dict[str, Any]:
        """
        :param of_env: hyperparameters of the env
        :return: the same, joined with those of the method
        """
        return of_env

    def set_otherwise(self, of_env: dict[str, Any]) -> list[str]:
        """
        :param of_env: hyperparameters of the env
        :return: those that the method replaces by others, in words
        """
        return []

    def not_searched(self) -> set[str]:
        """
        :return: names in the search space of its algorithm that say nothing of this method
        """
        return set()

    def explorer_for(self, name: str) -> str:
        """
        :param name: of an explorer that agents are to be evaluated with
        :return: the same, or how an agent without explorers explores
        """
        return OWN


@dataclass(frozen=True)
class PEARLMethod(Method):
    """
    PEARL, with or without relabelling.

    :param relabeller: name of a :class:`sb3_htr.htr.Relabeller`
    :param relabel_probability: K
    :param rl_reward_type: reward of the RL batch
    :param train_explorer: name of the :class:`sb3_htr.adaptation.Explorer` of rollouts
    :param explorer: the same at meta-test
    """

    relabeller: str
    relabel_probability: float
    rl_reward_type: str
    train_explorer: str
    explorer: str

    @property
    def is_htr(self) -> bool:
        """Whether experience is relabelled under tasks that it reached."""
        return self.relabel_probability > 0 and not issubclass(RELABELLERS[self.relabeller], TrainingTaskRelabelling)

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

    def settings(self, of_env: dict[str, Any]) -> dict[str, Any]:
        buffer = of_env.get("replay_buffer_kwargs", {})
        if isinstance(buffer.get("relabeller"), dict):
            # An env's settings for other relabellers say nothing about this one
            of_others = set().union(*map(keywords_of, RELABELLERS.values())) - self.relabeller_settings()
            relabeller = {key: value for key, value in buffer["relabeller"].items() if key not in of_others}
            of_env = {**of_env, "replay_buffer_kwargs": {**buffer, "relabeller": relabeller}}
        for key in ("explorer", "train_explorer"):
            if isinstance(of_env.get(key), dict) and getattr(self, key) in EXPLORERS:
                # Nor those for other explorers
                of_others = set().union(*map(keywords_of, EXPLORERS.values())) - keywords_of(EXPLORERS[getattr(self, key)])
                of_env = {**of_env, key: {name: value for name, value in of_env[key].items() if name not in of_others}}
        return merged(of_env, self.hyperparams())

    def set_otherwise(self, of_env: dict[str, Any]) -> list[str]:
        buffer = of_env.get("replay_buffer_kwargs", {})
        found = []
        for name in ("explorer", "train_explorer", "relabeller", "relabel_probability", "rl_reward_type"):
            value = name_of({**of_env, **buffer}.get(name))
            if value not in (None, getattr(self, name)):
                found.append(f"{name} {value!r}")
        return found

    def relabeller_settings(self) -> set[str]:
        """
        :return: names of the settings that its relabeller has
        """
        return keywords_of(RELABELLERS[self.relabeller])

    def not_searched(self) -> set[str]:
        if self.relabel_probability == 0:
            return {"relabel_probability", *OF_RELABELLERS}
        return {*OF_RELABELLERS} - self.relabeller_settings()

    def explorer_for(self, name: str) -> str:
        return name

    def under_prior(self) -> "PEARLMethod":
        """
        :return: the same method under PEARL's own protocol
        """
        return replace(self, name=f"{self.name}{PRIOR}", train_explorer="prior", explorer="prior")


@cache
def methods() -> dict[str, Method]:
    """
    :return: all methods by their names, in the order in which tables and pictures have them
    """
    content = yaml.safe_load(hyperparams_file("methods.yml").read_text(encoding="utf-8"))
    own = [_method(name, **settings) for name, settings in content.items()]
    under_prior = [method.under_prior() for method in own if isinstance(method, PEARLMethod)]
    return {method.name: method for method in (*own, *under_prior)}


def _method(name: str, about: str, algorithm: str = "pearl", **settings: Any) -> Method:
    kind = PEARLMethod if isinstance(ALGORITHMS.get(algorithm), PEARLAlgorithm) else Method
    return kind(name, " ".join(about.split()), algorithm, **settings)


def register_method(name: str, **settings: Any) -> None:
    """
    Add a method, and the same under PEARL's own protocol, to those of ``hyperparams/methods.yml``. In a module of one's own,
    which ``--gym-packages`` names, it is at hand in all commands.

    :param name: that no other method has
    :param settings: what a block of ``hyperparams/methods.yml`` says: ``about``, ``algorithm``, and for PEARL what
        :class:`PEARLMethod` has
    :raises ValueError: for a name that is taken, settings that are missing or not there, or an unknown relabeller, explorer
        or algorithm
    """
    check_folder_name("method", name)
    try:
        method = _method(name, **settings)
    except TypeError as error:
        raise ValueError(f"The method {name!r} is not whole, see hyperparams/methods.yml: {error}.") from None
    kinds: dict[str, Iterable[str]] = {
        "algorithm_name": ALGORITHMS,
        "relabeller": RELABELLERS,
        "train_explorer": EXPLORERS,
        "explorer": EXPLORERS,
        "rl_reward_type": ("sparse", "dense"),
    }
    for setting, known in kinds.items():
        value = getattr(method, setting, None)
        if value is not None and value not in list(known):
            raise ValueError(f"The {setting} of the method {name!r} is {value!r}, expected one of {sorted(known)}.")
    new = [method]
    if isinstance(method, PEARLMethod):
        check_numbers(relabel_probability=(method.relabel_probability, 0.0, 1.0))
        new.append(method.under_prior())
    if taken := [each.name for each in new if each.name in methods()]:
        raise ValueError(f"There is a method {taken[0]!r} already: choose another name.")
    methods().update({each.name: each for each in new})


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


def names_of(settings: Mapping[str, Any]) -> set[str]:
    """
    :param settings: may have dicts of settings
    :return: their names, and those of what is in the dicts
    """
    return {*settings}.union(*(names_of(value) for value in settings.values() if isinstance(value, Mapping)))
