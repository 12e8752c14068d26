"""What a training in progress is between two rollouts, of any Stable-Baselines3 algorithm, as plain data."""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.random_state import get_generator_state, get_global_state, set_generator_state, set_global_state


def get_training_state(model: BaseAlgorithm, counters: Iterable[str]) -> dict[str, Any]:
    """
    :param model: between two rollouts
    :param counters: names of its attributes that are numbers and go on
    :return: tensors, numbers, strings, None: networks and optimizers, counters, statistics of episodes, random generators.
        Not the states of the envs, of which a rollout that begins with a reset has no need
    """
    assert model.env is not None
    log_ent_coef = getattr(model, "log_ent_coef", None)
    return {
        "parameters": model.get_parameters(),
        "log_ent_coef": None if log_ent_coef is None else log_ent_coef.detach(),
        "counters": {name: getattr(model, name) for name in counters},
        "episode_infos": [{k: _tensor(v) for k, v in info.items()} for info in model.ep_info_buffer or ()],
        "episode_successes": [_tensor(success) for success in model.ep_success_buffer or ()],
        "random": {
            "global": get_global_state(),
            "envs": [get_generator_state(generator) for generator in model.env.get_attr("np_random")],
        },
    }


def set_training_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    All but the random generators, which follow by :func:`set_random_state` once everything is set up.

    :param model: that was just made, with the same settings
    :param state: of :func:`get_training_state`
    """
    model.set_parameters(state["parameters"], exact_match=True, device=model.device)
    if getattr(model, "log_ent_coef", None) is not None:
        model.log_ent_coef.data.copy_(state["log_ent_coef"])  # type: ignore[attr-defined]
    for name, value in state["counters"].items():
        setattr(model, name, value)
    infos = [{key: _number(value) for key, value in info.items()} for info in state["episode_infos"]]
    model.ep_info_buffer = deque(infos, maxlen=model._stats_window_size)
    successes = [_number(success) for success in state["episode_successes"]]
    model.ep_success_buffer = deque(successes, maxlen=model._stats_window_size)


def set_random_state(env: VecEnv, state: dict[str, Any]) -> None:
    """
    :param env: of the training
    :param state: ``"random"`` of :func:`get_training_state`
    """
    set_global_state(state["global"])
    for i, (generator, saved) in enumerate(zip(env.get_attr("np_random"), state["envs"], strict=True)):
        set_generator_state(generator, saved)
        env.set_attr("np_random", generator, indices=i)


def _tensor(value: Any) -> th.Tensor:
    """A number or array, with its dtype: means of float32 numbers are other ones than those of float64."""
    return th.from_numpy(np.array(value))


def _number(tensor: th.Tensor) -> Any:
    return tensor.cpu().numpy()[()]
