"""What the zoo has to know of an algorithm: where it is, what its settings are, and how a model of it is loaded."""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_htr.pearl import PEARL, load_untrusted
from sb3_htr.rivals.base import Rival
from sb3_htr.rivals.untrusted import load_untrusted as load_untrusted_rival
from sb3_htr.zoo.run.shipped import hyperparams_file

# What a run trains and a command adapts
Model = PEARL | Rival


@dataclass(frozen=True)
class Algorithm:
    """
    :param name: rl_zoo3's ``--algo``
    :param module: that its class is in, imported when it is needed
    :param class_name: of the class
    :param settings: YAML file with its hyperparameters
    :param about: how an agent of it comes to know its task, for model cards
    :param also_explores_by: explorer that scores name beside its own
    """

    name: str
    module: str
    class_name: str
    settings: str
    about: str
    also_explores_by: tuple[str, ...] = ()

    @property
    def settings_file(self) -> str:
        """Path of the YAML file."""
        return str(hyperparams_file(self.settings))

    def model_class(self) -> type[Any]:
        """
        :return: the class
        :raises ModuleNotFoundError: if a package that it needs is not installed
        """
        model_class: type[Any] = getattr(importlib.import_module(self.module), self.class_name)
        return model_class

    def load(self, path: Path, record: dict[str, Any], env: gym.Env, device: str, trust: bool) -> Model:
        """
        :param path: model file
        :param record: of its training
        :param env: env of the same spaces
        :param device: torch device
        :param trust: unpickle all of the file, which can run any code
        :return: a model to adapt and evaluate with
        :raises ValueError: if it is no such file
        """
        model_class = self.model_class()
        if trust:
            return model_class.load(path, device=device)
        if model_class is PEARL:
            return load_untrusted(path, env, device)
        return load_untrusted_rival(model_class, path, record.get("hyperparams", {}), env, device)


ALGORITHMS = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm(
            "pearl",
            "sb3_htr.pearl",
            "PEARL",
            "pearl.yml",
            "It is not told its task: it tries a few episodes, infers the task from sparse rewards, and then solves it.",
            also_explores_by=("prior",),
        ),
        Algorithm(
            "rl2",
            "sb3_htr.rivals.rl2",
            "RL2",
            "rl2.yml",
            "It is not told its task: it tries a few episodes, and its memory has what it found there.",
        ),
        Algorithm(
            "sac-her",
            "sb3_htr.rivals.sac_her",
            "SACHER",
            "sac_her.yml",
            "It is told its task, which makes it a ceiling for agents that are not.",
        ),
    )
}
