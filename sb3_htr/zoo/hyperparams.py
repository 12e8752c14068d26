"""Where the hyperparameter files are."""

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def hyperparams_file(name: str = "pearl.yml") -> Path:
    """
    :param name: file name
    :return: its path: inside the installed package, or beside it in a checkout
    """
    inside = PACKAGE / "hyperparams"
    return (inside if inside.is_dir() else PACKAGE.parent / "hyperparams") / name
