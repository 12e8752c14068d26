"""A run folder has one owner, however many processes begin at once."""

import errno
import fcntl
import json
import multiprocessing
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from helpers import ENV_ID
from helpers.disks import half_written
from helpers.runs import run_folder, train_arguments
from sb3_htr import PEARL
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.folder import claim, lock
from sb3_htr.zoo.run.record import RECORD, write_record

N_RACES, N_RUNNERS, N_RUNS = 20, 4, 90
NEXT = range(N_RUNS + 1, N_RUNS + 1 + N_RUNNERS)
# A process that has a run
HOLD = """
import sys
from pathlib import Path
from sb3_htr.zoo.run.folder import lock
owner = lock(Path(sys.argv[1]))
print("locked", flush=True)
sys.stdin.read()
"""


def race(folder: Path, start: Any, results: Any) -> None:
    """In a process of its own; to look at the runs that there are takes so long that the others do it meanwhile."""
    for number in range(N_RACES):
        start.wait()
        results.put((number, claim(str(folder / str(number)), ENV_ID, "").name))


def test_runs_that_begin_at_once_take_different_numbers(tmp_path: Path) -> None:
    for number in range(N_RACES):
        for run in range(1, N_RUNS + 1):
            (tmp_path / str(number) / f"{ENV_ID}_{run}").mkdir(parents=True)
    processes = multiprocessing.get_context("fork")
    start, results = processes.Barrier(N_RUNNERS), processes.Queue()
    runners = [processes.Process(target=race, args=(tmp_path, start, results)) for _ in range(N_RUNNERS)]
    for runner in runners:
        runner.start()
    taken = sorted(results.get(timeout=60) for _ in range(N_RACES * N_RUNNERS))
    for runner in runners:
        runner.join()
    assert taken == [(race, f"{ENV_ID}_{number}") for race in range(N_RACES) for number in NEXT]


def test_a_number_is_never_given_twice(tmp_path: Path) -> None:
    assert [claim(str(tmp_path), ENV_ID, "").name for _ in range(2)] == [f"{ENV_ID}_1", f"{ENV_ID}_2"]
    (tmp_path / f"{ENV_ID}_7").mkdir()
    for name in ("²", "x", "9x", ""):
        (tmp_path / f"{ENV_ID}_{name}").mkdir()
    assert claim(str(tmp_path), ENV_ID, "_unique").name == f"{ENV_ID}_8_unique"


def test_a_run_that_is_being_trained_cannot_be_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(train_arguments(Path("runs"), 480, "--save-freq", "240")) == 0
    run = run_folder(Path("runs"))
    (run / f"{ENV_ID}.zip").unlink()
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    command = [sys.executable, "-c", HOLD, str(run)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None and owner.stdout.readline() == b"locked\n"
        with pytest.raises(ValueError, match=f"{run} is being trained by another process: wait for its end, or begin a new"):
            main(["train", "--resume", str(run)])
        assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before, "nothing of it was touched"
        owner.kill()
    assert main(["train", "--resume", str(run)]) == 0, "a process that is killed owns nothing any more"
    assert (run / f"{ENV_ID}.zip").exists()
    lock(run).release()


def test_a_run_has_its_owner_until_its_last_model_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved = []

    def save(model: Any, path: str) -> None:
        with pytest.raises(ValueError, match="is being trained by another process"):
            lock(Path(path).parent)
        saved.append(Path(path))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(PEARL, "save", save)
    assert main(train_arguments(Path("runs"), 240)) == 0
    assert saved[-1].name == f"{ENV_ID}.zip"
    lock(saved[-1].parent).release()


def test_a_record_that_is_half_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_record(tmp_path, {"seed": 1})
    monkeypatch.setattr(Path, "write_text", half_written)
    with pytest.raises(KeyboardInterrupt):
        write_record(tmp_path, {"seed": 2})
    assert json.loads((tmp_path / RECORD).read_text()) == {"seed": 1}


def test_without_locks_of_the_system_nothing_is_owned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A marker in their place would outlive a process that is killed on another node."""

    def flock(*args: Any) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises((OSError, NotImplementedError)), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lock(tmp_path)
