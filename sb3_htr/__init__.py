"""Meta-reinforcement learning for Stable-Baselines3: PEARL with Hindsight Task Relabelling."""

from sb3_htr.adaptation.agent import AdaptedAgent
from sb3_htr.adaptation.evaluation import evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.common.versions import VERSION as __version__
from sb3_htr.htr import MultiTaskReplayBuffer
from sb3_htr.pearl import PEARL, load_untrusted

__all__ = [
    "PEARL",
    "AdaptedAgent",
    "MultiTaskReplayBuffer",
    "__version__",
    "evaluate_adaptation",
    "load_untrusted",
    "make_task_vec_env",
]
