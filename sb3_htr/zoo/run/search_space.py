"""Hyperparameters that ``sb3-htr optimize`` searches through, of each algorithm."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_htr.htr import HindsightTaskStrategy

if TYPE_CHECKING:
    import optuna

ONE_MINUS, POW = "one_minus_", "_pow"


@dataclass(frozen=True)
class SearchSpace:
    """
    What is sampled, by name. ``one_minus_X`` is 1 - X, and ``X_pow`` the X-th power of 2.

    :param floats: ends of ranges, drawn from their logarithm
    :param ints: ends of ranges
    :param choices: values; or, as in rl_zoo3, names of such
    :param within: of names that are not arguments of the algorithm, the arguments they are within, from the outermost one
    :param learning_rate_falls: to 0 at the end of the training
    """

    floats: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ints: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    choices: Mapping[str, Collection[Any] | Mapping[str, Any]] = field(default_factory=dict)
    within: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    learning_rate_falls: bool = False

    def sample(self, trial: "optuna.Trial", without: Collection[str] = ()) -> dict[str, Any]:
        """
        :param trial: draws the values
        :param without: names of arguments that are not sampled, because somebody has chosen them or the method has no use for
            them
        :return: arguments of the algorithm, as a YAML file of rl_zoo3 has them
        """
        draws: dict[str, Callable[[], Any]] = {
            **{name: partial(trial.suggest_float, name, *ends, log=True) for name, ends in self.floats.items()},
            **{name: partial(trial.suggest_int, name, *ends) for name, ends in self.ints.items()},
            **{name: partial(trial.suggest_categorical, name, [*values]) for name, values in self.choices.items()},
        }
        return self.convert({name: draw() for name, draw in draws.items() if _argument(name) not in without})

    def convert(self, sampled_params: dict[str, Any]) -> dict[str, Any]:
        """
        :param sampled_params: of a trial
        :return: arguments of the algorithm, as a YAML file of rl_zoo3 has them
        :raises ValueError: for what is not sampled here
        """
        converted: dict[str, Any] = {}
        for name, value in sampled_params.items():
            values = self.choices.get(name, ())
            if name not in self.floats and name not in self.ints and value not in values:
                raise ValueError(
                    f"The trial has {name} {value!r}, which sb3-htr optimize does not try: it is of another program."
                )
            owner = converted
            for outer in self.within.get(name, ()):
                owner = owner.setdefault(outer, {})
            if isinstance(values, Mapping):
                value = values[value]
            elif name.startswith(ONE_MINUS):
                value = 1 - value
            elif name.endswith(POW):
                value = 2**value
            elif name == "learning_rate" and self.learning_rate_falls:
                value = f"lin_{value}"
            owner[_argument(name)] = value
        return converted


def _argument(name: str) -> str:
    """Which argument is sampled by this name."""
    return name.removesuffix(POW).removeprefix(ONE_MINUS)


ARCHS = {"small": [64, 64], "medium": [128, 128]}
# Episodes have some tens to hundreds of steps, which is what the discount must reach over
OF_ALL = {"learning_rate": (1e-4, 3e-3), "one_minus_gamma": (0.005, 0.2)}

# Settings of relabellers, of which each has some
OF_RELABELLERS = ("hindsight_task_strategy", "temperature")

PEARL = SearchSpace(
    floats={
        **OF_ALL,
        "tau": (0.002, 0.05),
        "ent_coef": (1e-3, 1e-1),
        "kl_coef": (1e-4, 1e-1),
        "temperature": (1e-3, 1.0),  # of what is relabelled under training tasks
    },
    ints={
        "n_steps": (1, 10),
        "learning_starts": (0, 20_000),  # what learns of training tasks alone waits until chance has met one
        "batch_size_pow": (3, 8),
        "meta_batch_size_pow": (3, 6),
        "gradient_steps_pow": (6, 9),
        "latent_dim": (2, 8),
    },
    choices={
        "net_arch": {**ARCHS, "paper": [300, 300, 300]},
        "encoder_arch": {**ARCHS, "paper": [200, 200, 200]},
        "relabel_probability": (0.1, 0.3, 0.5, 0.8, 1.0),  # HTR paper, A.2
        "hindsight_task_strategy": [strategy.value for strategy in HindsightTaskStrategy],
    },
    within={
        **dict.fromkeys(("net_arch", "encoder_arch", "latent_dim"), ("policy_kwargs",)),
        "relabel_probability": ("replay_buffer_kwargs",),
        **dict.fromkeys(OF_RELABELLERS, ("replay_buffer_kwargs", "relabeller")),
    },
    learning_rate_falls=True,  # as PEARL's default does
)

# What rl_zoo3 samples of recurrent PPO, but for what a trial settles: steps of a rollout and of a minibatch; and wider where
# the best of 50 trials were at the edge of its ranges (0.2 and 0.3), or near it (20 epochs)
RL2 = SearchSpace(
    # The discount must reach over a trial, of several episodes
    floats={
        **OF_ALL,
        "one_minus_gamma": (0.001, 0.2),
        "one_minus_gae_lambda": (0.005, 0.5),
        "ent_coef": (1e-4, 1e-1),
        "max_grad_norm": (0.1, 2.0),
    },
    ints={"n_epochs": (2, 40), "lstm_hidden_size_pow": (5, 8)},
    choices={"clip_range": (0.1, 0.2, 0.3), "net_arch": ARCHS},
    within=dict.fromkeys(("lstm_hidden_size_pow", "net_arch"), ("policy_kwargs",)),
)

SAC_HER = SearchSpace(
    floats={**OF_ALL, "tau": (0.002, 0.05), "ent_coef": (1e-3, 1e-1)},
    ints={"batch_size_pow": (6, 10), "n_sampled_goal": (1, 8)},
    choices={"net_arch": {**ARCHS, "large": [256, 256]}},
    within={"net_arch": ("policy_kwargs",), "n_sampled_goal": ("replay_buffer_kwargs",)},
)
