from sb3_htr.adaptation.explorers.aggregate import Aggregate
from sb3_htr.adaptation.explorers.base import Explorer, SelfExplorer
from sb3_htr.adaptation.explorers.belief import Belief
from sb3_htr.adaptation.explorers.learned_prior import LearnedPrior
from sb3_htr.adaptation.explorers.prior import FixedExploration, Prior
from sb3_htr.common.settings import check_own_name, make, register

#: Explorers by the names that settings, YAML files and commands have for them
EXPLORERS: dict[str, type[Explorer]] = {kind().name: kind for kind in (Belief, Prior, LearnedPrior, Aggregate)}


def register_explorer(kind: type[SelfExplorer]) -> type[SelfExplorer]:
    """
    Let settings, YAML files and commands name an explorer of one's own, by the name of its class in lower case. In a module
    that ``--gym-packages`` names, it is at hand in all commands, and they read models that were saved with it.

    :param kind: a class derived from :class:`Explorer`, whose settings are numbers and words
    :return: the class, so that this can decorate it
    :raises ValueError: for what is no such class, or has the name of another explorer
    """
    return register("explorer", kind, Explorer, EXPLORERS, str.lower)


def to_explorer(explorer: object, setting: str = "explorer") -> Explorer:
    """
    :param explorer: an :class:`Explorer`, its name, or its name and settings, such as
        ``{"name": "prior", "n_exploration_episodes": 9}``
    :param setting: that chooses it, for messages
    :return: an explorer with these settings
    :raises ValueError: for an unknown name or setting, or an object of a class that has the name of another one
    """
    made = make(setting, explorer, EXPLORERS, Explorer)
    check_own_name("explorer", type(made), EXPLORERS.get(made.name, type(made)), made.name)
    return made


__all__ = [
    "EXPLORERS",
    "Aggregate",
    "Belief",
    "Explorer",
    "FixedExploration",
    "LearnedPrior",
    "Prior",
    "register_explorer",
    "to_explorer",
]
