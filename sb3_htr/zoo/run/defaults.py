"""The arguments of a training: what `sb3-htr train` puts in front of a user's for rl_zoo3's train, where later ones win."""

from collections.abc import Sequence
from itertools import takewhile
from typing import Any

from sb3_htr.zoo.run.algorithm import Algorithm
from sb3_htr.zoo.run.trust import WEIGHTS

# PEARL's reference adapts for as many episodes. One thread: two runs on two cores must not fight for them
ALWAYS = {"--num-threads": "1", "--save-freq": "20000", "--eval-episodes": "20"}


def default_arguments(algorithm: Algorithm) -> list[str]:
    """
    :param algorithm: that is trained
    :return: options, each with one value
    """
    options = {"--algo": algorithm.name, "-conf": algorithm.settings_file, **ALWAYS}
    return [word for option in options.items() for word in option]


def value_of(arguments: Sequence[str], *options: str) -> str | None:
    """
    :param arguments: of a run
    :param options: all names of one
    :return: what it was given, of several values all; None if it was not
    """
    given = None
    for i, word in enumerate(arguments):
        option, equals, value = word.partition("=")
        if option in options:
            behind = takewhile(lambda word: not word.startswith("-") or word[1:].isdigit(), arguments[i + 1 :])
            given = value if equals else " ".join(behind)
    return given


def training_facts(hyperparams: dict[str, Any], arguments: Sequence[str]) -> dict[str, Any]:
    """
    :param hyperparams: of a run
    :param arguments: likewise
    :return: what its training is, beside env, method, budget and seed: hyperparameters, evaluations, and whether it began with
        the weights of another
    """
    defaults = [word for option in ALWAYS.items() for word in option]
    options = (("--eval-episodes",), ("--eval-freq",), ("--eval-env-kwargs",), WEIGHTS)
    return {**hyperparams, **{names[0]: value_of([*defaults, *arguments], *names) for names in options}}


def given_arguments(arguments: Sequence[str]) -> list[str]:
    """
    :param arguments: of a run that was begun by this version, or by one with fewer defaults
    :return: what the user gave
    """
    given = list(arguments)
    while given[:1] and given[0] in ("--algo", "-conf", *ALWAYS):
        del given[:2]
    return given
