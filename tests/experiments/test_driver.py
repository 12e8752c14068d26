"""Each cell of a grid gets one result, whoever runs it and whatever fails on the way."""

import errno
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sb3_htr.common.divergence import DivergedError
from sb3_htr.experiments import driver as driver_module
from sb3_htr.experiments import executors
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.driver import ATTEMPTS, Driver
from sb3_htr.experiments.executors import Processes, SerialExecutor
from sb3_htr.experiments.grid import EXPERIMENTS, Experiment, Variant
from sb3_htr.experiments.runner import lock_of, run_cell
from sb3_htr.experiments.storage.folder import SharedFolder
from sb3_htr.zoo.cli import main

CELLS = Experiment("toy", "", "SparsePointRobot-v0", 1000, (Variant("htr-ser"), Variant("htr-ec", "K = 0.8")), 3).cells()
Arrays = dict[str, Any]
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks are frequent."""
    monkeypatch.setattr(driver_module, "PERIOD", 0.02)


@pytest.fixture
def trains(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Cell, Path], None]], list[str]]:
    """In place of training and evaluation, a function; gives the names of the cells that it was called for."""

    def make(function: Callable[[Cell, Path], None]) -> list[str]:
        trained: list[str] = []

        def train_and_evaluate(cell: Cell, folder: Path) -> Arrays:
            trained.append(cell.name)
            function(cell, folder)
            return {"cell": cell.facts(), "seed": cell.seed}

        monkeypatch.setattr("sb3_htr.experiments.runner._train_and_evaluate", train_and_evaluate)
        return trained

    return make


def test_several_drivers_share_the_cells_and_none_runs_twice(
    trains: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Threads of one process share what is printed to
    monkeypatch.setattr("sb3_htr.experiments.runner.logged", nullcontext)
    trained = trains(lambda cell, folder: time.sleep(0.05))
    drivers = [threading.Thread(target=Driver(CELLS, tmp_path, ThreadPoolExecutor(2)).run) for _ in range(3)]
    for thread in drivers:
        thread.start()
    for thread in drivers:
        thread.join()
    assert sorted(trained) == sorted(cell.name for cell in CELLS) and len(set(trained)) == 6
    assert all(cell.result(tmp_path).exists() for cell in CELLS)
    Driver(CELLS, tmp_path, SerialExecutor()).run()
    assert len(trained) == 6, "what is done is skipped"


def test_a_cell_that_runs_elsewhere_is_waited_for(trains: Any, tmp_path: Path) -> None:
    trained = trains(lambda cell, folder: None)
    cell = CELLS[0]
    cell.run_folder(tmp_path).mkdir(parents=True)
    with lock_of(cell, tmp_path):
        assert not run_cell(cell, tmp_path)
        waiting = threading.Thread(target=Driver([cell], tmp_path, SerialExecutor()).run)
        waiting.start()
        time.sleep(0.2)
        assert waiting.is_alive() and not trained
    # Its process ended, and left no result
    waiting.join(10)
    assert trained == [cell.name] and cell.result(tmp_path).exists()


def test_failures_are_tried_again_from_where_they_were_and_reported(
    trains: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One cell fails always, one gets a little further each time, the others work."""
    hopeless, slow = CELLS[0], CELLS[1]

    def work(cell: Cell, folder: Path) -> None:
        if cell.name == hopeless.name:
            print("a hint")
            raise RuntimeError("no luck")
        done = len(list(folder.glob("*/*/checkpoints/*")))
        if cell.name == slow.name and done < 2 * ATTEMPTS:
            (folder / f"htr-ec/run_1/checkpoints/{100 * (done + 1)}_steps").mkdir(parents=True)
            raise OSError("out of memory")

    trained = trains(work)
    with pytest.raises(ValueError, match=r"1 of 6 cells failed .*/htr-ser-seed1: failed 3 times: RuntimeError: no luck"):
        Driver(CELLS, tmp_path, SerialExecutor()).run()
    assert trained.count(hopeless.name) == ATTEMPTS and trained.count(slow.name) == 2 * ATTEMPTS + 1 and len(set(trained)) == 6
    out, err = capsys.readouterr()
    assert "5 of 6 cells done, 0 running, 1 failed" in out
    assert "K=0.8-seed1 failed, and is tried again at 600 env steps: OSError: out of memory" in err
    log = (hopeless.run_folder(tmp_path) / "log.txt").read_text()
    assert log.count("a hint") == ATTEMPTS and "RuntimeError: no luck" in log


