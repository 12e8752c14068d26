"""What the benchmarks share: timing two things side by side, models of the paper's sizes, and the files that they write."""

import json
import os
import platform
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.common.versions import commit, hardware, named
from sb3_htr.htr import MultiTaskReplayBuffer

ENV_ID = "SparsePointRobot-v0"
RESULTS = Path(__file__).parent / "results"
# What figures depend on, as git names it: not the figures themselves
CODE = (":/sb3_htr", ":/htr_envs", ":(top,glob)benchmarks/*.py")
# HTR paper, A.2, and PEARL's reference implementation
PAPER_SIZES: dict[str, Any] = {
    "meta_batch_size": 16,
    "batch_size": 256,
    "context_size": 1024,
    "policy_kwargs": {
        "net_arch": [300] * 3,
        "encoder_arch": [200] * 3,
        "latent_dim": 5,
        "normalize_observations": False,
    },
}
# Times that each of several things is timed, by turns, where nothing else is said
ROUNDS = 9


@dataclass
class Figure:
    """
    One line of a benchmark.

    :param name: what is measured
    :param unit: of ours and of the reference
    :param ours: median over the rounds
    :param reference: the same of the alternative, None where there is none
    :param ratio: how many times better ours is, the median of the rounds' ratios
    :param goal: smallest ratio that was asked for, None where none was
    :param against: the alternative
    """

    name: str
    unit: str
    ours: float
    reference: float | None = None
    ratio: float | None = None
    goal: float | None = None
    against: str = ""


def seconds(function: Callable[[], Any], n: int) -> float:
    """
    :param function: what is timed
    :param n: number of calls
    :return: mean duration of a call
    """
    start = time.perf_counter()
    for _ in range(n):
        function()
    return (time.perf_counter() - start) / n


def by_turns(durations: dict[str, Callable[[], float]], n_rounds: int = ROUNDS) -> dict[str, np.ndarray]:
    """
    Time several things by turns, so that what else the machine does meets all of them.

    :param durations: each measures itself once
    :param n_rounds: times that each is timed, after one that warms up
    :return: (n_rounds,) durations of each
    """
    for duration in durations.values():
        duration()
    times = [[duration() for duration in durations.values()] for _ in range(n_rounds)]
    return dict(zip(durations, np.array(times).T, strict=True))


def faster(ours: np.ndarray, reference: np.ndarray) -> float:
    """
    :param ours: (n,) durations
    :param reference: (n,) durations
    :return: median ratio
    """
    return statistics.median(reference / ours)


def make_model(n_episodes_per_task: int = 60, relabel_probability: float = 0.8, **kwargs: Any) -> PEARL:
    """
    :param n_episodes_per_task: random episodes in the replay buffer, for each of 16 tasks
    :param relabel_probability: K
    :param kwargs: for PEARL
    :return: a model that has collected, but not learnt yet
    """
    env = make_task_vec_env(ENV_ID, 16, seed=0)
    # A context of 1024 steps needs 52 episodes
    buffer = {"relabel_probability": relabel_probability, "context_episodes": 60}
    sizes = {"n_tasks_per_rollout": 16, "n_episodes_per_task": n_episodes_per_task, "learning_starts": 10**9}
    model = PEARL("MlpPolicy", env, replay_buffer_kwargs=buffer, seed=0, **{"device": "cpu", **sizes, **kwargs})
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Nothing was learnt")
        return model.learn(16 * 20 * n_episodes_per_task, log_interval=None)


def look_at_all(buffer: MultiTaskReplayBuffer) -> None:
    """
    :param buffer: relabels each of its steps from now on as one that was drawn before
    """
    cache, rows = buffer.relabeller._demerits, buffer.episodes.index().rows  # type: ignore[attr-defined]
    for part in np.array_split(rows, len(rows) // 1000):
        cache.look_up(buffer.episodes, part)


def write(name: str, figures: list[Figure], **more: Any) -> None:
    """
    :param name: of the benchmark
    :param figures: go to ``benchmarks/results/<name>.json``, and to the standard output
    :param more: goes there, too
    """
    write_content(name, {"rows": [asdict(figure) for figure in figures], **more})


def write_content(name: str, content: dict[str, Any]) -> None:
    """
    :param name: of the benchmark
    :param content: goes there with what it was measured with
    """
    origin = {
        "name": name,
        "command": " ".join(["python", f"benchmarks/{name}.py", *sys.argv[1:]]),
        "date": date.today().isoformat(),
        "commit": named(commit(*CODE)),
        "machine": machine(),
    }
    RESULTS.mkdir(exist_ok=True)
    with atomic_path(RESULTS / f"{name}.json") as path:
        path.write_text(json.dumps({**origin, **content}, indent=1) + "\n")
    print(json.dumps(content, indent=1))


def machine() -> str:
    """
    :return: processor, threads and versions, and the GPU where one was used
    """
    used = "cuda" if th.cuda.is_initialized() else "cpu"
    about = f"{hardware(used)}, {os.cpu_count()} cores, Python {platform.python_version()}, torch {th.__version__}"
    return f"{about}, {th.get_num_threads()} thread(s)"
