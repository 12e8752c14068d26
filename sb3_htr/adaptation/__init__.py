from sb3_htr.adaptation.adaptation import Adaptation, Step
from sb3_htr.adaptation.agent import AdaptedAgent
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.adaptation.evaluation import evaluate_adaptation
from sb3_htr.adaptation.explorers import Aggregate, Belief, Explorer, LearnedPrior, Prior, register_explorer

__all__ = [
    "Adaptation",
    "AdaptedAgent",
    "Aggregate",
    "Belief",
    "Explorer",
    "LearnedPrior",
    "MetaEvalCallback",
    "Prior",
    "Step",
    "evaluate_adaptation",
    "register_explorer",
]
