from sb3_htr.adaptation.adaptation import Adaptation, Step
from sb3_htr.adaptation.agent import AdaptedAgent
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.adaptation.evaluation import evaluate_adaptation
from sb3_htr.adaptation.explorers import Aggregate, Explorer, Prior, Search

__all__ = [
    "Adaptation",
    "AdaptedAgent",
    "Aggregate",
    "Explorer",
    "MetaEvalCallback",
    "Prior",
    "Search",
    "Step",
    "evaluate_adaptation",
]
