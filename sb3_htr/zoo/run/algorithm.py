"""What the zoo has to know of an algorithm: where it is, what its settings are, and how a model of it is loaded."""

import inspect
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.settings import keywords_of
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.pearl import PEARL, load_untrusted
from sb3_htr.pearl.horizon import timesteps_for
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.pearl.untrusted import check_loadable
from sb3_htr.rivals.base import Rival
from sb3_htr.rivals.off_policy import OffPolicyRival
from sb3_htr.rivals.on_policy import OnPolicyRival
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.sac_her import SACHER
from sb3_htr.rivals.untrusted import load_untrusted as load_untrusted_rival
from sb3_htr.rivals.untrusted import plain_policy
from sb3_htr.zoo.run import search_space
from sb3_htr.zoo.run.search_space import SearchSpace
from sb3_htr.zoo.run.shipped import find_hyperparams, hyperparams_file
from sb3_htr.zoo.run.trust import refuse

# What a run trains and a command adapts
Model = PEARL | Rival


@dataclass(frozen=True)
class Algorithm:
    """
    One that is trained by a class of :mod:`sb3_htr.rivals`, or of one's own beside them.

    :param name: rl_zoo3's ``--algo``
    :param model_class: of its models
    :param settings: YAML file with its hyperparameters; of the package's, the name alone
    :param about: how an agent of it comes to know its task, for model cards
    :param also_explores_by: explorer that scores name beside its own
    :param search_space: what ``optimize`` searches through, None for nothing
    :param owners: of settings that are dicts, whose arguments these are, by name
    """

    name: str
    model_class: type[Any]
    settings: str
    about: str
    also_explores_by: tuple[str, ...] = ()
    search_space: SearchSpace | None = None
    owners: Mapping[str, type[Any]] = field(default_factory=dict)

    @property
    def settings_file(self) -> str:
        """Path of the YAML file."""
        return str(hyperparams_file(self.settings))

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
        return self.model_class.load(path, device=device) if trust else self._load_untrusted(path, record, env, device)

    def _load_untrusted(self, path: Path, record: dict[str, Any], env: gym.Env, device: str) -> Model:
        return load_untrusted_rival(self.model_class, path, record.get("hyperparams", {}), env, device)

    def check_loadable(self, hyperparams: dict[str, Any]) -> None:
        """
        :param hyperparams: of a training to come
        :raises ValueError: if its model could be loaded by ``trust`` alone
        """
        plain_policy(self.model_class, hyperparams)

    def load_to_train(self, path: str, env: VecEnv, device: th.device | str, **kwargs: Any) -> Any:
        """
        :param path: model file of unknown origin
        :param env: to train in
        :param device: torch device
        :param kwargs: arguments of the class, in place of those of the file
        :return: a model to train on
        :raises ValueError: if only ``trust`` loads such
        """
        raise refuse(path, "is unpickled to be trained on")

    def usual_timesteps(self, model: BaseAlgorithm) -> int:
        """
        :param model: as set up
        :return: env steps that ``learn`` would take by default, 0 without a rule
        """
        return 0


class PEARLAlgorithm(Algorithm):
    """PEARL, or a class derived from it, whose files can be trained on without running code of theirs."""

    def _load_untrusted(self, path: Path, record: dict[str, Any], env: gym.Env, device: str) -> Model:
        # Of a class of one's own: its file has them as attributes of any name
        given, own = record.get("hyperparams", {}), keywords_of(self.model_class) - keywords_of(PEARL)
        return load_untrusted(path, env, device, self.model_class, **{name: given[name] for name in own & given.keys()})

    def check_loadable(self, hyperparams: dict[str, Any]) -> None:
        check_loadable(hyperparams, self.model_class)

    def load_to_train(self, path: str, env: VecEnv, device: th.device | str, **kwargs: Any) -> PEARL:
        return load_untrusted(path, env, device, self.model_class, **kwargs)

    def usual_timesteps(self, model: BaseAlgorithm) -> int:
        n_steps: int | None = getattr(model, "max_episode_steps", None)
        return 0 if n_steps is None else timesteps_for(n_steps)


