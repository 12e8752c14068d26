from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.htr.relabel import (
    EpisodeClustering,
    HindsightDraw,
    HindsightForesight,
    HindsightInference,
    HindsightTaskStrategy,
    Relabeller,
    SingleEpisodeRelabelling,
    register_relabeller,
)

__all__ = [
    "EpisodeClustering",
    "HindsightDraw",
    "HindsightForesight",
    "HindsightInference",
    "HindsightTaskStrategy",
    "MultiTaskReplayBuffer",
    "Relabeller",
    "SingleEpisodeRelabelling",
    "register_relabeller",
]
