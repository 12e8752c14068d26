"""Hyperparameters that ``sb3-htr optimize`` searches through."""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_htr.htr import HindsightTaskStrategy

if TYPE_CHECKING:
    import optuna

# As in rl_zoo3, layers are sampled by name
NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "paper": [300, 300, 300]}
# HTR paper, A.2
RELABEL_PROBABILITIES = (0.1, 0.3, 0.5, 0.8, 1.0)
STRATEGIES = [strategy.value for strategy in HindsightTaskStrategy]
ENCODER_ARCHS = {"small": [64, 64], "medium": [128, 128], "paper": [200, 200, 200]}
ARCHS = {"net_arch": NET_ARCHS, "encoder_arch": ENCODER_ARCHS}


# Drawn from their logarithm. The learning rate is that of the beginning, and falls to 0 as PEARL's default does; episodes have
# some tens to hundreds of steps, which is what the discount must reach over
FLOATS = {
    "learning_rate": (1e-4, 3e-3),
    "one_minus_gamma": (0.005, 0.2),
    "tau": (0.002, 0.05),
    "ent_coef": (1e-3, 1e-1),
    "kl_coef": (1e-4, 1e-1),
}
INTS = {
    "n_steps": (1, 10),
    "batch_size_pow": (3, 8),
    "meta_batch_size_pow": (3, 6),
    "gradient_steps_pow": (6, 9),
    "latent_dim": (2, 8),
}


def sample_pearl_params(
    trial: "optuna.Trial", relabels: bool = True, chooses_states: bool = True, given: Collection[str] = ()
) -> dict[str, Any]:
    """
    :param trial: draws the values
    :param relabels: whether the method relabels; how often it does is sampled then
    :param chooses_states: whether its hindsight tasks are states that an episode reached; which ones is sampled then
    :param given: names of arguments that somebody has chosen already: they are not sampled
    :return: arguments of PEARL, as a YAML file of rl_zoo3 has them
    """
    choices: dict[str, Sequence[Any]] = {"net_arch": list(NET_ARCHS), "encoder_arch": list(ENCODER_ARCHS)}
    if relabels:
        choices["relabel_probability"] = RELABEL_PROBABILITIES
    if relabels and chooses_states:
        choices["hindsight_task_strategy"] = STRATEGIES
    draws: dict[str, Callable[[], Any]] = {
        **{name: partial(trial.suggest_float, name, *ends, log=True) for name, ends in FLOATS.items()},
        **{name: partial(trial.suggest_int, name, *ends) for name, ends in INTS.items()},
        **{name: partial(trial.suggest_categorical, name, values) for name, values in choices.items()},
    }
    return convert_pearl_params({name: draw() for name, draw in draws.items() if _argument(name) not in given})


def _argument(name: str) -> str:
    """Which argument is sampled by this name."""
    return name.removesuffix("_pow").removeprefix("one_minus_")


def convert_pearl_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: of a trial
    :return: arguments of PEARL, as a YAML file of rl_zoo3 has them
    """
    policy: dict[str, Any] = {}
    replay: dict[str, Any] = {}
    converted: dict[str, Any] = {}
    for name, value in sampled_params.items():
        if name == "one_minus_gamma":
            converted["gamma"] = 1 - value
        elif name == "learning_rate":
            converted[name] = f"lin_{value}"
        elif name.endswith("_pow"):
            converted[_argument(name)] = 2**value
        elif name == "latent_dim":
            policy[name] = value
        elif name in ARCHS and value in ARCHS[name]:
            policy[name] = ARCHS[name][value]
        elif name == "relabel_probability":
            replay[name] = value
        elif name == "hindsight_task_strategy":
            replay["relabeller"] = {name: value}
        elif name in FLOATS or name in INTS:
            converted[name] = value
        else:
            raise ValueError(f"The trial has {name} {value!r}, which sb3-htr optimize does not try: it is of another program.")
    nested = {"policy_kwargs": policy, "replay_buffer_kwargs": replay}
    return {**converted, **{name: kwargs for name, kwargs in nested.items() if kwargs}}
