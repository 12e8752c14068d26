"""Rivals of unknown origin."""

import copy
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym

from sb3_htr.common.checks import check_recorded_spaces
from sb3_htr.common.errors import OPEN_ERRORS, last_line
from sb3_htr.common.safe_load import read_model
from sb3_htr.rivals.base import Rival

SelfRival = TypeVar("SelfRival", bound=Rival)
# How large networks may be: below a gigabyte
MAX_LAYERS, MAX_UNITS = 4, 1024
# What a file may say of networks, with the largest number for each
NETWORKS = {"net_arch": MAX_UNITS, "lstm_hidden_size": MAX_UNITS, "n_lstm_layers": MAX_LAYERS}
NETWORKS |= dict.fromkeys(("shared_lstm", "enable_critic_lstm"), 1)
# What says how weights begin and how they are learnt, and nothing of those in a file
OF_TRAINING = ("log_std_init", "ortho_init", "optimizer_kwargs")
# The largest number of what else it may say
MAX_COUNT = 10_000


def load_untrusted(
    model_class: type[SelfRival], path: Path, hyperparams: dict[str, Any], env: gym.Env, device: str
) -> SelfRival:
    """
    Load weights and plain settings without running code of the file, and in no more memory than agents of this kind need.

    :param model_class: of the model
    :param path: file of ``save``
    :param hyperparams: of its training
    :param env: env of the same spaces
    :param device: torch device
    :return: a model to adapt and evaluate with
    :raises OSError: if there is no such file, or it cannot be opened
    :raises ValueError: if it is no such file, its weights do not fit the settings, or its spaces the env
    """
    try:
        data, weights = read_model(path, ["policy"])
        n_steps = data["num_timesteps"]
        policy_kwargs = plain_policy(model_class, hyperparams)
        counts = {name: hyperparams[name] for name in model_class.ACTS_BY if name in hyperparams}
        if type(n_steps) is not int or not all(_is_plain(count, MAX_COUNT) for count in counts.values()):
            raise ValueError(f"it has {n_steps} env steps and the settings {counts}")
        settings = {**counts, **model_class.ACTS_WITH}
        model = model_class(model_class.DEFAULT_POLICY, env, device=device, policy_kwargs=policy_kwargs, **settings)
        model.policy.load_state_dict(weights["policy"])
    except OPEN_ERRORS:
        raise
    except Exception as error:  # whatever a stranger can put into a file
        why = last_line(error) if isinstance(error, ValueError | RuntimeError) else ""
        raise ValueError(f"{path} is damaged, or no {model_class.__name__} with the settings of its record: {why}") from None
    check_recorded_spaces(model, data)
    model.num_timesteps = n_steps
    return model


def plain_policy(model_class: type[Rival], hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    :param model_class: of a model
    :param hyperparams: of its training
    :return: settings of its policy that make the same networks
    :raises ValueError: if it has others than a file of unknown origin may have
    """
    if (policy := hyperparams.get("policy", model_class.DEFAULT_POLICY)) != model_class.DEFAULT_POLICY:
        raise ValueError(f"its policy is {policy}, which only --trust restores, and that may run code of the file")
    sizes = {**NETWORKS, **model_class.POLICY_SIZES}
    # A copy, because SB3 adds to it
    given = copy.deepcopy(hyperparams.get("policy_kwargs") or {})
    plain = {name: value for name, value in given.items() if name not in OF_TRAINING}
    for name, value in plain.items():
        parts = value.values() if isinstance(value, dict) else [value]
        if name not in sizes or not all(_is_plain(part, sizes[name]) for part in parts):
            hint = f", unless POLICY_SIZES of {model_class.__name__} names it" if name not in sizes else ""
            raise ValueError(
                f"its policy has {name}: {value}, which only --trust restores{hint}, and that may run code of the file"
            )
    return plain


def _is_plain(value: Any, largest: int) -> bool:
    """Whether it is a number up to the largest, or a few of them."""
    numbers = value if isinstance(value, list) else [value]
    return len(numbers) <= MAX_LAYERS and all(type(n) in (int, bool) and n <= largest for n in numbers)
