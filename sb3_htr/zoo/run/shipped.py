"""Where the files are that come with the package."""

import difflib
from pathlib import Path
from typing import Any

import yaml

PACKAGE = Path(__file__).parents[2]


def shipped(name: str) -> Path:
    """
    :param name: folder at the top of the repository
    :return: its path: inside the installed package, or beside it in a checkout
    """
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


def hyperparams_file(name: str) -> Path:
    """
    :param name: file name
    :return: its path
    """
    return shipped("hyperparams") / name


def block_of(file: str, env_id: str) -> dict[str, Any]:
    """
    :param file: name of a YAML file of the package, or path of another
    :param env_id: registered env
    :return: hyperparameters that it has for the env, of its own block or the default one, but for the method
    """
    blocks = yaml.safe_load(hyperparams_file(file).read_text(encoding="utf-8"))
    block = blocks.get(env_id, blocks.get("default", {}))
    return {key: value for key, value in block.items() if key != "method"}


def find_hyperparams(name: str) -> str:
    """
    :param name: of a file, as a user gives it
    :return: its path, one's own or, if there is none, that of the package's file of this name; a module stays as it is
    :raises ValueError: for a path of a folder
    :raises FileNotFoundError: if there is neither, of a YAML or Python file
    """
    if Path(name).is_dir() and Path(name).name != name:  # without a slash it may be a module
        raise ValueError(f"{name} is a folder, expected a file of hyperparameters.")
    if Path(name).exists():
        return name
    if hyperparams_file(name).is_file():
        return str(hyperparams_file(name))
    if Path(name).suffix in (".yml", ".yaml", ".py"):
        theirs = sorted(path.name for path in shipped("hyperparams").glob("*.yml"))
        nearest = difflib.get_close_matches(Path(name).name, theirs, n=1)
        meant = f"did you mean {nearest[0]}?" if nearest else f"expected a file of yours, or one of {', '.join(theirs)}."
        raise FileNotFoundError(f"There is no file {name}: {meant}")
    return name
