"""Runs in an object store: each cell has one result, and a node that is gone costs what it had not sent."""

import itertools
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID
from helpers.bucket import PROTOCOL, Bucket
from helpers.results import made_up
from helpers.runs import OF_CELL
from sb3_htr.common.checkpoint import n_steps_at
from sb3_htr.experiments import driver as driver_module
from sb3_htr.experiments import grid
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.driver import Driver
from sb3_htr.experiments.executors import SerialExecutor
from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.experiments.runner import find_finished, run_cell
from sb3_htr.experiments.storage import claim as claim_module
from sb3_htr.experiments.storage import objects, storage_at
from sb3_htr.experiments.storage.claim import Claim, Watch
from sb3_htr.experiments.storage.folder import SharedFolder
from sb3_htr.experiments.storage.node_folder import node_folder
from sb3_htr.experiments.storage.objects import ObjectStore
from sb3_htr.experiments.storage.working_copy import WorkingCopy
from sb3_htr.zoo.cli import main

CELLS = Experiment("toy", "", ENV_ID, 1000, (Variant("htr-ser"), Variant("htr-ec")), 3).cells()
TINY_RUN = Variant("htr-ser", "tiny", OF_CELL, {"n_test_tasks": 4})
# A node that runs a cell, with a checkpoint after each rollout, and sends all the time
NODE = """
import pickle, sys
from pathlib import Path
import helpers.bucket
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.storage import objects

objects.SEND = 0.02
training = Cell.training
Cell.training = lambda cell, folder: [*training(cell, folder), "--save-freq", "1"]
objects.run_on_copy(pickle.loads(Path(sys.argv[2]).read_bytes()), sys.argv[1])
"""


# Seconds
VOID = 2.0


@pytest.fixture
def url(tmp_path: Path) -> str:
    """Of a store."""
    return f"{PROTOCOL}://{tmp_path / 'store'}"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks are frequent, who is silent is soon taken for dead, and what fails is soon tried again."""
    monkeypatch.setattr(driver_module, "PERIOD", 0.02)
    monkeypatch.setattr(claim_module, "VOID", VOID)
    monkeypatch.setattr(objects, "RENEW", 0.05)
    monkeypatch.setattr(objects, "PATIENCE", (0.01, 0.01))
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What a watch says, which goes on as the test makes it."""
    now = [0.0]
    monkeypatch.setattr(claim_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def trains(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Cell, Path], None]], list[str]]:
    """In place of training and evaluation, a function; gives the names of the cells that it was called for."""

    def make(function: Callable[[Cell, Path], None]) -> list[str]:
        trained: list[str] = []

        def run(cell: Cell, runs: Path) -> bool:
            if not cell.result(runs).exists():
                trained.append(cell.name)
                function(cell, cell.run_folder(runs))
                cell.result(runs).parent.mkdir(parents=True, exist_ok=True)
                made_up([cell], cell.result(runs).parent)
            return True

        monkeypatch.setattr(objects, "run_cell", run)
        return trained

    return make


def failing(monkeypatch: pytest.MonkeyPatch, method: str, times: int, path: str = "") -> None:
    """The store is out of reach for so many calls of this method, of objects with this in their paths."""
    whole, left = getattr(Bucket, method), [times]

    def call(self: Bucket, *args: Any, **kwargs: Any) -> Any:
        if any(path in str(arg) for arg in args) and left[0] > 0:
            left[0] -= 1
            raise RuntimeError("out of reach")
        return whole(self, *args, **kwargs)

    monkeypatch.setattr(Bucket, method, call)


class AtOnce(Bucket):
    """Several see the same listing before any of them makes an object."""

    cachable = False

    def __init__(self, n: int) -> None:
        super().__init__()
        self.barrier, self.looks = threading.Barrier(n), itertools.count(1)

    def find(self, *args: Any, **kwargs: Any) -> Any:
        found = super().find(*args, **kwargs)
        if next(self.looks) <= self.barrier.parties:
            self.barrier.wait(10)
        return found


class KnowsNoCreate(AtOnce):
    """Overwrites, as some do."""

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **_: Any) -> None:
        super().pipe_file(path, value)
        # All of them before any one looks
        if mode == "create":
            self.barrier.wait(10)


@pytest.mark.parametrize("kind", [AtOnce, KnowsNoCreate])
def test_of_several_that_claim_the_same_at_once_one_gets_it(kind: type[AtOnce], tmp_path: Path) -> None:
    claims = [Claim(kind(8), str(tmp_path))]
    claims += [Claim(claims[0].files, str(tmp_path)) for _ in range(7)]
    with ThreadPoolExecutor(8) as pool:
        taken = list(pool.map(Claim.take, claims))
    assert sum(taken) == 1 and [claim.is_ours() for claim in claims] == taken


