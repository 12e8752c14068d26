from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.relabel.episode_clustering import EpisodeClustering
from sb3_htr.htr.relabel.hindsight_foresight import HindsightForesight
from sb3_htr.htr.relabel.hindsight_inference import HindsightInference
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy
from sb3_htr.htr.relabel.single_episode import SingleEpisodeRelabelling
from sb3_htr.htr.relabel.training_task import TrainingTaskRelabelling

# For YAML files
RELABELLERS: dict[str, type[Relabeller]] = {
    kind.__name__: kind for kind in (SingleEpisodeRelabelling, EpisodeClustering, HindsightForesight, HindsightInference)
}

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
]
