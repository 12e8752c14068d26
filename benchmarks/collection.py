"""Env steps per second while collecting: 16 tasks at once, actions, replay and posterior updates included."""

from collections.abc import Callable
from typing import Any

import torch as th
from _common import ENV_ID, PAPER_SIZES, Figure, by_turns, faster, make_model, seconds, write
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env

# katerakelly/oyster, recorded: 100 steps with z from the prior, then 900 with the posterior, one env
REFERENCE_RATE = 4832
N_EPISODES = 50


def step_seconds(model: PEARL, env: VecEnv) -> Callable[[], float]:
    """
    :param model: collects
    :param env: 16 envs
    :return: measures the duration of one env step
    """
    model.set_env(env)
    model.learning_starts = 0
    callback = model._init_callback(None)

    def collect() -> None:
        model.collect_rollouts(env, callback, model.train_freq, model.replay_buffer)  # type: ignore[arg-type]

    return lambda: seconds(collect, 1) / (16 * 20 * N_EPISODES)


def main() -> None:
    """One thread."""
    th.set_num_threads(1)
    # As the reference: five episodes with z from the prior, then the posterior over all episodes so far
    kwargs: dict[str, Any] = {"n_episodes_per_task": N_EPISODES, "train_explorer": "prior"}
    batched = step_seconds(make_model(**kwargs, **PAPER_SIZES), make_task_vec_env(ENV_ID, 16))
    single = step_seconds(make_model(**kwargs, **PAPER_SIZES), make_vec_env(ENV_ID, 16))
    fast = step_seconds(make_model(**kwargs), make_task_vec_env(ENV_ID, 16))
    times = by_turns({"batched": batched, "single": single, "fast": fast})
    rates = {name: float(1 / th.tensor(duration).median()) for name, duration in times.items()}
    recorded = "katerakelly/oyster, recorded"
    names = {"batched": "networks of the paper's sizes", "fast": "fast profile"}
    figures = []
    for key, name in names.items():
        ratio = rates[key] / REFERENCE_RATE
        figures.append(Figure(name, "env steps/s", rates[key], REFERENCE_RATE, ratio, 12.0, recorded))
    ratio = faster(times["batched"], times["single"])
    figures.append(Figure(names["batched"], "env steps/s", rates["batched"], rates["single"], ratio, None, "SB3 DummyVecEnv"))
    write("collection", figures)


if __name__ == "__main__":
    main()
