"""All that a meta-training in progress is, as plain data, between two rollouts."""

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_htr.common.random_state import get_generator_state, get_global_state, set_generator_state, set_global_state

if TYPE_CHECKING:
    from sb3_htr.pearl.pearl import PEARL

COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_n_rollouts", "_current_progress_remaining")


def get_training_state(model: "PEARL") -> dict[str, Any]:
    """
    :param model: between two rollouts: a rollout begins with a reset of all envs, so theirs is not needed
    :return: networks, optimizers, replay, statistics and random generators, for :func:`set_training_state`
    """
    assert model.replay_buffer is not None and model.task_bank is not None and model.env is not None
    return {
        "parameters": model.get_parameters(),
        "log_ent_coef": None if model.log_ent_coef is None else model.log_ent_coef.detach(),
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "task_queue": th.from_numpy(model._task_queue.copy()),
        "episode_infos": [{k: _tensor(v) for k, v in info.items()} for info in model.ep_info_buffer or ()],
        "episode_successes": [_tensor(success) for success in model.ep_success_buffer or ()],
        "replay": model.replay_buffer.state_dict(),
        "task_bank": model.task_bank.state_dict(),
    }


def set_training_state(model: "PEARL", state: dict[str, Any]) -> None:
    """
    :param model: made with the same settings
    :param state: of :func:`get_training_state`
    """
    assert model.replay_buffer is not None and model.task_bank is not None
    model.set_parameters(state["parameters"], exact_match=True, device=model.device)
    if model.log_ent_coef is not None:
        model.log_ent_coef.data.copy_(state["log_ent_coef"])
    for name, value in state["counters"].items():
        setattr(model, name, value)
    model._task_queue = state["task_queue"].numpy().copy()
    infos = [{key: _number(value) for key, value in info.items()} for info in state["episode_infos"]]
    model.ep_info_buffer = deque(infos, maxlen=model._stats_window_size)
    successes = [_number(success) for success in state["episode_successes"]]
    model.ep_success_buffer = deque(successes, maxlen=model._stats_window_size)
    model.replay_buffer.load_state_dict(state["replay"])
    model.task_bank.load_state_dict(state["task_bank"])


def get_env_state(model: "PEARL") -> dict[str, Any]:
    """
    :param model: in training
    :return: states of all random generators that its training draws from, those of the envs among them, and the statistics of
        observations: all that the reset of the envs changes with which a training is set up
    """
    assert model.env is not None
    normalize = model.get_vec_normalize_env()
    return {
        "global": get_global_state(),
        "model": get_generator_state(model._rng),
        "envs": [get_generator_state(generator) for generator in model.env.get_attr("np_random")],
        "normalize": {} if normalize is None else {key: _tensor(value) for key, value in vars(normalize.obs_rms).items()},
    }


def set_env_state(model: "PEARL", state: dict[str, Any]) -> None:
    """
    :param model: in training; its envs are not reset again before the next rollout
    :param state: of :func:`get_env_state`
    """
    assert model.env is not None
    set_global_state(state["global"])
    set_generator_state(model._rng, state["model"])
    for i, (generator, saved) in enumerate(zip(model.env.get_attr("np_random"), state["envs"], strict=True)):
        set_generator_state(generator, saved)
        model.env.set_attr("np_random", generator, indices=i)
    normalize = model.get_vec_normalize_env()
    for key, value in state["normalize"].items():
        setattr(normalize.obs_rms, key, _number(value))  # type: ignore[union-attr]


def _tensor(value: Any) -> th.Tensor:
    """A number or array, with its dtype: means of float32 numbers are other ones than those of float64."""
    return th.from_numpy(np.array(value))


def _number(tensor: th.Tensor) -> Any:
    return tensor.cpu().numpy()[()]
