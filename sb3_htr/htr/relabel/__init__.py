from typing import TypeVar

from sb3_htr.common.settings import register
from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.relabel.episode_clustering import EpisodeClustering
from sb3_htr.htr.relabel.hindsight_foresight import HindsightForesight
from sb3_htr.htr.relabel.hindsight_inference import HindsightInference
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy
from sb3_htr.htr.relabel.single_episode import SingleEpisodeRelabelling
from sb3_htr.htr.relabel.training_task import TrainingTaskRelabelling

#: Relabellers by the names that settings and YAML files have for them
RELABELLERS: dict[str, type[Relabeller]] = {
    kind.__name__: kind for kind in (SingleEpisodeRelabelling, EpisodeClustering, HindsightForesight, HindsightInference)
}

SomeRelabeller = TypeVar("SomeRelabeller", bound=Relabeller)


def register_relabeller(kind: type[SomeRelabeller]) -> type[SomeRelabeller]:
    """
    Let settings and YAML files name a relabeller of one's own, by the name of its class. In a module that ``--gym-packages``
    names, it is at hand in all commands.

    :param kind: a class derived from :class:`Relabeller`
    :return: the class, so that this can decorate it
    :raises ValueError: for what is no such class, or has the name of another relabeller
    """
    return register("relabeller", kind, Relabeller, RELABELLERS)


__all__ = [
    "RELABELLERS",
    "EpisodeClustering",
    "HindsightDraw",
    "HindsightForesight",
    "HindsightInference",
    "HindsightTaskStrategy",
    "Relabeller",
    "SingleEpisodeRelabelling",
    "TrainingTaskRelabelling",
    "register_relabeller",
]
