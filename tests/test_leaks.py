"""A long training needs no more memory than a short one, and leaves nothing open."""

import gc
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from conftest import ENV_ID, TINY

from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering
from sb3_htr.zoo.cli import main

MakePEARL = Callable[..., PEARL]
# 100,000 in the nightly run
N_UPDATES = int(os.environ.get("SB3_HTR_UPDATES", 3_000))


def resident_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_memory_is_flat_once_the_buffers_are_full(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 2, env_kwargs={"n_train_tasks": 2, "n_test_tasks": 1, "n_validation_tasks": 1})
    model = tiny_pearl(env, buffer_size=400, n_tasks_per_rollout=2, n_episodes_per_task=1, gradient_steps=50, batch_size=2)
    model.learn(40 * 20)  # the buffers are full, allocators have what they need
    before = resident_bytes()
    model.learn(40 * N_UPDATES // 50, reset_num_timesteps=False)
    assert model._n_updates >= N_UPDATES
    assert resident_bytes() < 1.02 * before


def test_the_number_of_hindsight_buffers_is_all_that_grows_in_ec(tiny_pearl: MakePEARL) -> None:
    """Their number is bounded by the discretiser, and each has the capacity of a real one."""
    buffer_kwargs = {"discretiser": lambda tasks: np.sign(tasks).astype(np.float32) * np.float32(0.1)}
    model = tiny_pearl(buffer_size=1600, replay_buffer_class=EpisodeClustering, replay_buffer_kwargs=buffer_kwargs)
    model.learn(80 * 40)
    assert isinstance(model.replay_buffer, EpisodeClustering)
    assert model.replay_buffer.n_hindsight_buffers <= 9
    assert model.replay_buffer.episodes.nbytes <= 2 * (80 + 9) * 20 * 9 * 4


def test_no_file_stays_open(tmp_path: Path) -> None:
    settings = [f"{key}:{value!r}" for key, value in TINY.items() if key != "seed"]
    arguments = ["train", "--env", ENV_ID, "-n", "480", "--eval-freq", "240", "--verbose", "0", "--save-freq", "240"]

    def train(folder: str) -> int:
        assert main([*arguments, "-f", str(tmp_path / folder), "-params", "n_envs:4", *settings]) == 0
        gc.collect()
        return len(list(Path("/proc/self/fd").iterdir()))

    assert train("first") == train("second")
