"""What `sb3-htr train` puts in front of the arguments that a user gives to rl_zoo3's train: later ones win."""

from collections.abc import Sequence

from sb3_htr.zoo.run.algorithm import Algorithm

# PEARL's reference adapts for as many episodes. One thread: two runs on two cores must not fight for them
ALWAYS = {"--num-threads": "1", "--save-freq": "20000", "--eval-episodes": "20"}


def default_arguments(algorithm: Algorithm) -> list[str]:
    """
    :param algorithm: that is trained
    :return: options, each with one value
    """
    options = {"--algo": algorithm.name, "-conf": algorithm.settings_file, **ALWAYS}
    return [word for option in options.items() for word in option]


def given_arguments(arguments: Sequence[str]) -> list[str]:
    """
    :param arguments: of a run that was begun by this version, or by one with fewer defaults
    :return: what the user gave
    """
    given = list(arguments)
    while given[:1] and given[0] in ("--algo", "-conf", *ALWAYS):
        del given[:2]
    return given
