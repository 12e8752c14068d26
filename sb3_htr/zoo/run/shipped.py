"""Where the files are that come with the package."""

from pathlib import Path

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


def find_hyperparams(name: str) -> str:
    """
    :param name: of a file, as a user gives it
    :return: its path, one's own or, if there is none, that of the package's file of this name; a module stays as it is
    """
    return name if Path(name).exists() or not hyperparams_file(name).is_file() else str(hyperparams_file(name))
