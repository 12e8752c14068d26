from sb3_htr.pearl.pearl import PEARL
from sb3_htr.pearl.policies import MlpPolicy

__all__ = ["PEARL", "MlpPolicy"]
