from sb3_htr.pearl.encoder import register_encoder
from sb3_htr.pearl.pearl import PEARL
from sb3_htr.pearl.policies import MlpPolicy
from sb3_htr.pearl.untrusted import load_untrusted

__all__ = ["PEARL", "MlpPolicy", "load_untrusted", "register_encoder"]
