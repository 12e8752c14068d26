from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.relabel.episode_clustering import EpisodeClustering
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy
from sb3_htr.htr.relabel.single_episode import SingleEpisodeRelabelling

# For YAML files
RELABELLERS: dict[str, type[Relabeller]] = {
    "SingleEpisodeRelabelling": SingleEpisodeRelabelling,
    "EpisodeClustering": EpisodeClustering,
}

__all__ = [
    "RELABELLERS",
    "EpisodeClustering",
    "HindsightDraw",
    "HindsightTaskStrategy",
    "Relabeller",
    "SingleEpisodeRelabelling",
]
