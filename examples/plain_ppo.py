"""A rival of your own, and what needs to be said of one: PPO that is not told its task and remembers nothing.

    sb3-htr train --env SparsePointRobot-v0 --gym-packages examples.plain_ppo --method plain-ppo
    sb3-htr experiment plain_ppo --gym-packages examples.plain_ppo --with-results results/rivals

The second command trains this method alone, and writes one table and one picture of it beside the rivals that were trained
before. It is a floor: what a policy gets that cannot adapt.
"""

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_htr.adaptation.loop import Adapting
from sb3_htr.experiments.grid import EXPERIMENTS, Experiment, Variant
from sb3_htr.rivals.adaptation import RivalAdaptation
from sb3_htr.rivals.on_policy import OnPolicyRival
from sb3_htr.zoo.run.algorithm import register_algorithm
from sb3_htr.zoo.run.method import register_method


class Unadapted(RivalAdaptation):
    """Acts on each task as on any other."""

    def __init__(self, policy: ActorCriticPolicy, n_envs: int) -> None:
        super().__init__(n_envs)
        self.policy = policy

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        actions, _ = self.policy.predict(obs, deterministic=deterministic)
        return self.policy.scale_action(actions)


class PlainPPO(OnPolicyRival, PPO):
    """PPO on envs of a task family, with the arguments of ``PPO``."""

    DEFAULT_POLICY: ClassVar[str] = "MlpPolicy"
    policy: ActorCriticPolicy

    def _adaptation(self, n_envs: int, generator: th.Generator | None) -> Adapting:
        return Unadapted(self.policy, n_envs)


register_algorithm("ppo", PlainPPO, Path(__file__).with_suffix(".yml"), "It is not told its task, and does not adapt.")
register_method("plain-ppo", algorithm="ppo", about="PPO (Schulman et al., 2017) without adaptation")

RIVALS = EXPERIMENTS["rivals"]
EXPERIMENTS["plain_ppo"] = Experiment(
    "plain_ppo",
    "PPO without adaptation beside the rivals.",
    RIVALS.env_id,
    RIVALS.n_timesteps,
    (*RIVALS.variants, Variant("plain-ppo", budget=10)),
    evaluations=RIVALS.evaluations,
    figure=RIVALS.figure,
)
