"""A grid on Ray: with a stand-in wherever this is run, and on a real cluster where Ray is installed."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th

from helpers.runs import OF_CELL
from sb3_htr.common.divergence import DivergedError
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.driver import Driver
from sb3_htr.experiments.executors import HOPELESS, Ray, SerialExecutor
from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.experiments.runner import find_finished, run_cell
from sb3_htr.zoo.run.record import RECORD

SLOWER = {**OF_CELL, "gradient_steps": 20}


@pytest.mark.parametrize(("device", "n_gpus"), [("cpu", 0), ("cuda", 0.2)])
def test_a_call_is_a_task_of_one_cpu_in_a_process_of_its_own(
    device: str, n_gpus: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is asked of Ray; it tries nothing again, because the driver does."""
    asked: list[Any] = []

    class Task:
        def __init__(self, value: Any) -> None:
            self.value = value

        def future(self) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_result(self.value)
            return future

    def remote(**options: Any) -> Callable[..., Any]:
        asked.append(options)
        return lambda call: SimpleNamespace(remote=lambda *args, **kwargs: Task(call(*args, **kwargs)))

    def init(address: str, **_: Any) -> None:
        asked.append(address)

    resources: dict[str, float] = {"CPU": 2.0}
    ray = SimpleNamespace(init=init, remote=remote, shutdown=lambda: asked.append("shutdown"))
    ray.cluster_resources = lambda: resources
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(ValueError, match="The Ray cluster at auto has no GPU: start a node with one, or leave --device out"):
        Ray("auto", "cuda")
    assert asked == ["auto", "shutdown"]
    asked.clear()
    resources["GPU"] = 1.0
    with Ray("auto", device) as executor:
        assert executor.submit(divmod, 7, 2).result() == (3, 1)
    assert asked == ["auto", {"num_cpus": 1, "num_gpus": n_gpus, "max_calls": 1, "max_retries": 0}, "shutdown"]
    with pytest.raises(ConnectionError, match=r"No Ray cluster answers at 127.0.0.1:1 .*: start one with `ray start --head`"):
        Ray("127.0.0.1:1")


def test_an_error_of_a_call_keeps_its_kind() -> None:
    """By which the driver tells what need not be tried again."""
    exceptions = pytest.importorskip("ray.exceptions")
    of_ray = exceptions.RayTaskError("_call", "traceback", DivergedError("critic_loss is nan"), "title", 1, "127.0.0.1")
    assert isinstance(of_ray.as_instanceof_cause(), HOPELESS)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two raylets on loopback, with one CPU each."""
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    from ray.cluster_utils import Cluster

    # A node that is gone is missed within seconds, in place of half a minute
    sooner = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 1000}
    head = {"num_cpus": 1, "include_dashboard": False, "_system_config": sooner}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    yield cluster
    cluster.shutdown()


def workers() -> list[int]:
    """Processes that run a cell."""
    names = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()}
    return [pid for pid, name in names.items() if name.startswith(b"ray::_call")]


def test_a_worker_and_a_node_that_are_killed_cost_no_cell(cluster: Any, tmp_path: Path) -> None:
    """Each cell has one result, and the weights of a run that nobody disturbed, of those that may have been hit."""
    evaluations = by(("prior",))
    variant = Variant("htr-ser", "tiny", SLOWER, {"n_test_tasks": 4})
    cells = Experiment("grid", "", "SparsePointRobot-v0", 3600, (variant,), 4, 1800, evaluations, n_episodes=2).cells()
    node = cluster.add_node(num_cpus=1)
    runs, undisturbed = tmp_path / "runs", tmp_path / "undisturbed"
    done: list[str] = []
    disturbed: set[str] = set()

    def begun() -> list[Cell]:
        return [cell for cell in cells if any(cell.run_folder(runs).rglob(RECORD)) and not cell.result(runs).exists()]

    def kill() -> None:
        while len(begun()) < 2:
            time.sleep(0.1)
        disturbed.update(cell.label for cell in begun())
        os.kill(workers()[0], signal.SIGKILL)
        done.append("worker")
        while len(begun()) < 2 or len(workers()) < 2:
            time.sleep(0.1)
        disturbed.update(cell.label for cell in begun())
        cluster.remove_node(node, allow_graceful=False)
        done.append("node")

    killer = threading.Thread(target=kill, daemon=True)
    executor = Ray(cluster.address)
    killer.start()
    Driver(cells, runs, executor).run()
    assert done == ["worker", "node"]
    undisturbed.mkdir()
    for cell in cells:
        assert len(list(cell.run_folder(runs).rglob("SparsePointRobot-v0.zip"))) == 1, "it was finished once"
        assert cell.result(runs).exists()
    for cell in (cell for cell in cells if cell.label in disturbed):
        assert SerialExecutor().submit(run_cell, cell, undisturbed).result()
        ours, serial = (find_finished(cell, cell.run_folder(folder)) for folder in (runs, undisturbed))
        assert ours is not None and serial is not None
        weights = ours[1].policy.state_dict(), serial[1].policy.state_dict()
        assert all(th.equal(weights[0][name], weights[1][name]) for name in weights[1])