def test_who_is_silent_loses_a_claim_and_who_is_done_leaves_it(tmp_path: Path, clock: list[float]) -> None:
    files, folder, watch = Bucket(), str(tmp_path / "claims"), Watch()
    silent, other, third = (Claim(files, folder) for _ in range(3))

    def newest() -> tuple[str, dict[str, Any]]:
        return max(files.find(folder, detail=True).items())

    def content() -> bytes:
        return files.cat_file(newest()[0])

    assert silent.take() and watch.is_alive(*newest()) and not other.take()
    for _ in range(4):
        clock[0] += 0.9 * VOID
        silent.renew()
        assert watch.is_alive(*newest()), "as long as it is renewed"
    clock[0] += 1.1 * VOID
    assert not watch.is_alive(*newest())
    void = content()
    silent.renew()
    assert not other.take(void), "it lives after all"
    assert other.take(content()) and not third.take(void), "what is void is taken over once"
    assert other.is_ours() and not silent.is_ours() and watch.is_alive(*newest())
    # Comes back
    silent.renew()
    silent.release()
    assert other.is_ours()
    other.release()
    assert not watch.is_alive(*newest()) and not other.is_ours()
    assert third.take() and not other.is_ours() and watch.is_alive(*newest())


class Failing(Bucket):
    """Goes away after so many files; as each comes, something happens."""

    cachable = False
    left = 0
    meanwhile: Callable[[], None]

    def put_file(self, lpath: str, rpath: str, **_: Any) -> None:
        self.meanwhile()
        self.left -= 1
        if self.left < 0:
            # As some say of what is there no more
            raise FileNotFoundError("gone")
        super().put_file(lpath, rpath)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 8), st.integers(0, 2)), max_size=8))
def test_a_store_has_at_any_time_what_a_killed_run_leaves(rollouts: list[tuple[int, int, int]]) -> None:
    """However far a node came with sending, and training meanwhile: a checkpoint that is whole, and logs as new as it."""
    files, now, sent = Failing(), 0, 0
    with TemporaryDirectory() as folder:
        here, there = Path(folder, "here"), str(Path(folder, "there"))
        copy = WorkingCopy(files, there, here, lambda: True)

        def train(n_checkpoints: int) -> None:
            nonlocal now
            for _ in range(n_checkpoints):
                now += 1
                write(here / "progress.csv", "row\n" * now)
                for name in ("state.pt", "manifest.json"):
                    write(here / "checkpoints" / f"{now}_steps" / name, str(now))
                for old in sorted((here / "checkpoints").glob("*_steps"), key=n_steps_at)[:-2]:
                    shutil.rmtree(old)
            # One more is begun
            write(here / "checkpoints" / ".99_steps.tmp" / "state.pt", "")

        for number, (n_before, files.left, n_meanwhile) in enumerate(rollouts):
            train(n_before)
            write(here / "progress.csv", "row\n" * now)
            before = now
            files.meanwhile = partial(train, n_meanwhile)
            with suppress(FileNotFoundError):
                copy.send()
                sent = before
                assert len(list(Path(there).glob("checkpoints/*/*"))) == (2 if before else 0), "older ones are removed"
            fetched = Path(folder, str(number))
            WorkingCopy(files, there, fetched, lambda: True).fetch()
            latest = max(map(n_steps_at, fetched.glob("checkpoints/*")), default=0)
            assert latest >= sent and not list(fetched.rglob(".*"))
            assert all(len(list(path.iterdir())) == 2 for path in fetched.glob("checkpoints/*")), "each can be gone on from"
            assert not latest or len((fetched / "progress.csv").read_text().split()) >= latest


