"""A long training needs no more memory than a short one, and leaves nothing open."""

import ctypes
import gc
import os
from multiprocessing import get_context
from pathlib import Path

import torch as th

import htr_envs  # noqa: F401 registers the envs, in a process of its own too
from helpers import ENV_ID, TINY, MakePEARL
from helpers.runs import train_arguments
from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering
from sb3_htr.zoo.cli import main

# 100,000 in the nightly run
N_UPDATES = int(os.environ.get("SB3_HTR_UPDATES", 1_200))
# Bytes for each: what is measured varies by 0.2 MB
ALLOWED = 2_000


def resident_bytes() -> int:
    """Of what is in use: the C library gives the rest back first."""
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def train_with_full_buffers(n_updates: int) -> tuple[int, int]:
    """Resident bytes before and after, in a process of its own."""
    th.set_num_threads(1)
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"n_train_tasks": 2, "n_test_tasks": 1, "n_validation_tasks": 1})
    small = {"buffer_size": 400, "n_tasks_per_rollout": 2, "n_episodes_per_task": 1, "gradient_steps": 50, "batch_size": 2}
    model = PEARL("MlpPolicy", env, **{**TINY, **small})
    model.learn(40 * 20)  # the buffers are full, allocators have what they need
    before = resident_bytes()
    model.learn(40 * n_updates // 50, reset_num_timesteps=False)
    assert model._n_updates >= n_updates
    return before, resident_bytes()


def test_memory_is_flat_once_the_buffers_are_full() -> None:
    """Libraries keep what they prepare for each size of arrays, which in this process other tests may have brought about."""
    with get_context("spawn").Pool(1) as pool:
        before, after = pool.apply(train_with_full_buffers, [N_UPDATES])
    allowed = min(0.02 * before, ALLOWED * N_UPDATES)
    assert after < before + allowed, f"{before / 1e6:.1f} to {after / 1e6:.1f} MB"


def test_the_number_of_hindsight_buffers_is_all_that_grows_in_ec(tiny_pearl: MakePEARL) -> None:
    """Their number is bounded by the grid, and each has the capacity of a real one."""
    relabeller = EpisodeClustering(cell_size=1.5)
    model = tiny_pearl(buffer_size=1600, replay_buffer_kwargs={"relabeller": relabeller}).learn(80 * 40)
    assert model.replay_buffer is not None
    clustering = model.replay_buffer.relabeller
    assert isinstance(clustering, EpisodeClustering) and 1 < clustering.n_hindsight_buffers <= 9
    assert model.replay_buffer.episodes.nbytes <= 2 * 80 * 20 * 9 * 4
    assert clustering.episodes.nbytes <= 2 * max(9, 16) * 20 * 9 * 4


def test_no_file_stays_open(tmp_path: Path) -> None:
    def train(folder: str) -> int:
        assert main(train_arguments(tmp_path / folder, 480, "--save-freq", "240", eval_freq=240)) == 0
        gc.collect()
        return len(list(Path("/proc/self/fd").iterdir()))

    assert train("first") == train("second")
