"""What a training in progress is between two rollouts, of any Stable-Baselines3 algorithm, as plain data."""

from collections import deque
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_htr.common.random_state import (
    get_env_states,
    get_generator_state,
    get_global_state,
    set_env_states,
    set_generator_state,
    set_global_state,
)


class Resumable(BaseAlgorithm):
    """
    A mixin for algorithms of Stable-Baselines3 whose training goes on exactly where it was. A rollout must begin with a reset
    of all envs, so that of their states only the random generators are needed.
    """

    #: Names of attributes that are numbers and go on
    COUNTERS: ClassVar[tuple[str, ...]] = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
    #: Takes effect once learn() has set everything up, which draws random numbers
    _pending_random: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """
        :return: everything that a training in progress is, between two rollouts, as tensors, numbers, strings and None; for
            :meth:`load_state_dict`. A copy: training on does not change it
        """
        log_ent_coef = getattr(self, "log_ent_coef", None)
        return {
            "parameters": deepcopy(self.get_parameters()),
            "log_ent_coef": None if log_ent_coef is None else log_ent_coef.detach().clone(),
            "counters": {name: getattr(self, name) for name in self.COUNTERS},
            "episode_infos": [{k: _tensor(v) for k, v in info.items()} for info in self.ep_info_buffer or ()],
            "episode_successes": [_tensor(success) for success in self.ep_success_buffer or ()],
            "random": self._get_random_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        The random generators follow when ``learn(remaining steps, reset_num_timesteps=False)`` begins.

        :param state: of :meth:`state_dict` of a model with the same settings
        """
        # A copy, too: an optimizer would train on in the numbers of the state
        self.set_parameters(deepcopy(state["parameters"]), exact_match=True, device=self.device)
        if getattr(self, "log_ent_coef", None) is not None:
            self.log_ent_coef.data.copy_(state["log_ent_coef"])  # type: ignore[attr-defined]
        for name in self.COUNTERS:
            setattr(self, name, state["counters"][name])
        infos = [{key: _number(value) for key, value in info.items()} for info in state["episode_infos"]]
        self.ep_info_buffer = deque(infos, maxlen=self._stats_window_size)
        successes = [_number(success) for success in state["episode_successes"]]
        self.ep_success_buffer = deque(successes, maxlen=self._stats_window_size)
        self._pending_random = state["random"]

    def _get_random_state(self) -> dict[str, Any]:
        assert self.env is not None
        # Random actions at the beginning are SB3's
        actions = get_generator_state(self.action_space.np_random)
        return {"global": get_global_state(), "envs": get_env_states(self.env), "actions": actions}

    def _set_random_state(self, state: dict[str, Any]) -> None:
        assert self.env is not None
        if len(state["envs"]) != self.env.num_envs:
            raise ValueError(
                f"The training had {len(state['envs'])} envs, and goes on with {self.env.num_envs}: give it as many."
            )
        set_global_state(state["global"])
        set_generator_state(self.action_space.np_random, state["actions"])
        set_env_states(self.env, state["envs"])

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(*args, **kwargs)
        if self._pending_random is not None:
            self._set_random_state(self._pending_random)
            self._pending_random = None
        return result

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_pending_random"]


def _tensor(value: Any) -> Any:
    """A number or array of numpy, with its dtype: means of float32 are other ones than those of float64. All else is kept."""
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufc":
        return th.from_numpy(np.array(value))
    return str(value) if isinstance(value, str) else value  # numpy has texts of its own


def _number(tensor: Any) -> Any:
    return tensor.cpu().numpy()[()] if isinstance(tensor, th.Tensor) else tensor
