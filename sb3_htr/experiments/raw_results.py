"""Raw results: of one run as it ends, and of many in one file for each method, as ``results/<name>/`` has them. And back."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.atomic import atomic_path
from sb3_htr.experiments.cell import Cell, KwArgs, read_facts
from sb3_htr.experiments.runner import LOGGED, hyperparams_of

# Of the code that trained, and of that which evaluated
COMMITS = ("commit", "evaluation_commit")
# What a report is made of
NEEDED = ("timesteps", "curve", "solved", "elapsed_s", "calibration", *COMMITS, *LOGGED)


def needed(cell: Cell) -> tuple[str, ...]:
    """
    :param cell: of an experiment
    :return: names of the arrays that its raw results must have
    """
    return *NEEDED, *(f"returns_{evaluation.name}" for evaluation in cell.evaluations)


def differing(one: KwArgs, other: KwArgs) -> list[str]:
    """
    :param one: hyperparameters
    :param other: likewise
    :return: names of those that are not the same, of those within others as ``replay_buffer_kwargs.relabel_probability``
    """
    names: list[str] = []
    for key in sorted({*one, *other}):
        ours, theirs = one.get(key), other.get(key)
        if isinstance(ours, dict) and isinstance(theirs, dict):
            names += [f"{key}.{name}" for name in differing(ours, theirs)]
        elif ours != theirs:
            names.append(key)
    return names


def check(cell: Cell, raw: Mapping[str, Any], what: str, advice: str, if_lacking: str = "") -> None:
    """
    :param cell: of an experiment
    :param raw: raw results
    :param what: they are, for the message
    :param advice: what to do if they are not of the cell, likewise
    :param if_lacking: another one, if they lack something
    :raises ValueError: if they are of something else, were trained with other hyperparameters than the cell would be, or lack
        something, be it what they are of, as those of older versions do
    """
    missing = sorted({"cell", "hyperparams", *needed(cell)} - raw.keys())
    if "cell" not in missing:  # what is of something else may lack what it never needed
        cell.check_facts(raw, what, advice)
    if missing:
        raise ValueError(f"{what} lacks {missing}, which {cell.experiment} needs: {if_lacking or advice}")
    if different := differing(read_facts(raw, "hyperparams", what, advice), hyperparams_of(cell)):
        raise ValueError(
            f"{what} was trained with other {different} than {cell.label} would be: has a YAML file changed in between? "
            f"Restore it, or {advice}"
        )


def pack(results: Mapping[Cell, Path], folder: Path) -> None:
    """
    Write a ``raw-METHOD.npz`` for each method: of all together it may be some megabytes.

    :param results: raw results of cells
    :param folder: where they go
    """
    by_method: dict[str, dict[str, Any]] = {}
    for cell, result in results.items():
        arrays = {f"{cell.name}/{key}": value for key, value in load_arrays(result).items()}
        by_method.setdefault(cell.method, {}).update(arrays)
    for method, packed in by_method.items():
        with atomic_path(_packed(folder, method)) as path:
            np.savez_compressed(path, **packed)


def unpack(folder: Path, cells: Sequence[Cell], runs: Path) -> int:
    """
    Make what :func:`pack` wrote finished runs, which nobody trains again. What is finished already stays.

    :param folder: of results
    :param cells: of an experiment
    :param runs: folder of all experiments' runs
    :return: how many of the runs the folder has
    :raises ValueError: if it has none of them, one that is not of its cell, see :func:`check`, or damaged files
    """
    advice = "leave the folder out of --with-results."
    load_method = cache(lambda path: load_arrays(path, advice=advice.capitalize()) if path.exists() else {})
    found: dict[Cell, dict[str, Any]] = {}
    for cell in cells:
        path, start = _packed(folder, cell.method), f"{cell.name}/"
        raw = {key.removeprefix(start): value for key, value in load_method(path).items() if key.startswith(start)}
        if not raw:
            continue
        check(cell, raw, f"{cell.name} in {path}", advice)
        found[cell] = raw
    if not found:
        expected = f"raw-METHOD.npz with runs such as {cells[0].name}"
        raise ValueError(f"{folder} has no run of {cells[0].experiment}: expected {expected}.")
    for cell, whole in found.items():
        if not cell.result(runs).exists():
            with atomic_path(cell.result(runs)) as result:
                np.savez_compressed(result, **whole)
    return len(found)


def check_none_lost(folder: Path, cells: Sequence[Cell]) -> None:
    """
    :param folder: of results, about to be written
    :param cells: that they are of
    :raises ValueError: if it has runs of others, or others of the same names, which would be lost; or damaged files
    :raises NotADirectoryError: if it is a file
    """
    if folder.is_file():
        raise NotADirectoryError(f"{folder} is a file, expected a folder for the results: name another one with -o.")
    by_name = {cell.name: cell for cell in cells}
    advice = "name another folder with -o, or move this one away."
    lost = set()
    for path in folder.glob("raw-*.npz"):
        arrays = load_arrays(path, advice="Move it away.")
        for name in {key.partition("/")[0] for key in arrays}:
            if name not in by_name:
                lost.add(name)
            elif f"{name}/cell" in arrays:
                by_name[name].check_facts({"cell": arrays[f"{name}/cell"]}, f"{name} in {path}", advice)
    if lost:
        raise ValueError(
            f"{folder} has {len(lost)} runs that these results would not have, {min(lost)} among them: {advice} Runs of the "
            f"same experiment are kept by --with-results {folder}, and as many --seeds."
        )


def _packed(folder: Path, method: str) -> Path:
    return folder / f"raw-{method}.npz"
