"""One cell, in whatever process an executor calls it: claimed, trained from where it was, and evaluated."""

import json
import platform
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
from filelock import Timeout

import htr_envs  # noqa: F401 registers the envs
from htr_envs.goal_env import find_hidden
from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checkpoint import checkpoints
from sb3_htr.common.digest import digest_of_code
from sb3_htr.common.errors import reason
from sb3_htr.common.settings import name_of
from sb3_htr.common.versions import UNKNOWN_HARDWARE, commit, hardware, named, versions
from sb3_htr.experiments.cell import MOVE, REMOVE, Cell, Evaluation
from sb3_htr.experiments.evaluation_cache import FOLDER, EvaluationCache
from sb3_htr.experiments.log import logged
from sb3_htr.experiments.protocol import check_evaluations, evaluate
from sb3_htr.zoo.commands import train
from sb3_htr.zoo.run.agents import agent_at, file_stem, find_runs, is_finished
from sb3_htr.zoo.run.algorithm import Model
from sb3_htr.zoo.run.folder import SystemLock, run_number
from sb3_htr.zoo.run.method import get_method, merged
from sb3_htr.zoo.run.record import RECORD, read_record, records_in
from sb3_htr.zoo.run.shipped import block_of
from sb3_htr.zoo.run.train_arguments import training_facts
from sb3_htr.zoo.run.trust import import_packages, plain_settings
from sb3_htr.zoo.run.yaml_checks import checked_kinds

# Means over the training of what HTR paper, B.2 reasons with
LOGGED = ("relabelled_fraction", "rl_reward_mean", "rl_zero_reward_fraction")

# Of a record, beside its hyperparameters and arguments
OF_RUN = ("env_id", "env_kwargs", "method", "seed", "n_timesteps")

# Asked when the code is imported: it may be another one by the time that a training has ended
CODE = named(commit())


def lock_of(cell: Cell, runs: Path) -> SystemLock:
    """
    :param cell: of an experiment
    :param runs: folder of all experiments' runs
    :return: what a process has as long as it runs the cell; the system takes it back when the process ends, however it does
    """
    return SystemLock(cell.run_folder(runs) / ".claim")


def machines(record: dict[str, Any]) -> str:
    """
    :param record: of a run, which this process evaluates on the CPU
    :return: what seconds depend on, and what evaluates, if that is another machine
    """
    here, python = hardware("cpu"), platform.python_version()
    trained_on = record.get("hardware", [UNKNOWN_HARDWARE])
    about = f"{', then '.join(trained_on)}, one thread per run, Python {record.get('versions', {}).get('python', python)}"
    same = any(f"{name}, ".startswith(f"{here}, ") for name in trained_on)
    return about if same else f"{about}, evaluated on {here}, Python {python}"


def run_cell(cell: Cell, runs: Path) -> bool:
    """
    Train, unless there is a finished run, then evaluate the final model.

    The result is an npz with ``timesteps`` and ``elapsed_s``, (n,); ``curve`` and ``solved``, (n, n_tasks), return of the last
    adaptation episode on the validation tasks and whether it solved them; what
    :func:`sb3_htr.experiments.protocol.evaluate` tells of the final model; the means of what is in ``LOGGED``; ``commit`` of
    the code that trained, ``evaluation_commit`` and ``machine``. What would be printed is in the ``log.txt`` of its folder.

    :param cell: what to run
    :param runs: folder of all experiments' runs; a cell that has a result there is not run again
    :return: whether there is a result; if not, another process runs the cell
    :raises FileNotFoundError: if there is no such folder
    :raises ValueError: if the run in the cell's folder is another one
    :raises KeyboardInterrupt: if the training was stopped before its end, with a checkpoint
    """
    if not runs.is_dir():
        raise FileNotFoundError(f"There is no folder {runs} on this node: give --runs that all nodes see.")
    result, folder = cell.result(runs), cell.run_folder(runs)
    for path in (folder, result.parent):
        path.mkdir(parents=True, exist_ok=True)
    try:
        with lock_of(cell, runs).acquire(timeout=0):
            if result.exists():
                cell.check_facts(load_arrays(result, ("cell",), REMOVE), str(result), MOVE)
            else:
                with logged(folder / "log.txt"):
                    arrays = _train_and_evaluate(cell, folder)
                with atomic_path(result) as path:
                    np.savez_compressed(path, **arrays)
                for kept in folder.glob(f"*/*/{FOLDER}"):
                    shutil.rmtree(kept, ignore_errors=True)
            return True
    except Timeout:
        return False


