"""Trained agents: where they are, and the env that each was trained on."""

import contextlib
import difflib
import json
import os
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
from rl_zoo3.utils import get_wrapper_class
from stable_baselines3.common.vec_env import VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr.common.checkpoint import checkpoints, n_steps_done
from sb3_htr.common.checks import check_device
from sb3_htr.common.digest import is_whole_zip
from sb3_htr.common.errors import last_line
from sb3_htr.common.settings import name_of
from sb3_htr.common.vec_env import arguments_are_known, make_task_vec_env
from sb3_htr.zoo.run.algorithm import Algorithm, Model
from sb3_htr.zoo.run.folder import run_number
from sb3_htr.zoo.run.method import DEFAULT, OWN, get_method, methods
from sb3_htr.zoo.run.record import MAX_RECORD, RECORD, command_to_go_on, read_record, records_in
from sb3_htr.zoo.run.shipped import shipped
from sb3_htr.zoo.run.trust import refuse

# rl_zoo3's, of single envs and of their batch
WRAPPERS = ENV_WRAPPER, VEC_ENV_WRAPPER = "env_wrapper", "vec_env_wrapper"


@dataclass(frozen=True)
class TrainedAgent:
    """
    :param path: model file
    :param record: of its training: ``env_id``, ``method``, ``env_kwargs``, ``gym_packages``
    :param folder: run folder, None for a model file of its own
    :param trusted: whether its files may have code run, which networks, explorers and wrappers of one's own need
    :param other_env_kwargs: arguments of the env that are to be others than in its training
    """

    path: Path
    record: dict[str, Any]
    folder: Path | None
    trusted: bool = False
    other_env_kwargs: dict[str, Any] = field(default_factory=dict)

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the env that it acts in."""
        return {**self.record["env_kwargs"], **self.other_env_kwargs}

    @property
    def env_id(self) -> str:
        """Env that it was trained on."""
        return str(self.record["env_id"])

    @property
    def stem(self) -> str:
        """Its env in names of files."""
        return file_stem(self.env_id)

    @property
    def method(self) -> str:
        """Name of the method that it was trained by."""
        return str(self.record.get("method", "unknown"))

    @property
    def algorithm(self) -> Algorithm:
        """What trained it; PEARL if that is not said."""
        return methods().get(self.method, get_method(DEFAULT)).algorithm

    @property
    def explorer(self) -> str:
        """Name of the explorer that it was evaluated with in its training."""
        return str(name_of(self.record.get("hyperparams", {}).get("explorer", OWN)))

    def load(self, device: str = "cpu") -> Model:
        """
        :param device: torch device
        :return: the model
        :raises ValueError: for a device that cannot be used, or a model whose networks are not those of this version
        """
        check_device(device)
        try:
            return self.algorithm.load(self.path, self.record, self.make_env(), device, self.trusted)
        except ValueError as error:
            if "method" not in self.record or self.method in methods():
                raise
            advice = "is it of a module of yours? --gym-packages names it."
            raise ValueError(f"{error} Nobody has registered the method {self.method!r}: {advice}") from None
        except RuntimeError as error:
            writer = self.record.get("versions", {}).get("sb3_htr", "unknown")
            raise ValueError(
                f"{self.path} has other networks than this version makes (it is of sb3_htr {writer}): {last_line(error)}"
            ) from None

    def make_env(self, render_mode: str | None = None) -> gym.Env:
        """
        :param render_mode: of the env
        :return: one env
        :raises ValueError: if it has no such mode
        """
        # An env that cannot be drawn need not know the argument
        drawn: dict[str, Any] = {} if render_mode is None else {"render_mode": render_mode}
        wrap = self._wrapper(ENV_WRAPPER) or (lambda env: env)
        try:
            with arguments_are_known(self.env_id, self.env_kwargs):
                return wrap(gym.make(self.env_id, **self.env_kwargs, **drawn))
        except TypeError as error:
            if not drawn or "'render_mode'" not in str(error):
                raise
            raise ValueError(
                f"{self.env_id} cannot draw {render_mode}: let the __init__ of its class take render_mode, and hand it on."
            ) from None

    def make_vec_env(self, n_envs: int) -> VecEnv:
        """
        :param n_envs: number of envs
        :return: the envs, in the wrappers that they had in training
        """
        wrapper = self._wrapper(ENV_WRAPPER)
        return self.around(make_task_vec_env(self.env_id, n_envs, env_kwargs=self.env_kwargs, wrapper=wrapper))

    def around(self, env: VecEnv) -> VecEnv:
        """
        :param env: of single envs as :meth:`make_env` makes them
        :return: the same in the wrapper that the batch had in training, if it had one
        """
        wrap: Callable[[VecEnv], VecEnv] | None = self._wrapper(VEC_ENV_WRAPPER)
        return env if wrap is None else wrap(env)

    def _wrapper(self, name: str) -> Callable[[Any], Any] | None:
        """Of a setting of rl_zoo3."""
        hyperparams = self.record.get("hyperparams", {})
        if hyperparams.get(name) is None:
            return None
        if not self.trusted:
            raise refuse(self.path, f"has {name}: {hyperparams[name]!r}")
        return cast(Callable[[Any], Any], get_wrapper_class(hyperparams, name))


def file_stem(env_id: str) -> str:
    """
    :param env_id: id of an env, with a namespace or a module before it perhaps
    :return: how rl_zoo3 writes it in names of files
    """
    return env_id.rpartition(":")[2].replace("/", "-")


def n_steps_of(run: Path, env_id: str) -> int:
    """
    :param run: run folder
    :param env_id: env that it was trained on
    :return: env steps that its last model was trained for, 0 if there is none, or it is damaged or does not say
    """
    path = run / f"{file_stem(env_id)}.zip"
    try:
        if is_whole_zip(path):
            with zipfile.ZipFile(path) as archive:
                return int(json.loads(archive.read("data"))["num_timesteps"])
    except (RuntimeError, KeyError, TypeError, ValueError):
        pass
    return 0


def is_finished(run: Path, env_id: str, n_timesteps: int) -> bool:
    """
    :param run: run folder
    :param env_id: env that it was trained on
    :param n_timesteps: env steps that are planned
    :return: whether it was trained to its end
    """
    # An interrupted training leaves a model, too, and so does one that goes on; of a finished one, the checkpoints may have
    # been removed
    done = n_steps_done(run)
    return n_steps_of(run, env_id) >= n_timesteps and (done >= n_timesteps or not done)


def find_runs(folder: Path) -> list[Path]:
    """
    :param folder: a run folder, or a folder with runs somewhere in it
    :return: run folders, the oldest first
    :raises FileNotFoundError: if there is none
    """
    runs = sorted(records_in(folder), key=_begun)
    if not runs:
        raise FileNotFoundError(f"There is no run in {folder}: give the folder that `sb3-htr train` printed as 'Log path'.")
    return [run.parent for run in runs]


def _begun(record: Path) -> str:
    """When a run was begun, as its record says, since files of a copy have other times; of one that does not say, its own."""
    written = datetime.fromtimestamp(record.stat().st_mtime, timezone.utc).isoformat()
    with contextlib.suppress(ValueError):  # what is wrong with it is said where it is needed
        return str(read_record(record).get("started", written))
    return written


def runs_with_models(folder: Path) -> list[Path]:
    """
    :param folder: a run folder, or a folder with runs somewhere in it
    :return: those that have a model, the oldest first, and the others are told of; all, if none has one
    :raises FileNotFoundError: if there is no run
    """
    runs = find_runs(folder)
    having = [run for run in runs if any(run.glob("[!.]*.zip"))]  # hidden ones are what a killed process left
    if not having:
        return runs
    for run in runs:
        if run not in having:
            print(f"{run} has no model yet, and is left out.", file=sys.stderr)
    return having


def find_model(run: Path, env_id: str, which: str) -> Path:
    """
    :param run: run folder
    :param env_id: env that it was trained on
    :param which: ``"best"`` or ``"last"``
    :return: model file; the other one where the run has only that yet
    :raises FileNotFoundError: if it has neither
    """
    best, last = run / "best_model.zip", run / f"{file_stem(env_id)}.zip"
    for path in (best, last) if which == "best" else (last, best):
        if path.exists():
            return path
    to_go_on = command_to_go_on(run, read_record(run / RECORD))
    advice = f"go on with `{to_go_on}`" if checkpoints(run) else "train anew, as it has no checkpoint either"
    raise FileNotFoundError(f"{run} has no model yet, the first is saved with the first evaluation: {advice}.")


def agent_at(path: str | os.PathLike[str], which: str = "best", env_id: str | None = None) -> TrainedAgent:
    """
    :param path: a run folder, a folder of runs, of which the newest is meant, an exported folder, or a model file
    :param which: ``"best"`` or ``"last"`` model of a run
    :param env_id: env of a model file without a record
    :return: the agent
    :raises FileNotFoundError: if there is none
    :raises ValueError: if it is no model file, or one that does not say its env
    """
    path = Path(path)
    files = list(path.glob("[!.]*.zip"))  # hidden ones are what a killed process left
    if len(files) == 1 and not any(records_in(path)):
        path = files[0]
    if path.is_dir():
        run = runs_with_models(path)[-1]
        record = read_record(run / RECORD)
        return TrainedAgent(find_model(run, record["env_id"], which), record, run)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: give a run folder, a folder of runs, or a model file (.zip).")
    names: list[str] = []
    with contextlib.suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        if RECORD in names and archive.getinfo(RECORD).file_size > MAX_RECORD:
            raise ValueError(f"The {RECORD} in {path} unpacks to more than {MAX_RECORD} bytes, which no training writes.")
        if RECORD in names:
            return TrainedAgent(path, read_record(path, archive.read(RECORD)), None)
    if "data" not in names:
        raise ValueError(f"{path} is no model file: give a run folder, or a .zip that a training has saved.")
    if (path.parent / RECORD).exists():
        return TrainedAgent(path, read_record(path.parent / RECORD), path.parent)
    if env_id is None:
        raise ValueError(f"{path} does not say which env it was trained on: add --env ID.")
    return TrainedAgent(path, {"env_id": env_id, "env_kwargs": {}, "gym_packages": []}, None)


def agent_for(
    env_id: str, folder: str | os.PathLike[str] = "logs", method: str | None = None, exp_id: int = 0, which: str = "best"
) -> TrainedAgent:
    """
    :param env_id: env
    :param folder: log folder of ``sb3-htr train``, with the runs in ``<method>/<stem>_<exp_id>``, see :func:`file_stem`
    :param method: name of a method; any by default, in the order of :func:`methods`
    :param exp_id: number of the run, 0 for the latest
    :param which: ``"best"`` or ``"last"`` model of a run
    :return: the agent, of the log folder if that has one, else the one that comes with the package
    :raises FileNotFoundError: if there is none
    """
    names = list(methods()) if method is None else [get_method(method).name]
    numbers: list[str] = []
    stem = file_stem(env_id)
    for name in names:
        runs = [path.parent for path in Path(folder, name).glob(f"{stem}_*/{RECORD}") if run_number(path.parent, stem) > 0]
        runs = sorted(runs, key=lambda run: run_number(run, stem), reverse=True)
        numbers += [f"{run_number(run, stem)} ({name})" for run in reversed(runs)]
        for run in [run for run in runs if exp_id in (0, run_number(run, stem))]:
            # A run that has no model yet is passed over, if it was not asked for
            if exp_id or (run / "best_model.zip").exists() or (run / f"{stem}.zip").exists():
                return agent_at(run, which)
    wanted = f"{env_id}" + (f" run {exp_id}" if exp_id else "") + (f" by {method}" if method else "")
    for name in names if not exp_id else ():
        file = shipped("trained_agents") / name / f"{stem}.zip"
        if file.exists():
            print(f"{folder}/ has no trained agent for {wanted}, so this one comes with the package.", file=sys.stderr)
            return agent_at(file)
    if exp_id and numbers:
        raise FileNotFoundError(f"There is no trained agent for {wanted} in {folder}/, only runs {', '.join(numbers)}.")
    given = f" --method {method}" if method else ""
    with_agent = sorted(f"{file.stem} ({file.parent.name})" for file in shipped("trained_agents").glob("*/*.zip"))
    if env_id not in gym.registry and (nearest := difflib.get_close_matches(env_id, gym.registry, n=1)):
        raise FileNotFoundError(f"There is no trained agent for {wanted}, and no such env: did you mean {nearest[0]}?")
    raise FileNotFoundError(
        f"There is no trained agent for {wanted} in {folder}/: train one with "
        f"`sb3-htr train --env {env_id}{given} -f {folder}`. The package comes with {', '.join(with_agent) or 'none'}."
    )
