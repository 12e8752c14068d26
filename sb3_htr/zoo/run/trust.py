"""
What files may ask for. A user may have code run by naming it on the command line; a file, which may come from a stranger, may
not, unless the user says ``--trust``.
"""

import ast
import importlib
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

# Packages of envs that a file may have imported, where they are installed
PACKAGES = ("htr_envs", "gymnasium_robotics", "metaworld", "panda_gym")
# Settings of a YAML file that rl_zoo3 imports by their names, and those that it evaluates as Python if they are strings
IMPORTED = ("callback", "env_wrapper", "vec_env_wrapper", "replay_buffer_class")
EVALUATED = ("policy_kwargs", "replay_buffer_kwargs")
# Arguments of a training whose values rl_zoo3 evaluates as Python, key by key
KEY_VALUES = ("-params", "--hyperparams", "--env-kwargs", "--eval-env-kwargs")
CONF = ("-conf", "--conf-file")
# A model to begin with, whose weights and plain settings alone are taken
WEIGHTS = ("-i", "--trained-agent")
# Those that neither search nor upload, nor connect, which hands passwords over, nor have code loaded. By their full names: an
# abbreviation could be one of any other
HARMLESS = (
    *KEY_VALUES,
    *CONF,
    *WEIGHTS,
    *("--algo", "--env", "--gym-packages", "-n", "--n-timesteps", "--seed", "--num-threads", "--vec-env", "--device"),
    *("-f", "--log-folder", "-tb", "--tensorboard-log", "--log-interval", "--verbose", "-P", "--progress", "-uuid", "--uuid"),
    *("--eval-freq", "--eval-episodes", "--n-eval-envs", "--save-freq", "--save-replay-buffer"),
)


def refuse(file: object, what: str) -> ValueError:
    """
    :param file: that asks for it
    :param what: would happen
    :return: to be raised
    """
    return ValueError(f"{file} {what}, which can run any code: add --trust if you know where the file comes from.")


def plain_settings(hyperparams: dict[str, Any], file: object, trust: bool, named: Iterable[str] = ()) -> dict[str, Any]:
    """
    :param hyperparams: of a YAML file
    :param file: for messages
    :param trust: whether it may have code run
    :param named: modules that the user has named
    :return: the same, with strings that rl_zoo3 would evaluate replaced by the values that they spell
    :raises ValueError: if code would be run
    """
    hyperparams = dict(hyperparams)
    if trust:
        return hyperparams
    for key in IMPORTED:
        if hyperparams.get(key) is not None:
            raise refuse(file, f"has {key}: {hyperparams[key]!r}")
    check_env_kwargs(hyperparams.get("env_kwargs"), file, named)
    if "." in str(hyperparams.get("policy", "")):
        raise refuse(file, f"has policy: {hyperparams['policy']!r}")
    for key in EVALUATED:
        if isinstance(hyperparams.get(key), str):
            if not _is_literal(hyperparams[key]):
                raise refuse(file, f"has {key}: {hyperparams[key]!r}")
            hyperparams[key] = ast.literal_eval(hyperparams[key])
    return hyperparams


def check_arguments(
    arguments: Sequence[str], packages: Sequence[str], file: object, trust: bool, named: Iterable[str] = ()
) -> None:
    """
    :param arguments: of a training, from the record of a run, spelled out
    :param packages: modules that the record asks for, see :func:`import_packages`
    :param file: the record, for messages
    :param trust: whether it may have code run
    :param named: modules that the user has named
    :raises ValueError: if code would be run
    """
    option = ""
    for word in () if trust else arguments:
        if word.startswith("-") and not word[1:2].isdecimal():
            option = word
            refused = word not in HARMLESS
        elif option in KEY_VALUES:
            key, _, value = word.partition(":")
            refused = not _is_literal(value)
            if not refused:
                check_env_kwargs({key: ast.literal_eval(value)}, file, named)
        else:
            refused = (option in CONF and not word.endswith((".yml", ".yaml"))) or (
                option == "--gym-packages" and word not in packages
            )
        if word == "--storage":
            raise ValueError(
                f"{file} has the argument '--storage', whose database may be told passwords of this machine: add --trust if "
                "you know where the file comes from."
            )
        if refused:
            raise refuse(file, f"has the argument {word!r}")


def check_env_kwargs(env_kwargs: Any, file: object, named: Iterable[str] = ()) -> None:
    """
    :param env_kwargs: of a file. A text ``module:id``, with dots and underscores, is an env whose module would be imported
    :param file: for messages
    :param named: modules that the user has named
    :raises ValueError: if code would be run
    """
    if isinstance(env_kwargs, dict):
        env_kwargs = [*env_kwargs.values()]
    if isinstance(env_kwargs, list | tuple):
        for value in env_kwargs:
            check_env_kwargs(value, file, named)
    elif isinstance(env_kwargs, str):
        module, colon, _ = env_kwargs.rpartition(":")
        if colon and module not in (*PACKAGES, *named):
            raise refuse(file, f"has {env_kwargs!r} among its settings")


def _is_literal(text: str) -> bool:
    try:
        ast.literal_eval(text)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return False
    return True


def see_working_folder() -> None:
    """Modules of one's own beside what one works on can be imported from now on, as with `python -m`: the user names some."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def import_packages(named: Iterable[str], asked_for: Iterable[str] = (), file: object = "", trust: bool = False) -> None:
    """
    :param named: modules that register envs, by the user
    :param asked_for: the same, by a file
    :param file: for messages
    :param trust: whether the file may have code run
    :raises ValueError: for one that is not there or is a mere folder, or that a file may not have imported
    """
    named = list(named)
    if named or trust:
        see_working_folder()
    for name in asked_for:
        if name not in (*named, *PACKAGES) and not trust:
            raise ValueError(
                f"{file} asks for the module {name!r}, and importing it runs it: add --gym-packages {name} if you know it."
            )
    for name in dict.fromkeys((*named, *asked_for)):
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(
                f"{name!r} is no name of a module: give it without folder and .py, as in --gym-packages {Path(name).stem}, "
                "and work in its folder, or add that to PYTHONPATH."
            )
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name != name.split(".")[0]:
                raise
            raise ValueError(
                f"The module {name} is asked for, but not found: install it, or add its folder to PYTHONPATH."
            ) from None
        if hasattr(module, "__path__") and getattr(module, "__file__", None) is None:
            raise ValueError(
                f"--gym-packages took {name!r} for a module, and it is a folder without __init__.py: if it is a run, give it "
                "before that option, or with another option between them."
            )
