"""Runs in a storage of fsspec: each cell has one result, and a node that is gone costs what it had not sent."""

import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import fsspec
import numpy as np
import pytest
import torch as th
from fsspec.implementations.memory import MemoryFileSystem
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID
from helpers.results import made_up
from sb3_htr.experiments import driver as driver_module
from sb3_htr.experiments import grid
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.driver import Driver
from sb3_htr.experiments.executors import Here
from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.experiments.runner import find_finished, run_cell
from sb3_htr.experiments.storage import claim as claim_module
from sb3_htr.experiments.storage import objects
from sb3_htr.experiments.storage.claim import Claim, Watch
from sb3_htr.experiments.storage.objects import ObjectStorage
from sb3_htr.experiments.storage.working_copy import WorkingCopy
from sb3_htr.zoo.cli import main

CELLS = Experiment("toy", "", ENV_ID, 1000, (Variant("htr-ser"), Variant("htr-ec")), 3).cells()
TINY: dict[str, Any] = {
    "n_envs": 4,
    "n_tasks_per_rollout": 4,
    "n_episodes_per_task": 3,
    "learning_starts": 240,
    "gradient_steps": 4,
    "meta_batch_size": 4,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [8], "encoder_arch": [8]},
}
# A node that runs a cell, with a checkpoint after each rollout, and sends all the time
NODE = """
import pickle, sys
from pathlib import Path
from sb3_htr.experiments.storage import objects
from sb3_htr.experiments.cell import Cell

objects.SEND = 0.02
training = Cell.training
Cell.training = lambda cell, folder: [*training(cell, folder), "--save-freq", "1"]
objects.ObjectStorage(sys.argv[1]).run(pickle.loads(Path(sys.argv[2]).read_bytes()))
"""


