from sb3_htr.adaptation.explorers.aggregate import Aggregate
from sb3_htr.adaptation.explorers.base import Explorer
from sb3_htr.adaptation.explorers.belief import Belief
from sb3_htr.adaptation.explorers.learned_prior import LearnedPrior
from sb3_htr.adaptation.explorers.prior import FixedExploration, Prior
from sb3_htr.common.settings import make

# For YAML files
EXPLORERS: dict[str, type[Explorer]] = {kind().name: kind for kind in (Belief, Prior, LearnedPrior, Aggregate)}


def to_explorer(explorer: object) -> Explorer:
    """
    :param explorer: an :class:`Explorer`, its name, or its name and settings, such as
        ``{"name": "prior", "n_exploration_episodes": 9}``
    :return: an explorer with these settings
    :raises ValueError: for an unknown name or setting
    """
    return make("explorer", explorer, EXPLORERS, Explorer)


__all__ = ["EXPLORERS", "Aggregate", "Belief", "Explorer", "FixedExploration", "LearnedPrior", "Prior", "to_explorer"]