def _train_and_evaluate(cell: Cell, folder: Path) -> dict[str, Any]:
    import_packages(cell.gym_packages)
    find_hidden(cell.env_id)
    # As it was imported, and may be no more when the training has ended
    code = json.dumps([digest_of_code(("sb3_htr", "htr_envs", *cell.gym_packages)), versions()])
    trained = find_finished(cell, folder)
    if trained is None:
        _check_loadable(cell)
        check_evaluations(cell, hyperparams_of(cell).get("explorer"))
        numbered = sorted(folder.glob("*/*"), key=lambda run: run_number(run, file_stem(cell.env_id)))
        unfinished = [run for run in numbered if checkpoints(run)]
        packages = ["--gym-packages", *cell.gym_packages] if cell.gym_packages else []
        train.main(["--resume", str(unfinished[-1]), *packages] if unfinished else cell.training(folder))
        trained = find_finished(cell, folder)
        if trained is None:
            raise KeyboardInterrupt
    run, model = trained
    advice = f"Its run has to be trained again: remove {folder}."
    try:
        evaluations = load_arrays(run / "evaluations.npz", ("timesteps", "results", "successes"), advice)
    except OSError as error:
        raise OSError(f"{run / 'evaluations.npz'} cannot be read ({reason(error)}). {advice}") from error
    try:
        progress = np.atleast_1d(np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars=""))
        steps, seconds = (progress[f"time/{key}"] for key in ("total_timesteps", "time_elapsed"))
        timed = ~np.isnan(steps + seconds)
        # Between the rollouts that were logged around an evaluation. What was lost with a killed process does not count
        elapsed_s = np.interp(evaluations["timesteps"], steps[timed], seconds[timed])
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"{run / 'progress.csv'} is missing or damaged. {advice}") from error
    columns = progress.dtype.names or ()
    record = read_record(run / RECORD)
    kept = EvaluationCache(run, agent_at(run, "last").path, cell.facts(), code)
    return {
        **{key: np.nanmean(progress[f"train/{key}"]) if f"train/{key}" in columns else np.nan for key in LOGGED},
        "timesteps": evaluations["timesteps"],
        "curve": evaluations["results"],
        "solved": evaluations["successes"][..., -1],
        "elapsed_s": elapsed_s,
        "cell": cell.facts(),
        "hyperparams": json.dumps(record["hyperparams"], sort_keys=True),
        # Of the code as it was when the training began, and as it is in this process
        "commit": named(record),
        "evaluation_commit": CODE,
        "machine": machines(record),
        **evaluate(cell, model, record["hyperparams"].get("explorer"), kept),
    }


def find_finished(cell: Cell, folder: Path) -> tuple[Path, Model] | None:
    """
    :param cell: what was to be trained
    :param folder: log folder
    :return: the run folder and its final model, None if there is no run, or none that is finished
    :raises ValueError: if a run in the folder is another one
    """
    for run in find_runs(folder) if any(records_in(folder)) else ():
        record = read_record(run / RECORD)
        has = {**training_facts(record["hyperparams"], record["arguments"]), **{key: record[key] for key in OF_RUN}}
        needs = _planned(cell)
        # What others follow from comes first
        for key in (*OF_RUN, *sorted({*has, *needs})):
            if has.get(key) != needs.get(key):
                raise ValueError(
                    f"{run} has {key} {has.get(key)!r}, but {cell.label} needs {needs.get(key)!r}, as the "
                    "experiment or the YAML file says: move this run away, or choose other --runs."
                )
        if is_finished(run, cell.env_id, cell.n_timesteps):
            return run, agent_at(run, "last").load()
    return None


def hyperparams_of(cell: Cell) -> dict[str, Any]:
    """
    :param cell: of an experiment
    :return: hyperparameters that it is trained with, as its record will have them
    """
    method = get_method(cell.method)
    file = method.algorithm.settings
    of_env = block_of(file, cell.env_id)
    with suppress(ValueError):  # code stays text
        of_env = plain_settings(of_env, file, trust=False, named=cell.gym_packages)
    of_env = checked_kinds(of_env, file)
    used = {**merged(method.settings(of_env), cell.settings), "n_timesteps": cell.n_timesteps}
    return cast(dict[str, Any], json.loads(json.dumps(used, default=str)))  # which knows no tuples


def in_training(cell: Cell) -> Evaluation:
    """
    :param cell: of an experiment
    :return: which of its evaluations is by the explorer of those during its training; its first one if none is
    """
    name = name_of(hyperparams_of(cell).get("explorer"))
    return next((own for own in cell.evaluations if own.explorer == name and not own.tested_on), cell.evaluations[0])


def _planned(cell: Cell) -> dict[str, Any]:
    """What its training is, as its record will say it."""
    facts = {**training_facts(hyperparams_of(cell), cell.training(Path())), **{key: getattr(cell, key) for key in OF_RUN}}
    return cast(dict[str, Any], json.loads(json.dumps(facts, default=str)))


def _check_loadable(cell: Cell) -> None:
    """Before it is trained: its model will be loaded as those of strangers are."""
    if env_kwargs := hyperparams_of(cell).get("env_kwargs"):
        raise ValueError(
            f"{cell.label} would be trained with env_kwargs {env_kwargs} of {get_method(cell.method).algorithm.settings}, and "
            "evaluated without: give them to the Variant in its place."
        )
    try:
        hyperparams = plain_settings(hyperparams_of(cell), cell.label, trust=False)
    except ValueError:  # code, as rl_zoo3 takes it: what it makes is known when it has been run
        return
    try:
        get_method(cell.method).algorithm.check_loadable(hyperparams)
    except ValueError as error:
        raise ValueError(f"{cell.label} could not be evaluated: {error.args[0].rstrip('.')}. Leave it out.") from None
