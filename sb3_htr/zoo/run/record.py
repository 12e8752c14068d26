"""The record of a run: what it was begun with, and by which code and on which machines it went on."""

import json
import math
import os
import shlex
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.versions import UNKNOWN_HARDWARE, differences, made_by
from sb3_htr.zoo.run.train_arguments import given_arguments
from sb3_htr.zoo.run.trust import PACKAGES

# Record of a run: in its folder, and in an exported model file
RECORD = "run.json"
# Its bytes, at most
MAX_RECORD = 2**20
# What it must say, and what it may say for training on and for model cards
REQUIRED = {"env_id": str, "env_kwargs": dict, "gym_packages": list}
OF_TRAINING = {"arguments": list, "n_timesteps": int, "seed": int, "method": str, "hyperparams": dict, "hardware": list}
# Which it has if they were of a trial of a study: its hyperparameters
TRIAL = "trial"
# By which the arguments name that trial, with a value each
OF_STUDY = ("--storage", "--study-name", "--trial-id")


def read_record(path: Path, content: bytes | None = None) -> dict[str, Any]:
    """
    :param path: of the record, or of the file that it is in
    :param content: if it was read already
    :return: the record of a run
    :raises ValueError: if it is damaged
    """
    try:
        record = json.loads(path.read_bytes() if content is None else content)
        given = {name: kind for name, kind in OF_TRAINING.items() if name in record}
        texts = *record["gym_packages"], *record.get("arguments", ()), *record.get("hardware", ())
        code = record, *record.get("resumed_by", ())
        kinds_are_right = all(type(record[name]) is kind for name, kind in {**REQUIRED, **given}.items())
        kinds_are_right &= all(type(by.get("versions", {})) is dict for by in code) and type(record.get(TRIAL, {})) is dict
        if kinds_are_right and all(isinstance(text, str) for text in texts):
            return cast(dict[str, Any], record)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    raise ValueError(f"{path} is damaged, or no record of a run: it must say env_id, env_kwargs and gym_packages.")


def records_in(folder: Path) -> Iterator[Path]:
    """
    :param folder: a run folder, or a folder with runs somewhere in it, or links to some
    :return: their records, each once
    """
    known, places = set[str](), [os.fspath(folder)]
    for place in places:  # links last, so that a run has its own name
        for path, folders, files in os.walk(place):
            if (real := os.path.realpath(path)) in known:
                folders.clear()
                continue
            known.add(real)
            if RECORD in files:
                yield Path(path, RECORD)
            places += [link for name in folders if os.path.islink(link := os.path.join(path, name))]


def arguments_to_go_on(record: dict[str, Any]) -> list[str]:
    """
    :param record: of a run
    :return: what the user gave, but for a study whose trial the record has
    """
    given = given_arguments(record["arguments"])
    if TRIAL not in record:
        return given
    of_study = [option in OF_STUDY or word in OF_STUDY for option, word in zip(["", *given], given, strict=False)]
    return [word for word, leave_out in zip(given, of_study, strict=True) if not leave_out]


def command_to_go_on(run: Path, record: dict[str, Any], trust: bool = False) -> str:
    """
    :param run: folder
    :param record: of it
    :param trust: whether its files have to be trusted
    :return: the command that goes on with it, to be copied
    """
    packages = [name for name in record["gym_packages"] if name not in PACKAGES]
    named = ["--gym-packages", *packages] if packages else []
    return shlex.join(["sb3-htr", "train", "--resume", str(run), *named, *["--trust"] * trust])


def write_record(run: Path, record: dict[str, Any]) -> None:
    """
    :param run: folder
    :param record: of it
    :raises OSError: if it cannot be written
    """
    with atomic_path(run / RECORD) as path:
        path.write_text(json.dumps(record, indent=2, default=str))


def record_going_on(
    record: dict[str, Any], run: Path, hyperparams: dict[str, Any], arguments: list[str], here: str, n_steps: int
) -> dict[str, Any]:
    """
    :param record: of a run that goes on
    :param run: its folder, for messages
    :param hyperparams: as they are now, the budget ``n_timesteps`` among them
    :param arguments: of the training as it is now
    :param here: device and machine
    :param n_steps: env steps after which it goes on
    :return: the record from now on; other code is warned of
    :raises ValueError: if something else than a larger budget has changed
    """
    before, now = record["hyperparams"], json.loads(json.dumps(hyperparams, default=str))
    is_longer = before.get("n_timesteps", math.inf) < now["n_timesteps"]
    changed = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    if is_longer:
        changed.remove("n_timesteps")
    if changed:
        raise ValueError(
            f"The hyperparameters {changed} have changed since {run} was begun: a run goes on with the settings that it has. "
            "Restore the YAML file, or begin a new run."
        )
    result = dict(record)
    if here not in (known := record.get("hardware", [UNKNOWN_HARDWARE])):
        result["hardware"] = [*known, here]
    if is_longer:
        result |= {"n_timesteps": now["n_timesteps"], "arguments": arguments, "hyperparams": now}
    # Defaults are of the code, so what is not in the hyperparameters may be another from here on
    resumed_by, code = record.get("resumed_by", []), made_by()
    if other := differences([record, *resumed_by][-1], code):
        result["resumed_by"] = [*resumed_by, {"from": n_steps, **code}]
        warnings.warn(
            f"{run} goes on with other code ({', '.join(other)}), whose defaults may be others, so it need not end as it "
            "would have. Its run.json names both from now on.",
            stacklevel=2,
        )
    return result
