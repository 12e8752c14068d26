"""Rivals that learn from a replay."""

from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.checks import check_has_env, get_max_episode_steps, warn_without_updates
from sb3_htr.common.settings import check_entropy
from sb3_htr.rivals.base import Rival

SelfOffPolicyRival = TypeVar("SelfOffPolicyRival", bound="OffPolicyRival")


class OffPolicyRival(Rival, OffPolicyAlgorithm):
    """
    A mixin for off-policy algorithms of Stable-Baselines3. A rollout is one episode of each env, or as many steps where
    episodes end early; ``gradient_steps`` updates follow, -1 for as many as it had env steps. Checkpoints have the replay.
    """

    ACTS_WITH: ClassVar[dict[str, Any]] = {"buffer_size": 1}
    FOLLOWS: ClassVar[dict[str, str]] = {
        **Rival.FOLLOWS,
        "train_freq": "a rollout is an episode of each env",
        "optimize_memory_usage": "a replay in a checkpoint does without",
    }

    def _check_ranges(self, settings: dict[str, Any]) -> None:
        check_entropy(settings.get("ent_coef", 0.0), settings.get("target_entropy", "auto"))
        super()._check_ranges({name: value for name, value in settings.items() if name != "ent_coef"})

    def _setup_model(self) -> None:
        if self.env is not None:
            self._set_rollout(self.env)
        super()._setup_model()

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: env of the same spaces and number of copies
        :param force_reset: reset before training goes on
        """
        super().set_env(env, force_reset)
        assert self.env is not None
        self._set_rollout(self.env)

    def _set_rollout(self, env: VecEnv) -> None:
        self.train_freq = TrainFreq(get_max_episode_steps(env), TrainFrequencyUnit.STEP)  # type: ignore[assignment]

    @property
    def n_steps_per_rollout(self) -> int:
        return self.train_freq.frequency * self.n_envs  # type: ignore[union-attr]

    def learn(self: SelfOffPolicyRival, total_timesteps: int, *args: Any, **kwargs: Any) -> SelfOffPolicyRival:
        check_has_env(self.env)
        if self.buffer_size < self.n_steps_per_rollout:
            raise ValueError(
                f"buffer_size is {self.buffer_size}, and a rollout has {self.n_steps_per_rollout} steps, an episode of each "
                "env: give it as many or more, because episodes would be overwritten before anything is learnt of them."
            )
        n_updates = self._n_updates
        super().learn(total_timesteps, *args, **kwargs)
        if total_timesteps > 0:
            warn_without_updates(self, n_updates)
        return self

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As the library's, but logs are so many rollouts apart, and not episodes."""
        kwargs.pop("log_interval", None)
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if rollout.continue_training and self.logs_now():
            self.dump_logs()
        return rollout

    def begin_rollout(self) -> None:
        super().begin_rollout()
        assert self.replay_buffer is not None
        end_episodes(self.replay_buffer)
        if self.action_noise is not None:
            self.action_noise.reset()

    def state_dict(self) -> dict[str, Any]:
        assert self.replay_buffer is not None
        return {**super().state_dict(), "replay": replay_state(self.replay_buffer)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        assert self.replay_buffer is not None
        check_replay_fits(self.replay_buffer, state["replay"])
        super().load_state_dict(state)
        load_replay_state(self.replay_buffer, state["replay"])


def end_episodes(buffer: ReplayBuffer) -> None:
    """
    Cut short the episodes that are not complete, because all envs are reset: returns of several steps end there.

    :param buffer: of Stable-Baselines3
    """
    if buffer.size() > 0:
        buffer.timeouts[buffer.pos - 1] = np.maximum(buffer.timeouts[buffer.pos - 1], 1 - buffer.dones[buffer.pos - 1])
        buffer.dones[buffer.pos - 1] = 1


def replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """
    :param buffer: of Stable-Baselines3
    :return: what it stores, as tensors and numbers, for :func:`load_replay_state`
    """
    arrays = {name: th.from_numpy(array[: buffer.size()].copy()) for name, array in _arrays(buffer).items()}
    return {"arrays": arrays, "pos": buffer.pos, "full": buffer.full}


def check_replay_fits(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """
    :param buffer: of Stable-Baselines3
    :param state: of :func:`replay_state`
    :raises ValueError: if the buffer has no room for it, other ends, or another number of envs
    """
    n_saved, n_envs = state["arrays"]["rewards"].shape
    fits = n_saved == buffer.buffer_size if state["full"] else n_saved <= buffer.buffer_size
    if not fits or n_envs != buffer.n_envs:
        raise ValueError(
            f"The replay of the training has {n_saved} steps of each of {n_envs} envs, and the buffer is of "
            f"{buffer.buffer_size} of each of {buffer.n_envs}: give the model the training's buffer_size, and as many envs."
        )


def load_replay_state(buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """
    :param buffer: with the settings of the one that the state is of, see :func:`check_replay_fits`
    :param state: of :func:`replay_state`
    """
    n_saved = len(state["arrays"]["rewards"])
    for name, array in _arrays(buffer).items():
        array[:n_saved] = state["arrays"][name].cpu().numpy()
        # HER draws whatever is of a whole episode. Where nothing was stored, memory is not yet taken
        array[n_saved : buffer.size()] = 0
    buffer.pos, buffer.full = state["pos"], state["full"]


def _arrays(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """All of its arrays with a row for each step; those of dicts by two names. Infos are objects, and left out."""
    named = dict(vars(buffer))
    for name, value in vars(buffer).items():
        if isinstance(value, dict):
            named |= {f"{name}/{key}": array for key, array in value.items()}
    return {
        name: value
        for name, value in named.items()
        if isinstance(value, np.ndarray) and value.dtype != object and value.shape[:1] == (buffer.buffer_size,)
    }