@pytest.fixture
def url() -> str:
    """Of a storage of this process."""
    return f"memory://{uuid4().hex}/runs"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks are frequent, and who is silent is soon taken for dead."""
    monkeypatch.setattr(driver_module, "PERIOD", 0.02)
    monkeypatch.setattr(claim_module, "VOID", 0.5)
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)


@pytest.fixture
def trains(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Cell, Path], None]], list[str]]:
    """In place of training and evaluation, a function; gives the names of the cells that it was called for."""

    def make(function: Callable[[Cell, Path], None]) -> list[str]:
        trained: list[str] = []

        def run(cell: Cell, runs: Path) -> bool:
            trained.append(cell.name)
            function(cell, cell.run_folder(runs))
            cell.result(runs).parent.mkdir(parents=True, exist_ok=True)
            made_up([cell], cell.result(runs).parent)
            return True

        monkeypatch.setattr(objects, "run_cell", run)
        return trained

    return make


def test_of_several_that_claim_the_same_one_gets_it() -> None:
    files = fsspec.filesystem("memory")
    for _ in range(20):
        folder = f"/{uuid4().hex}"
        claims = [Claim(files, folder) for _ in range(8)]
        with ThreadPoolExecutor(8) as pool:
            taken = list(pool.map(Claim.take, claims))
        assert sum(taken) == 1 and [claim.is_ours() for claim in claims] == taken


def test_who_is_silent_loses_a_claim_and_who_is_done_leaves_it() -> None:
    files, folder = fsspec.filesystem("memory"), f"/{uuid4().hex}"
    silent, other, third = (Claim(files, folder) for _ in range(3))
    watch = Watch()

    def newest() -> tuple[str, dict[str, Any]]:
        return max(files.find(folder, detail=True).items())

    assert silent.take() and watch.is_alive(*newest()) and not other.take()
    for _ in range(4):
        time.sleep(0.2)
        silent.renew()
        assert watch.is_alive(*newest()), "as long as it is renewed"
    time.sleep(0.6)
    assert not watch.is_alive(*newest())
    void = newest()[0]
    assert other.take(void) and not third.take(void), "what is void is taken over once"
    assert other.is_ours() and not silent.is_ours() and watch.is_alive(*newest())
    # Comes back
    silent.renew()
    silent.release()
    assert other.is_ours()
    other.release()
    assert not watch.is_alive(*newest()) and not other.is_ours()
    assert third.take() and not other.is_ours()


class Failing(MemoryFileSystem):
    """Goes away after so many files."""

    cachable = False
    left = 0

    def put_file(self, *args: Any, **kwargs: Any) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError("gone")
        super().put_file(*args, **kwargs)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 8)), max_size=8))
def test_a_storage_has_at_any_time_what_a_killed_run_leaves(rollouts: list[tuple[bool, int]]) -> None:
    """However far a node came with sending: a checkpoint that is whole, and logs as new as it."""
    files, there, sent = Failing(), f"/{uuid4().hex}", 0
    with TemporaryDirectory() as folder:
        here = Path(folder, "here")
        copy = WorkingCopy(files, there, here)
        for number, (saves, files.left) in enumerate(rollouts, start=1):
            write(here / "progress.csv", "row\n" * number)
            # One more is begun
            write(here / "checkpoints" / ".9_steps.tmp" / "state.pt", "")
            if saves:
                write(here / "checkpoints" / f"{number}_steps" / "state.pt", str(number))
                write(here / "checkpoints" / f"{number}_steps" / "manifest.json", str(number))
                for old in sorted((here / "checkpoints").glob("?_steps"))[:-2]:
                    shutil.rmtree(old)
            with suppress(OSError):
                copy.send()
                sent = number if saves else sent
            fetched = Path(folder, str(number))
            WorkingCopy(files, there, fetched).fetch()
            whole = [path.name for path in fetched.glob("checkpoints/*") if len(list(path.iterdir())) == 2]
            latest = max((int(name[0]) for name in whole), default=0)
            assert latest >= sent and not list(fetched.rglob(".*"))
            assert not latest or len((fetched / "progress.csv").read_text().split()) >= latest


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_several_drivers_share_the_cells_and_none_runs_twice(
    url: str, trains: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(cell: Cell, folder: Path) -> None:
        write(folder / "htr-ser/run_1/checkpoints/500_steps/state.pt", "half")
        if cell.name == CELLS[0].name and trained.count(cell.name) == 1:
            raise RuntimeError("no luck")
        time.sleep(0.05)

    trained = trains(work)
    drivers = [threading.Thread(target=Driver(CELLS, url, ThreadPoolExecutor(2)).run) for _ in range(3)]
    for thread in drivers:
        thread.start()
    for thread in drivers:
        thread.join()
    assert sorted(trained) == sorted([CELLS[0].name, *(cell.name for cell in CELLS)]), "what failed is tried again"
    out, err = capsys.readouterr()
    assert "6 of 6 cells done" in out and "failed, and is tried again at 500 env steps: RuntimeError: no luck" in err
    storage = ObjectStorage(url)
    here = storage.fetch_results(CELLS)
    assert all(cell.result(here).exists() and not storage.is_claimed(cell) for cell in CELLS)
    Driver(CELLS, url, Here()).run()
    assert len(trained) == 7, "what is done is skipped"


def test_one_that_was_taken_for_dead_sends_nothing(url: str, trains: Any) -> None:
    """Its cell goes on from what it had sent before."""
    (cell, *_), storage = CELLS, ObjectStorage(url)

    def work(cell: Cell, folder: Path) -> None:
        storage.look([cell])
        assert storage.is_claimed(cell)
        (path,) = storage.files.find(f"{storage.root}/{cell.experiment}/{cell.name}/.claim")
        assert Claim(storage.files, path.rpartition("/")[0]).take(void=path)
        write(folder / "late.txt", "")

    trained = trains(work)
    assert not storage.run(cell) and not storage.run(cell) and trained == [cell.name]
    assert not storage.files.glob(f"{storage.root}/**/late.txt")
    storage.look([cell])
    assert not storage.is_finished(cell) and storage.is_claimed(cell)


def test_a_killed_node_costs_what_it_had_not_sent(tmp_path: Path) -> None:
    """The result is that of a run that nobody disturbed."""
    (cell,) = Experiment("one", "", ENV_ID, 4800, (Variant("htr-ser", "tiny", TINY),), 1, 480, by(("prior",))).cells()
    pickled, url = tmp_path / "cell", f"local://{tmp_path / 'storage'}"
    pickled.write_bytes(pickle.dumps(cell))
    node = subprocess.Popen([sys.executable, "-c", NODE, url, str(pickled)])
    storage = ObjectStorage(url)
    while not 0 < storage.n_steps(cell) < 4000:
        assert node.poll() is None
        storage.look([cell])
    node.send_signal(signal.SIGKILL)
    node.wait()
    storage.look([cell])
    assert storage.is_claimed(cell) and not storage.run(cell), "it may be at work"
    Driver([cell], url, Here()).run()
    (run,) = (tmp_path / "storage" / "one").glob("tiny-seed1/htr-ser/*")
    assert "Going on from" in (run.parents[1] / "log.txt").read_text() and not list(run.rglob("evaluated"))
    (tmp_path / "undisturbed").mkdir()
    assert run_cell(cell, tmp_path / "undisturbed")
    folders = tmp_path / "storage", tmp_path / "undisturbed"
    ours, theirs = (np.load(cell.result(folder)) for folder in folders)
    assert (ours["returns_prior"] == theirs["returns_prior"]).all() and (ours["curve"] == theirs["curve"]).all()
    models = [find_finished(cell, cell.run_folder(folder)) for folder in folders]
    weights = [model[1].policy.state_dict() for model in models if model is not None]
    assert len(weights) == 2 and all(th.equal(weights[0][name], weights[1][name]) for name in weights[1])


def test_the_command_runs_in_a_storage_and_reports_from_it(
    url: str, trains: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = trains(lambda cell, folder: None)
    pair = Experiment("pair", "", ENV_ID, 480, (Variant("htr-ser"),), 2, eval_freq=240, evaluations=by(("prior",)))
    monkeypatch.setitem(grid.EXPERIMENTS, "pair", pair)
    monkeypatch.setattr("sb3_htr.experiments.executors.Processes", lambda _: Here())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"No run of pair is finished in {url}"):
        main(["experiment", "pair", "--finished", "--runs", url])
    assert main(["experiment", "pair", "--cell", "1", "--runs", url]) == 0
    assert main(["experiment", "pair", "--runs", url]) == 0
    assert trained == ["htr-ser-seed2", "htr-ser-seed1"] and Path("results/pair/summary.json").exists()
    assert main(["experiment", "pair", "--runs", f"{url}/elsewhere", "--with-results", "results/pair", "-o", "again"]) == 0
    assert main(["experiment", "pair", "--runs", f"{url}/elsewhere", "--finished", "-o", "once more"]) == 0
    assert len(trained) == 2 and "2 of 2 runs of pair are finished." in capsys.readouterr().out
    assert {path.name for path in Path().iterdir()} == {"results", "again", "once more"}, "no runs are here"


@pytest.mark.parametrize(("runs", "reason"), [("nope://bucket/runs", "Protocol not known: nope")])
def test_a_url_that_cannot_be_opened_is_refused(runs: str, reason: str) -> None:
    with pytest.raises(ValueError, match=rf"{runs} cannot be opened \({reason}\): give a folder, or a URL of fsspec"):
        main(["experiment", "point_robot", "--runs", runs])


def test_a_storage_that_cannot_be_used_is_said_before_anything_is_run(
    url: str, trains: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = trains(lambda cell, folder: None)

    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError("no credentials")

    monkeypatch.setattr(MemoryFileSystem, "pipe_file", refuse)
    with pytest.raises(OSError, match=rf"{url} cannot be written to: no credentials"):
        main(["experiment", "point_robot", "--runs", url])
    monkeypatch.setattr(MemoryFileSystem, "find", refuse)
    with pytest.raises(OSError, match=rf"{url} cannot be read: no credentials"):
        main(["experiment", "point_robot", "--runs", url, "--finished"])
    assert not trained
