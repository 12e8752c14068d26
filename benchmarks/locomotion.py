"""Env steps per second of the MuJoCo envs: 16 at once in native threads, against one by one in SB3's DummyVecEnv."""

import itertools
import os
from collections.abc import Callable

import numpy as np
from _common import Figure, by_turns, faster, seconds, write
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr.common.vec_env import make_task_vec_env

N_ENVS, N_STEPS = 16, 200


def step_seconds(env: VecEnv) -> Callable[[], float]:
    """
    :param env: 16 envs
    :return: measures the duration of one env step with random actions, resets, observations, rewards and infos included
    """
    shape = (N_STEPS, N_ENVS, *(env.action_space.shape or ()))
    actions = itertools.cycle(np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32))
    env.reset()
    return lambda: seconds(lambda: env.step(next(actions)), N_STEPS) / N_ENVS


def main() -> None:
    """One thread and two; without physics in native threads the same env runs one by one."""
    figures = []
    for env_id, goal in (("SparseAnt-v0", 1.7), ("SparseWheeled-v0", None)):
        envs = {n: make_task_vec_env(env_id, N_ENVS, seed=0, env_kwargs={"n_threads": n}) for n in (1, 2)}
        durations = {str(n): step_seconds(env) for n, env in envs.items() if n <= (os.cpu_count() or 1)}
        times = by_turns({"dummy": step_seconds(make_vec_env(env_id, N_ENVS, seed=0)), **durations})
        single = 1 / float(np.median(times["dummy"]))
        for n in durations:
            ratio = faster(times[n], times["dummy"])
            name = f"{env_id}, 16 envs, {n} thread(s)"
            rate = 1 / float(np.median(times[n]))
            figures.append(Figure(name, "env steps/s", rate, single, ratio, goal if n == "2" else None, "SB3 DummyVecEnv"))
    write("locomotion", figures)


if __name__ == "__main__":
    main()