def test_a_disk_without_links_sends_checkpoints_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(*_: Any) -> None:
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr("os.link", link)
    file = "checkpoints/1_steps/manifest.json"
    write(tmp_path / "here" / file, "1")
    WorkingCopy(Bucket(), str(tmp_path / "there"), tmp_path / "here", lambda: True).send()
    assert (tmp_path / "there" / file).read_text() == "1"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_several_drivers_share_the_cells_and_none_runs_twice(
    url: str, trains: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(cell: Cell, folder: Path) -> None:
        for name in ("state.pt", "manifest.json"):
            write(folder / "htr-ser/run_1/checkpoints/500_steps" / name, "half")
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
    store = ObjectStore(url)
    here = store.fetch_results(CELLS)
    assert all(cell.result(here).exists() and not store.is_claimed(cell) for cell in CELLS)
    Driver(CELLS, url, SerialExecutor()).run()
    assert len(trained) == 7, "what is done is skipped"


def test_a_node_at_work_is_not_taken_for_dead(url: str, trains: Any, clock: list[float]) -> None:
    store, cell = ObjectStore(url), CELLS[0]

    def work(cell: Cell, folder: Path) -> None:
        (path,) = store.files.find(f"{store.root}/{cell.experiment}/{cell.name}/.claims")
        for _ in range(4):
            before, deadline = store.files.cat_file(path), time.monotonic() + 60
            while store.files.cat_file(path) == before:
                assert time.monotonic() < deadline, "no sign of life"
                time.sleep(0.01)
            clock[0] += 0.9 * VOID
            store.look([cell])
            assert store.is_claimed(cell)

    trained = trains(work)
    assert objects.run_on_copy(cell, url)
    store.look([cell])
    assert store.is_finished(cell) and not store.is_claimed(cell) and len(trained) == 1


def test_silence_counts_while_the_store_is_within_reach(url: str, clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its owner may be out of reach, too, and alive."""
    store, cell = ObjectStore(url), CELLS[0]
    assert Claim(store.files, f"{store.root}/{cell.run_folder(Path()).as_posix()}/.claims").take()
    store.look([cell])
    assert store.is_claimed(cell)
    with monkeypatch.context() as patch:
        failing(patch, "find", 99)
        clock[0] += 1.1 * VOID
        store.look([cell])
    store.look([cell])
    assert store.is_claimed(cell)
    clock[0] += 1.1 * VOID
    store.look([cell])
    assert not store.is_claimed(cell)


@pytest.mark.parametrize(("method", "path"), [("pipe_file", ".claims"), ("find", "seed1"), ("exists", "seed1.npz")])
def test_a_store_that_is_out_of_reach_at_first_is_waited_for(
    method: str, path: str, url: str, trains: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = trains(lambda cell, folder: None)
    failing(monkeypatch, method, 2, path)
    assert objects.run_on_copy(CELLS[0], url) and len(trained) == 1


def test_one_that_was_taken_for_dead_sends_nothing(url: str, trains: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cell goes on from what it had sent before."""
    monkeypatch.setattr(objects, "RENEW", 1e6)  # or it would notice at its next sign of life
    (cell, *_), store = CELLS, ObjectStore(url)

    def work(cell: Cell, folder: Path) -> None:
        store.look([cell])
        assert store.is_claimed(cell)
        (path,) = store.files.find(f"{store.root}/{cell.experiment}/{cell.name}/.claims")
        while not Claim(store.files, path.rpartition("/")[0]).take(void=store.files.cat_file(path)):
            pass
        write(folder / "late.txt", "")

    trained = trains(work)
    assert not objects.run_on_copy(cell, url) and not objects.run_on_copy(cell, url) and trained == [cell.name]
    assert not list(Path(store.root).rglob("late.txt"))
    store.look([cell])
    assert not store.is_finished(cell) and store.is_claimed(cell)


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM])
def heard(request: pytest.FixtureRequest) -> Iterator[None]:
    """One signal that interrupts this process, and one that it ignores, as a script's background commands do SIGINT."""
    before = {kind: signal.signal(kind, signal.SIG_IGN) for kind in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(request.param, signal.default_int_handler)
    yield
    for kind, handler in before.items():
        signal.signal(kind, handler)


def test_one_that_lost_its_cell_stops_at_once(heard: None, url: str, trains: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "RENEW", 0.05)
    (cell, *_), store = CELLS, ObjectStore(url)

    def work(cell: Cell, folder: Path) -> None:
        (path,) = store.files.find(f"{store.root}/{cell.experiment}/{cell.name}/.claims")
        while not Claim(store.files, path.rpartition("/")[0]).take(void=store.files.cat_file(path)):
            pass
        for _ in range(300):
            time.sleep(0.1)

    trains(work)
    start = time.monotonic()
    assert not objects.run_on_copy(cell, url) and time.monotonic() - start < 25


def test_what_killed_processes_left_is_removed_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with node_folder() as at_work, node_folder() as other:
        code = "import os; from sb3_htr.experiments.storage.node_folder import node_folder\n"
        killed = [sys.executable, "-c", f"{code}with node_folder() as folder: print(folder, flush=True); os._exit(9)"]
        environment = {**os.environ, "TMPDIR": str(tmp_path)}
        left = Path(subprocess.run(killed, env=environment, capture_output=True, text=True).stdout.strip())
        (place,) = tmp_path.iterdir()
        assert left.is_dir() and left.parent == place and place.stat().st_mode & 0o777 == 0o700
        with node_folder() as next_one:
            assert {*place.glob("copy-*")} == {at_work, other, next_one}
    assert not [*place.glob("copy-*")]


def test_what_another_user_puts_in_its_place_is_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, node_folder() as folder:
        name = folder.parent.name
        patch.setattr("tempfile.tempdir", str(tmp_path))
        (tmp_path / "precious").mkdir()
        (tmp_path / name).symlink_to(tmp_path / "precious")
        with pytest.raises(OSError, match=f"{name} is not this user's: set TMPDIR"), node_folder():
            pass
    assert not [*(tmp_path / "precious").iterdir()]


def test_a_store_writes_nowhere_but_in_the_folder_of_its_cell(tmp_path: Path, url: str) -> None:
    store, here = ObjectStore(url), tmp_path / "here"
    outside = tmp_path / "outside"
    names = ("log.txt", f"/{outside}", "a//b", "../outside", "a/../../outside", "..\\outside")

    class Files:
        def find(self, there: str) -> list[str]:
            return [f"{there}/{name}" for name in names]

        def get_file(self, there: str, here: str) -> None:
            Path(here).write_text("of a stranger")

    WorkingCopy(cast(Any, Files()), f"{store.root}/one/a", here, lambda: True).fetch()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [here / "log.txt"]


def test_a_store_is_named_without_its_password(tmp_path: Path) -> None:
    assert str(ObjectStore("memory://me:TOPSECRET@bucket/runs")) == "memory://me:***@bucket/runs"
    with pytest.raises(ValueError, match=r"nothing://me:\*\*\*@bucket/runs cannot be opened"):
        ObjectStore("nothing://me:TOPSECRET@bucket/runs")


def test_a_cell_that_another_user_alone_may_lock_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell, *_), storage = CELLS, SharedFolder(tmp_path)
    cell.run_folder(tmp_path).mkdir(parents=True)
    assert not storage.is_claimed(cell)

    def refuse(*_: Any) -> Any:
        raise PermissionError(13, "Permission denied", ".claim")

    monkeypatch.setattr("sb3_htr.experiments.storage.folder.lock_of", refuse)
    with pytest.raises(PermissionError, match=r"denied: '\.claim': the lock of this cell is another user's alone\. Share"):
        storage.is_claimed(cell)


