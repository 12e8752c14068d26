"""Throughput of a grid of 24 short cells: on a Ray cluster of two nodes of one core, and without it, one or two at a time."""

import os
import tempfile
import time
from concurrent.futures import Executor
from importlib.util import find_spec
from pathlib import Path

import torch as th
from _common import ENV_ID, Figure, write

from sb3_htr.experiments.driver import Driver
from sb3_htr.experiments.executors import Processes, Ray
from sb3_htr.experiments.grid import Experiment, Variant, by

N_CELLS = 24
N_TIMESTEPS = 5_000
CELLS = Experiment("grid", "", ENV_ID, N_TIMESTEPS, (Variant("htr-ser"),), N_CELLS, N_TIMESTEPS, by(("prior",))).cells()


def cells_per_minute(executor: Executor) -> float:
    """
    :param executor: where the cells run
    :return: how many it finishes, training, evaluation and the start of its processes included
    """
    with tempfile.TemporaryDirectory() as runs:
        start = time.perf_counter()
        Driver(CELLS, Path(runs), executor).run()
        return 60 * N_CELLS / (time.perf_counter() - start)


def on_two_nodes() -> float:
    """
    :return: cells per minute of the cluster; its own start is not counted
    """
    # Without it, Ray takes an address of this machine alone for one that other nodes cannot reach
    os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    os.environ["OMP_NUM_THREADS"] = "1"
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        return cells_per_minute(Ray(cluster.address))
    finally:
        cluster.shutdown()


def main() -> None:
    """One thread for each cell."""
    if find_spec("ray") is None:
        return print("Not measured: it needs Ray, pip install '.[ray]'.")
    th.set_num_threads(1)  # as in the cells
    nodes, serial, processes = on_two_nodes(), cells_per_minute(Processes(1)), cells_per_minute(Processes(2))
    name = f"{N_CELLS} cells of {N_TIMESTEPS:,} env steps, two nodes"
    alternatives = {"one after the other": (serial, 1.9), "two processes of this machine, without Ray": (processes, None)}
    write(
        "grid",
        [Figure(name, "cells/min", nodes, other, nodes / other, goal, what) for what, (other, goal) in alternatives.items()],
    )


if __name__ == "__main__":
    main()
