"""What :meth:`sb3_htr.PEARL.adapt` returns."""

import os
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_htr.adaptation.actor_alone import acting_state, make_actor_alone
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import check_device
from sb3_htr.common.errors import OPEN_ERRORS
from sb3_htr.common.latent_policy import Obs, State
from sb3_htr.common.safe_load import load_plain
from sb3_htr.common.saving import with_suffix

FORMAT = 1


class AdaptedAgent:
    """
    A policy frozen for one task; has SB3's ``predict``, so that ``evaluate_policy`` and video recorders take it.

    :param policy: networks; shared with the model, which must not be trained on meanwhile
    :param z: (latent_dim,) float32, the task variable
    :param returns: (n_episodes,), returns of the adaptation episodes
    :param successes: (n_episodes,) bool, whether each adaptation episode solved the task
    :raises ValueError: for a z of another shape than the policy's, or without finite numbers
    """

    def __init__(self, policy: BasePolicy, z: np.ndarray, returns: np.ndarray, successes: np.ndarray) -> None:
        self.policy = policy
        self.z = np.array(z, dtype=np.float32)
        shape = (cast(Any, policy).latent_dim,)
        if self.z.shape != shape or not np.isfinite(self.z).all():
            raise ValueError(f"z is {self.z}, expected finite numbers of shape {shape}: of several envs, that of one.")
        self.returns = returns
        self.successes = successes

    def predict(
        self, observation: Obs, state: State = None, episode_start: np.ndarray | None = None, deterministic: bool = False
    ) -> tuple[np.ndarray, State]:
        """
        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: ignored, the agent has no memory
        :param episode_start: ignored
        :param deterministic: mean action instead of a sample
        :return: actions, and the state unchanged
        """
        actions, _ = self.policy.predict(observation, (self.z[None],), episode_start, deterministic)
        return actions, state

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Save what acting on this task takes: the actor, the normalization of observations, z. The file is small, is plain data,
        and needs no model to be used.

        :param path: file, ``.pt`` is added to a name without suffix; it is replaced at the end or not at all
        :raises ValueError: for an actor of one's own
        """
        arrays = {name: th.from_numpy(np.array(getattr(self, name))) for name in ("z", "returns", "successes")}
        with atomic_path(with_suffix(path, ".pt")) as temporary, open(temporary, "wb") as file:
            th.save({"format": FORMAT, "policy": acting_state(self.policy), **arrays}, file)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: th.device | str = "cpu") -> "AdaptedAgent":
        """
        :param path: file of :meth:`save`; reading it runs no code, whoever it is from
        :param device: torch device
        :return: an agent that acts as the one that was saved
        :raises OSError: if there is no such file, or it cannot be opened
        :raises ValueError: if it is another kind of file, or the device cannot be used; that there is no GPU is warned of
        """
        check_device(device)
        path = with_suffix(path, ".pt")
        try:
            state: dict[str, Any] = load_plain(path)
            if state["format"] != FORMAT:
                raise ValueError
            z, returns, successes = (state[name].numpy() for name in ("z", "returns", "successes"))
            (latent_dim,) = z.shape
            policy = make_actor_alone(state["policy"], latent_dim)
        except OPEN_ERRORS:
            raise
        except Exception:  # whatever a stranger can put into a file
            raise ValueError(f"{path} is damaged, or no agent saved by AdaptedAgent.save: nothing of it was loaded.") from None
        return cls(policy.to(get_device(device)), z, returns, successes)
