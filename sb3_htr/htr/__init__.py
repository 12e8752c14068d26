from sb3_htr.htr.episode_clustering import EpisodeClustering
from sb3_htr.htr.hindsight_task import HindsightTaskStrategy
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer

__all__ = ["EpisodeClustering", "HindsightTaskStrategy", "MultiTaskReplayBuffer"]
