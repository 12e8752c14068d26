from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.htr.relabel import EpisodeClustering, HindsightTaskStrategy, Relabeller, SingleEpisodeRelabelling

__all__ = ["EpisodeClustering", "HindsightTaskStrategy", "MultiTaskReplayBuffer", "Relabeller", "SingleEpisodeRelabelling"]