def test_a_killed_node_costs_what_it_had_not_sent(tmp_path: Path, url: str) -> None:
    """The result is that of a run that nobody disturbed."""
    (cell,) = Experiment("one", "", ENV_ID, 4_800, (TINY_RUN,), 1, 1200, by(("prior",)), n_episodes=2).cells()
    pickled = tmp_path / "cell"
    pickled.write_bytes(pickle.dumps(cell))
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    node = subprocess.Popen([sys.executable, "-c", NODE, url, str(pickled)], env={**os.environ, "PYTHONPATH": paths})
    store = ObjectStore(url)
    while not 0 < store.n_steps(cell) < 4_000:
        assert node.poll() is None
        store.look([cell])
    node.send_signal(signal.SIGKILL)
    node.wait()
    store.look([cell])
    assert store.is_claimed(cell) and not objects.run_on_copy(cell, url), "it may be at work"
    Driver([cell], url, SerialExecutor()).run()
    (run,) = (tmp_path / "store" / "one").glob("*/htr-ser/*")
    assert "Going on from" in (run.parents[1] / "log.txt").read_text() and not list(run.rglob("evaluated"))
    (tmp_path / "undisturbed").mkdir()
    assert run_cell(cell, tmp_path / "undisturbed")
    folders = tmp_path / "store", tmp_path / "undisturbed"
    ours, theirs = (np.load(cell.result(folder)) for folder in folders)
    assert (ours["returns_prior"] == theirs["returns_prior"]).all() and (ours["curve"] == theirs["curve"]).all()
    models = [find_finished(cell, cell.run_folder(folder)) for folder in folders]
    weights = [model[1].policy.state_dict() for model in models if model is not None]
    assert len(weights) == 2 and all(th.equal(weights[0][name], weights[1][name]) for name in weights[1])


