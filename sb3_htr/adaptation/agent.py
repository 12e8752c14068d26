"""What :meth:`sb3_htr.PEARL.adapt` returns."""

import numpy as np
from stable_baselines3.common.policies import BasePolicy


class AdaptedAgent:
    """
    A policy frozen for one task; has SB3's ``predict``, so that ``evaluate_policy`` and video recorders take it.

    :param policy: networks; shared with the model, which must not be trained on meanwhile
    :param z: (latent_dim,) float32, the task variable
    :param returns: (n_episodes,), returns of the adaptation episodes
    :param successes: (n_episodes,) bool, whether each adaptation episode solved the task
    """

    def __init__(self, policy: BasePolicy, z: np.ndarray, returns: np.ndarray, successes: np.ndarray) -> None:
        self.policy = policy
        self.z = z
        self.returns = returns
        self.successes = successes

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: ignored, the agent has no memory
        :param episode_start: ignored
        :param deterministic: mean action instead of a sample
        :return: actions, and the state unchanged
        """
        actions, _ = self.policy.predict(observation, (self.z[None],), episode_start, deterministic)
        return actions, state
