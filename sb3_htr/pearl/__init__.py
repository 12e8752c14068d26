from sb3_htr.pearl.files import load_untrusted
from sb3_htr.pearl.pearl import PEARL
from sb3_htr.pearl.policies import MlpPolicy

__all__ = ["PEARL", "MlpPolicy", "load_untrusted"]
