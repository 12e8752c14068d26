"""One run of an experiment: what is trained, and how the final model is evaluated."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

# What to do with raw results that cannot be used, and with those of something else
REMOVE = "Remove it: the same command then evaluates its run again, without training it again."
MOVE = "move it away with its run, or choose other --runs."

KwArgs = dict[str, Any]


def file_name(text: str) -> str:
    """
    :param text: name of a run or an evaluation
    :return: the same, as systems can have it
    """
    return re.sub(r"[^\w.=-]+", "_", text.replace(" ", ""))


class Evaluation(NamedTuple):
    """
    How a final model adapts to the test tasks.

    :param explorer: name
    :param tested_on: arguments of the env that are other than in training
    """

    explorer: str
    tested_on: KwArgs

    @property
    def name(self) -> str:
        """In raw results."""
        return " ".join([self.explorer, *(f"{key}={value}" for key, value in self.tested_on.items())])


# As Python writes it, and cannot read it
INFINITY = re.compile(r"(?<![\w'])inf\b(?!')")


def read_facts(raw: Mapping[str, Any], key: str, what: str, advice: str) -> dict[str, Any]:
    """
    :param raw: raw results
    :param key: of what they say of themselves, as JSON
    :param what: they are, for the message
    :param advice: what to do if they cannot be read, likewise
    :return: what they say
    :raises ValueError: if it cannot be read
    """
    try:
        facts = json.loads(str(raw[key]))
    except (ValueError, RecursionError):
        facts = None
    if not isinstance(facts, dict):
        raise ValueError(f"{what} does not say what it is of, or is damaged: {advice}")
    return facts


@dataclass(frozen=True, eq=False)
class Cell:
    """
    One training run and the evaluations of its final model.

    :param experiment: name of the experiment
    :param models_of: name of the experiment whose runs these are; often the same
    :param env_id: registered env
    :param method: name in hyperparams/methods.yml
    :param variant: name in tables and folders
    :param seed: seed of the run
    :param n_timesteps: budget of env steps
    :param eval_freq: env steps between evaluations on the validation tasks
    :param n_episodes: adaptation episodes on a task, whenever one is adapted to
    :param settings: hyperparameters, joined with those of env and method
    :param env_kwargs: arguments of the env
    :param evaluations: what is done with the final model; one row of results for each
    :param gym_packages: modules that register what of this is not the package's own
    :param device: torch device that it is trained on; its final model is evaluated on the CPU
    """

    experiment: str
    models_of: str
    env_id: str
    method: str
    variant: str
    seed: int
    n_timesteps: int
    eval_freq: int
    n_episodes: int
    settings: KwArgs
    env_kwargs: KwArgs
    evaluations: tuple[Evaluation, ...]
    gym_packages: tuple[str, ...] = ()
    device: str = "cpu"

    @property
    def name(self) -> str:
        """Of its folder."""
        kwargs = "".join(f"-{key}{value}" for key, value in self.env_kwargs.items())
        return file_name(f"{self.variant}{kwargs}-seed{self.seed}")

    @property
    def label(self) -> str:
        """In messages, among cells of several experiments."""
        return f"{self.experiment}/{self.name}"

    def run_folder(self, runs: Path) -> Path:
        """
        :param runs: folder of all experiments' runs
        :return: log folder of its training
        """
        return runs / self.models_of / self.name

    def result(self, runs: Path) -> Path:
        """
        :param runs: folder of all experiments' runs
        :return: file of its raw results
        """
        return runs / self.experiment / f"{self.name}.npz"

    def facts(self) -> str:
        """
        :return: what its numbers are of, as JSON
        """
        names = ("env_id", "env_kwargs", "method", "settings", "seed", "n_timesteps", "n_episodes", "eval_freq")
        return json.dumps({name: getattr(self, name) for name in names}, sort_keys=True)

    def check_facts(self, raw: Mapping[str, Any], what: str, advice: str) -> None:
        """
        :param raw: raw results; those of older versions may say less of what they are of
        :param what: they are, for the message
        :param advice: what to do if they are of something else, likewise
        :raises ValueError: if they are
        """
        given, own = read_facts(raw, "cell", what, advice), json.loads(self.facts())
        if different := [name for name, value in given.items() if value != own.get(name)]:
            name = different[0]
            raise ValueError(f"{what} has {name} {given[name]!r}, but {self.label} needs {own.get(name)!r}: {advice}")

    def training(self, folder: Path) -> list[str]:
        """
        :param folder: log folder
        :return: arguments of ``sb3-htr train``
        """
        settings, kwargs = (
            [f"{key}:{INFINITY.sub('1e999', repr(value))}" for key, value in given.items()]
            for given in (self.settings, self.env_kwargs)
        )
        return [
            *("--env", self.env_id, "--method", self.method, "--device", self.device),
            *("-f", str(folder), "--verbose", "0", "-n", str(self.n_timesteps)),
            *("--seed", str(self.seed), "--eval-freq", str(self.eval_freq), "--eval-episodes", str(self.n_episodes)),
            *(["-params", *settings] if settings else []),
            *(["--env-kwargs", *kwargs] if kwargs else []),
            *(["--gym-packages", *self.gym_packages] if self.gym_packages else []),
        ]