@pytest.mark.parametrize(
    ("method", "times", "path", "n_trained"),
    [
        ("find", 3, "store/toy", 1),
        ("put_file", 2, "seed1.npz", 1),
        ("pipe_file", 4, ".claims", 1),
        ("put_file", 3, "seed1.npz", 2),
    ],
    ids=["look", "result", "claims", "result, for longer"],
)
def test_a_store_that_is_out_of_reach_for_a_while_costs_little(
    method: str, times: int, path: str, n_trained: int, url: str, trains: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(cell: Cell, folder: Path) -> None:
        if len(trained) == 1:
            failing(monkeypatch, method, times, path)
        time.sleep(0.1)

    trained = trains(work)
    with monkeypatch.context() as patch:
        patch.setattr(objects, "FEW", 0)
        Driver(CELLS[:1], url, ThreadPoolExecutor(1)).run()
    assert len(trained) == n_trained
    store = ObjectStore(url)
    assert CELLS[0].result(store.fetch_results(CELLS[:1])).exists()


def test_evaluations_are_kept_until_the_result_is_there(url: str, trains: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which may have taken longer than the training."""

    def work(cell: Cell, folder: Path) -> None:
        kept = folder / "htr-ser/run_1/evaluated/belief.npz"
        assert kept.exists() == (len(trained) > 1)
        write(kept, str(len(trained)))
        while not list(Path(url.removeprefix(f"{PROTOCOL}://")).rglob(kept.name)):
            time.sleep(0.02)
        shutil.rmtree(kept.parent)

    monkeypatch.setattr(objects, "SEND", 0.05)
    trained = trains(work)
    failing(monkeypatch, "put_file", 3, f"{CELLS[0].name}.npz")
    Driver(CELLS[:1], url, SerialExecutor()).run()
    assert len(trained) == 2


def test_the_command_runs_in_a_store_and_reports_from_it(
    url: str, trains: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = trains(lambda cell, folder: None)
    pair = Experiment("pair", "", ENV_ID, 480, (Variant("htr-ser"),), 2, eval_freq=240, evaluations=by(("prior",)))
    monkeypatch.setitem(grid.EXPERIMENTS, "pair", pair)
    monkeypatch.setattr("sb3_htr.experiments.executors.Processes", lambda _: SerialExecutor())
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(ValueError, match=f"No run of pair is finished in {url}"):
        main(["experiment", "pair", "--finished", "--runs", url])
    assert main(["experiment", "pair", "--cell", "1", "--runs", url]) == 0
    assert main(["experiment", "pair", "--runs", url]) == 0
    assert trained == ["htr-ser-seed2", "htr-ser-seed1"] and Path("results/pair/summary.json").exists()
    assert main(["experiment", "pair", "--runs", f"{url}/elsewhere", "--with-results", "results/pair", "-o", "again"]) == 0
    assert main(["experiment", "pair", "--runs", f"{url}/elsewhere", "--finished", "-o", "once more"]) == 0
    assert len(trained) == 2 and "2 of 2 runs of pair are finished." in capsys.readouterr().out
    assert {path.name for path in Path().iterdir()} == {"results", "again", "once more"}, "no runs are here"
    assert main(["experiment", "pair", "--quick", "--runs", f"{url}/"]) == 0
    assert (tmp_path / "store" / "quick" / "pair").is_dir()


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ("nope://bucket/runs", r"nope://bucket/runs cannot be opened \(Protocol not known: nope\): give a folder, or a URL"),
        ("ftp://nowhere.invalid/runs", r"ftp://nowhere.invalid/runs cannot be opened \(.*\): give a folder, or a URL"),
        ("memory://", "memory:// names no place in a store: give one, as in s3://bucket/runs"),
        ("s3:/bucket/runs", "The folder of the runs is 's3:/bucket/runs': give a URL as text, with two slashes"),
        (Path("s3://bucket/runs"), "The folder of the runs is 's3:/bucket/runs': give a URL as text, with two slashes"),
    ],
)
def test_what_is_neither_folder_nor_store_is_refused(runs: str | Path, message: str) -> None:
    """A local folder of that name would be on one node alone."""
    with pytest.raises(ValueError, match=message):
        storage_at(runs)
    assert str(storage_at("runs:1")) == str(Path("runs:1").resolve()), "a folder's name may have a colon"


def test_a_store_that_cannot_be_used_is_said_before_anything_is_run(
    url: str, trains: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = trains(lambda cell, folder: None)
    failing(monkeypatch, "pipe_file", 99)
    with pytest.raises(OSError, match=rf"{url} cannot be written to: out of reach"):
        main(["experiment", "point_robot", "--runs", url])
    failing(monkeypatch, "find", 99)
    with pytest.raises(OSError, match=rf"{url} cannot be read: out of reach"):
        main(["experiment", "point_robot", "--runs", url, "--finished"])
    assert not trained