ALGORITHMS = {
    algorithm.name: algorithm
    for algorithm in (
        PEARLAlgorithm(
            "pearl",
            PEARL,
            "pearl.yml",
            "It is not told its task: it tries a few episodes, and infers the task from their rewards.",
            also_explores_by=("prior",),
            search_space=search_space.PEARL,
            owners={"replay_buffer_kwargs": MultiTaskReplayBuffer, "policy_kwargs": PEARLPolicy},
        ),
        Algorithm(
            "rl2",
            RL2,
            "rl2.yml",
            "It is not told its task: it tries a few episodes, and its memory has what it found there.",
            search_space=search_space.RL2,
        ),
        Algorithm(
            "sac-her",
            SACHER,
            "sac_her.yml",
            "It is told its task, which makes it a ceiling for agents that are not.",
            search_space=search_space.SAC_HER,
        ),
    )
}


def register_algorithm(
    name: str,
    model_class: type[Model],
    settings: str | os.PathLike[str],
    about: str,
    search_space: SearchSpace | None = None,
) -> None:
    """
    Add an algorithm, for methods to be trained by it, see :func:`sb3_htr.zoo.run.method.register_method`. In a module of one's
    own, which ``--gym-packages`` names, it is at hand in all commands.

    :param name: that no other algorithm has
    :param model_class: of its models, at the top of a module, so that others can import it: a rival, or derived from PEARL
    :param settings: path of a YAML file with hyperparameters, as ``hyperparams/rl2.yml``, or the name of the package's
    :param about: how an agent of it comes to know its task, a sentence for model cards
    :param search_space: what ``optimize`` searches through, None for nothing
    :raises ValueError: for a name that is taken or cannot be that of a folder, a class that is neither or cannot be
        imported
    :raises FileNotFoundError: if there is no such file
    """
    check_folder_name("algorithm", name)
    if name in ALGORITHMS:
        raise ValueError(f"There is an algorithm {name!r} already: choose another name.")
    if not issubclass(model_class, PEARL):
        _check_is_whole_rival(model_class)
    if model_class.__module__ == "__main__":
        raise ValueError(f"{model_class.__name__} is in a script, which nobody can import: put it into a module of its own.")
    path = Path(find_hyperparams(str(settings))).resolve()
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path} with hyperparameters of {name!r}.")
    if "." in model_class.__qualname__:
        raise ValueError(f"{model_class.__qualname__} is within something: put the class at the top of its module.")
    # How PEARL is loaded, explores and is searched through holds for what is derived from it
    like = ALGORITHMS["pearl"] if issubclass(model_class, PEARL) else Algorithm(name, model_class, str(path), about)
    search_space = search_space or like.search_space
    ALGORITHMS[name] = replace(
        like, name=name, model_class=model_class, settings=str(path), about=about, search_space=search_space
    )


def _check_is_whole_rival(model_class: type[Any]) -> None:
    if not issubclass(model_class, OnPolicyRival | OffPolicyRival):
        raise ValueError(
            f"{model_class.__name__} is no subclass of PEARL, sb3_htr.rivals.on_policy.OnPolicyRival or "
            "sb3_htr.rivals.off_policy.OffPolicyRival, which say what is needed."
        )
    parts = model_class.__mro__
    library = next(part for part in parts[1:] if part.__module__.startswith(("stable_baselines3.", "sb3_contrib.")))
    if parts.index(library) < parts.index(Rival):
        raise ValueError(f"{model_class.__name__} has {library.__name__} before its mixin: class Mine(OnPolicyRival, PPO).")
    if inspect.isabstract(model_class) or not hasattr(model_class, "DEFAULT_POLICY"):
        raise ValueError(f"{model_class.__name__} is not whole: it needs a DEFAULT_POLICY, and _adaptation.")


def check_folder_name(what: str, name: str) -> None:
    """
    :param what: has the name
    :param name: of something that has folders of its own
    :raises ValueError: if it cannot be that of a folder
    """
    if not name or set(name) & set("/\\ "):
        raise ValueError(f"The name of the {what} is {name!r}, expected one that can be the name of a folder.")
