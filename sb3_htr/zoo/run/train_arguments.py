"""The arguments of a training: what `sb3-htr train` puts in front of a user's for rl_zoo3's train, where later ones win."""

from collections.abc import Iterator, Sequence
from itertools import takewhile
from typing import Any

from sb3_htr.zoo.run.algorithm import Algorithm
from sb3_htr.zoo.run.trust import KEY_VALUES, WEIGHTS

# PEARL's reference adapts for as many episodes. One thread: two runs on two cores must not fight for them
ALWAYS = {"--num-threads": "1", "--save-freq": "20000", "--eval-episodes": "20"}
# Those of rl_zoo3 with one dash: with a value that may be in the same word, with values behind them or an "=", and with none
JOINED, APART, FLAGS = ("-n", "-f", "-i", "-tb"), ("-conf", "-params", "-tags"), ("-P", "-uuid", "-optimize", "-h")


def default_arguments(algorithm: Algorithm) -> list[str]:
    """
    :param algorithm: that is trained
    :return: options, each with one value
    """
    options = {"--algo": algorithm.name, "-conf": algorithm.settings_file, **ALWAYS}
    return [word for option in options.items() for word in option]


def spelled_out(arguments: Sequence[str]) -> list[str]:
    """
    :param arguments: as a user gave them
    :return: the same, with options and values in words of their own, where they are ``--option=value`` or ``-nVALUE``
    """

    def parts(word: str) -> Iterator[str]:
        option, equals, value = word.partition("=")
        joined = next((name for name in JOINED if word.startswith(name) and word != name), None)
        if equals and (option.startswith("--") or option in (*JOINED, *APART)):
            yield from (option, value)
        elif joined is not None:
            yield from (joined, word.removeprefix(joined))
        else:
            yield word

    return [part for word in arguments for part in parts(word)]


def check_options(arguments: Sequence[str]) -> None:
    """
    Those with one dash, and those with pairs; rl_zoo3's parser looks at the others.

    :param arguments: :func:`spelled_out`
    :raises ValueError: for one that there is not, such as an abbreviation, or one with pairs that would be dropped in silence,
        as it comes again
    """
    known, given = (*JOINED, *APART, *FLAGS), set[str]()
    for word in arguments:
        if word[:1] == "-" and word[1:2].isalpha() and word not in known:
            raise ValueError(f"There is no option {word}: those with one dash are {', '.join(known)}.")
        option = {"--hyperparams": "-params"}.get(word, word)
        if option in KEY_VALUES and option in given:
            raise ValueError(f"{option} is given twice, and only the last would count: give all pairs behind one.")
        given.add(option)


def value_of(arguments: Sequence[str], *options: str) -> str | None:
    """
    :param arguments: of a run, :func:`spelled_out`
    :param options: all names of one
    :return: what it was given, of several values all; None if it was not
    """
    given = None
    for i, word in enumerate(arguments):
        if word in options:
            given = " ".join(takewhile(lambda word: not word.startswith("-") or word[1:].isdigit(), arguments[i + 1 :]))
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
    return {**hyperparams, **{names[0]: value_of([*defaults, *spelled_out(arguments)], *names) for names in options}}


def given_arguments(arguments: Sequence[str]) -> list[str]:
    """
    :param arguments: of a run that was begun by this version, or by one with fewer defaults
    :return: what the user gave, :func:`spelled_out`
    """
    given = spelled_out(arguments)
    while given[:1] and given[0] in ("--algo", "-conf", *ALWAYS):
        del given[:2]
    return given