def test_a_training_that_diverged_is_given_up_at_once(
    trains: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a wait for its node, which is not at fault."""

    def work(cell: Cell, folder: Path) -> None:
        raise DivergedError("critic_loss is nan")

    trained = trains(work)
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail("It waits."))
    with pytest.raises(DivergedError):
        executors._call(run_cell, CELLS[0], tmp_path)
    with pytest.raises(ValueError, match=r"1 of 1 cells failed .*-seed1: failed: DivergedError: critic_loss is nan"):
        Driver(CELLS[:1], tmp_path, SerialExecutor()).run()
    assert len(trained) == 2
    assert "htr-ser-seed1 failed at 0 env steps: DivergedError: critic_loss" in capsys.readouterr().err


def test_what_was_given_up_here_and_done_elsewhere_is_no_failure(trains: Any, tmp_path: Path) -> None:
    def work(cell: Cell, folder: Path) -> None:
        if trained.count(cell.name) == ATTEMPTS:
            cell.result(tmp_path).touch()
        if cell.name == CELLS[0].name:
            raise RuntimeError("no luck")

    trained = trains(work)
    Driver(CELLS, tmp_path, SerialExecutor()).run()


def test_progress_counts_cells_and_env_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(CELLS, tmp_path, SerialExecutor())
    assert driver.line(driver.todo()) == "0 of 6 cells done, 0 running, 0 % of the env steps"
    done, running = CELLS[:2]
    (running.run_folder(tmp_path) / "htr-ec/run_1/checkpoints/500_steps").mkdir(parents=True)
    done.result(tmp_path).touch()
    # A minute later
    now = time.monotonic() + 60
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with lock_of(running, tmp_path):
        assert driver.line(driver.todo()) == "1 of 6 cells done, 1 running, 25 % of the env steps, 0:03:00 left"
        # The last rollout goes beyond the budget, and the evaluation is still to come
        (running.run_folder(tmp_path) / "htr-ec/run_1/checkpoints/1200_steps").mkdir()
        assert driver.line(driver.todo()) == "1 of 6 cells done, 1 running, 33 % of the env steps, 0:02:00 left"
    # What was given up is neither done nor left
    driver.failed[CELLS[2].label] = "no luck"
    assert driver.line(driver.todo()) == "1 of 6 cells done, 0 running, 1 failed, 33 % of the env steps, 0:01:30 left"


def test_what_is_given_up_brings_the_end_no_nearer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(CELLS, tmp_path, SerialExecutor())
    driver.line(driver.todo())
    now = time.monotonic() + 60
    monkeypatch.setattr(time, "monotonic", lambda: now)
    driver.failed |= {cell.label: "no luck" for cell in CELLS[:3]}
    assert driver.line(driver.todo()) == "0 of 6 cells done, 0 running, 3 failed, 0 % of the env steps"


def test_a_node_that_sees_another_folder_is_found_out(trains: Any, tmp_path: Path) -> None:
    trained = trains(lambda cell, folder: None)
    with pytest.raises(FileNotFoundError, match=r"no folder .*elsewhere on this node: give --runs that all nodes see"):
        run_cell(CELLS[0], tmp_path / "elsewhere")

    class OtherDisk(SerialExecutor):
        def submit(self, fn: Any, cell: Any, runs: Any) -> Any:  # type: ignore[override]
            (tmp_path / "other").mkdir(exist_ok=True)
            return super().submit(fn, cell, tmp_path / "other")

    with pytest.raises(ValueError, match="its node has a result that is not in"):
        Driver(CELLS[:1], tmp_path / "here", OtherDisk()).run()
    assert trained == [CELLS[0].name]


def _hold(cell: Cell, runs: Path, held: Any) -> None:
    with lock_of(cell, runs):
        held.set()
        time.sleep(60)


def test_the_claim_of_a_killed_process_is_void(tmp_path: Path) -> None:
    cell, context = CELLS[0], get_context("fork")
    cell.run_folder(tmp_path).mkdir(parents=True)
    held = context.Event()
    process = context.Process(target=_hold, args=(cell, tmp_path, held))
    process.start()
    assert held.wait(10) and SharedFolder(tmp_path).is_claimed(cell)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not SharedFolder(tmp_path).is_claimed(cell)


@pytest.mark.parametrize("n_threads", [None, "3"])
def test_processes_have_one_thread_and_the_host_those_that_it_had(
    n_threads: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if n_threads is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", n_threads)
    with Processes(1):
        assert os.environ["OMP_NUM_THREADS"] == "1"
    assert os.environ.get("OMP_NUM_THREADS") == n_threads


def test_a_killed_worker_process_takes_no_other_with_it() -> None:
    with Processes(2) as executor:
        killed, other = executor.submit(os._exit, 9), executor.submit(os.getpid)
        assert other.result() != os.getpid() and "terminated abruptly" in str(killed.exception())


@pytest.mark.parametrize("n_begun", [0, 2])
def test_who_stops_stops_what_runs_too(n_begun: int, tmp_path: Path) -> None:
    """Of a driver that is interrupted alone, as by a scheduler; what did not begin yet never does."""
    executor = Processes(2)
    # A function of this file would have each process import all that the file does
    sleeps = "import pathlib, time; pathlib.Path({!r}).touch(); time.sleep(100)"
    futures = [executor.submit(exec, sleeps.format(str(tmp_path / str(i)))) for i in range(3)]
    while len(list(tmp_path.iterdir())) < n_begun:
        time.sleep(0.01)
    start = time.monotonic()
    executor.shutdown(cancel_futures=True)
    assert time.monotonic() - start < 50 and futures[2].cancelled()
    assert all(isinstance(future.exception(), KeyboardInterrupt) for future in futures[:2])


def test_a_node_on_which_all_fails_at_once_does_not_take_the_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept = [100.0], list[float]()

    def fail_after(seconds: float) -> None:
        now[0] += seconds
        raise ZeroDivisionError

    monkeypatch.setattr(executors, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=slept.append))
    assert executors._call(divmod, 7, 2) == (3, 1) and not slept
    for seconds in (15.0, 70.0):
        with pytest.raises(ZeroDivisionError):
            executors._call(fail_after, seconds)
    assert slept == [executors.FAST - 15, 0], "a minute in all"


def test_one_that_is_interrupted_alone_ends_no_other(trains: Any, tmp_path: Path) -> None:
    def train(cell: Cell, folder: Path) -> None:
        if cell == CELLS[1]:
            raise KeyboardInterrupt

    trained = trains(train)
    with pytest.raises(ValueError, match=r"1 of 6 cells failed .*: it was interrupted"):
        Driver(CELLS, tmp_path, ThreadPoolExecutor(1)).run()
    assert len(trained) == 6


def test_what_a_server_does_not_answer_is_asked_again(trains: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [OSError(errno.ESTALE, "Stale file handle"), None, OSError(errno.EIO, "Input/output error")]
    listdir = os.listdir

    def sometimes(folder: Any) -> list[str]:
        error = errors.pop(0) if errors else None
        if error is not None:
            raise error
        return listdir(folder)

    monkeypatch.setattr("sb3_htr.experiments.storage.folder.os.listdir", sometimes)
    trained = trains(lambda cell, folder: None)
    Driver(CELLS, tmp_path, ThreadPoolExecutor(1)).run()
    assert sorted(trained) == sorted(cell.name for cell in CELLS) and not errors


@pytest.mark.parametrize(("number", "is_said"), [(errno.ESTALE, False), (errno.ENOSYS, True), (errno.EACCES, True)])
def test_what_will_never_work_is_said(number: int, is_said: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> Any:
        raise OSError(number, "no lock")

    (cell, *_), folder = CELLS, SharedFolder(tmp_path)
    cell.run_folder(tmp_path).mkdir(parents=True)
    monkeypatch.setattr("sb3_htr.experiments.storage.folder.lock_of", fail)
    with pytest.raises(OSError, match="no lock") if is_said else nullcontext():
        assert folder.is_claimed(cell)


def test_the_job_array_of_the_manual_runs_its_cell(tmp_path: Path) -> None:
    """As Slurm would, but with a command that only says how it was called."""
    script = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "scaling.md").read_text(), re.DOTALL)[0]
    cells = EXPERIMENTS["point_robot"].cells()
    assert f"--array=0-{len(cells) - 1}\n" in script
    command = tmp_path / "sb3-htr"
    command.write_text('#!/bin/bash\necho "$OMP_NUM_THREADS:" "$@"\n')
    command.chmod(0o755)
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "SLURM_ARRAY_TASK_ID": "7"}
    said = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=True).stdout
    assert said == "1: experiment point_robot --runs /shared/runs --cell 7\n"


@pytest.mark.parametrize("option", ["--seeds", "--jobs"])
@pytest.mark.parametrize("n", [0, -1])
def test_no_runs_are_no_experiment(option: str, n: int, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{option} is {n}, expected a whole number of at least 1"):
        main(["experiment", "precision", option, str(n), "--runs", str(tmp_path)])
