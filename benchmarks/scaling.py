"""Cost as work grows: training tasks, replay, horizon, observation, envs, tasks to adapt to."""

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch as th
from _common import Figure, by_turns, look_at_all, write
from gymnasium import spaces

from htr_envs.dynamics import Dynamics, DynamicsVectorEnv
from htr_envs.point_robot import PointRobotFamily
from sb3_htr import PEARL
from sb3_htr.adaptation.evaluation import evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.pearl import N_LABELLED
from sb3_htr.zoo.plots.curves import finish, marked_line
from sb3_htr.zoo.plots.style import COLOURS

ENV_ID = "Scaling-v0"
PICTURE = Path(__file__).parents[1] / "docs" / "cost.svg"
# How many of each a millisecond is
PER_MS = {"ms": 1.0, "microseconds": 1000.0}
# Seconds that a point takes in each round, at least
PATIENCE = 0.05


class WalkDynamics(Dynamics[PointRobotFamily]):
    """Points that walk on a plane, and observe more than where they are: numbers that tell nothing."""

    def __init__(self, num_envs: int, obs_dim: int) -> None:
        super().__init__(num_envs, spaces.Box(-10.0, 10.0, (obs_dim,), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32))
        self.states = np.zeros((num_envs, obs_dim), dtype=np.float32)

    def reset(self, indices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        self.states[indices] = 0.0
        return self.states[indices]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.states[:, :2] = np.clip(self.states[:, :2] + 0.1 * np.clip(actions, -1.0, 1.0), -10.0, 10.0)
        return self.states, np.zeros(self.num_envs, dtype=np.float32), np.zeros(self.num_envs, dtype=np.bool_)


def make_envs(
    num_envs: int = 1, max_episode_steps: int | None = None, obs_dim: int = 2, horizon: int = 20, n_train_tasks: int = 80
) -> DynamicsVectorEnv:
    """
    :param num_envs: how many
    :param max_episode_steps: given by gymnasium, not used
    :param obs_dim: length of an observation
    :param horizon: time limit
    :param n_train_tasks: number of training tasks
    :return: envs that step together
    """
    return DynamicsVectorEnv(PointRobotFamily(n_train_tasks=n_train_tasks), WalkDynamics(num_envs, obs_dim), horizon)


def make_model(n_envs: int = 20, buffer_size: int = 1_000_000, **env_kwargs: Any) -> PEARL:
    """
    :param n_envs: that step together, on a training task each
    :param buffer_size: capacity of the replay
    :param env_kwargs: of :func:`make_envs`
    :return: a model that has collected one rollout
    """
    envs = make_task_vec_env(ENV_ID, n_envs, seed=0, env_kwargs=env_kwargs)
    model = PEARL("MlpPolicy", envs, seed=0, device="cpu", n_tasks_per_rollout=n_envs, buffer_size=buffer_size)
    model.learning_starts = 10**9
    return model.learn(1, log_interval=None)


def fill(model: PEARL, n_transitions: int, horizon: int = 20) -> None:
    """
    :param model: gets random walks into its replay, evenly over its tasks
    :param n_transitions: how many
    :param horizon: of each walk
    """
    buffer = model.replay_buffer
    assert buffer is not None
    rng = np.random.default_rng(0)
    columns = buffer.transitions
    walks = np.zeros((64, horizon, columns.width), dtype=np.float32)
    walks[..., columns.action] = rng.uniform(-1, 1, (64, horizon, 2))
    walks[..., columns.next_observation][..., :2] = 0.1 * walks[..., columns.action].cumsum(axis=1)
    walks[:, 1:, columns.observation] = walks[:, :-1, columns.next_observation]
    for i in range(n_transitions // horizon):
        buffer.episodes.add(i % buffer.n_tasks, walks[i % len(walks)])


def milliseconds(function: Callable[[], Any]) -> float:
    """
    :param function: what is timed
    :return: the median duration of a call, of the process: what else the machine does is left out
    """
    durations: list[float] = []
    while sum(durations) < PATIENCE:
        start = time.process_time()
        function()
        durations.append(time.process_time() - start)
    return 1e3 * float(np.median(durations))


# Each prepares a cost, and returns what measures it once
Cost = Callable[[PEARL], Callable[[], float]]


def first_look(model: PEARL) -> Callable[[], float]:
    """Of what relabelling asks of a step once, when it is first drawn, in microseconds."""
    assert model.replay_buffer is not None
    cache = model.replay_buffer.relabeller._demerits  # type: ignore[attr-defined]
    rows = model.replay_buffer.episodes.index().rows[:1000]
    return lambda: 1e3 * milliseconds(partial(cache._ask, rows)) / len(rows)


def draw(model: PEARL) -> Callable[[], float]:
    """Of one meta-batch as a training draws it, from steps that were looked at before."""
    assert model.replay_buffer is not None
    look_at_all(model.replay_buffer)
    sizes = {"meta_batch_size": model.meta_batch_size, "context_size": model.context_size, "n_labelled": N_LABELLED}
    return partial(milliseconds, partial(model.replay_buffer.sample, model.batch_size, **sizes))


def log(model: PEARL) -> Callable[[], float]:
    """Of what is logged of the replay, once after each rollout."""
    assert model.replay_buffer is not None
    return partial(milliseconds, model.replay_buffer.stats)


def index(model: PEARL) -> Callable[[], float]:
    """Of the index of what is stored, once after each rollout."""
    episodes = model.replay_buffer.episodes  # type: ignore[union-attr]

    def rebuild() -> None:
        episodes._index = None
        episodes.index()

    return partial(milliseconds, rebuild)


def update(model: PEARL) -> Callable[[], float]:
    """Of one update."""
    return partial(milliseconds, partial(model._update, model.batch_size))


def collect(model: PEARL) -> Callable[[], float]:
    """Of an env step, in microseconds."""
    assert model.env is not None and model.replay_buffer is not None
    model.learning_starts = 0
    callback = model._init_callback(None)
    n_steps = model.n_envs * model.n_episodes_per_task * model.replay_buffer.max_episode_steps
    rollout = partial(model.collect_rollouts, model.env, callback, model.train_freq, model.replay_buffer)  # type: ignore[arg-type]
    return lambda: 1e3 * milliseconds(rollout) / n_steps


def bank(model: PEARL) -> Callable[[], float]:
    """Of what the task bank does with an episode."""
    assert model.task_bank is not None and model.replay_buffer is not None
    episodes = list(model.replay_buffer.episodes._data[:100])

    def update() -> None:
        model.task_bank.new = [(0, episode) for episode in episodes]  # type: ignore[union-attr]
        model.task_bank.update()  # type: ignore[union-attr]

    return lambda: milliseconds(update) / len(episodes)


def adapt(model: PEARL, n_tasks: int) -> Callable[[], float]:
    """Of an env step of one task, in microseconds, in adaptations of two episodes."""
    envs = make_task_vec_env(ENV_ID, n_tasks, seed=0)
    tasks = PointRobotFamily(n_test_tasks=n_tasks).test_tasks
    adaptation = partial(evaluate_adaptation, model, envs, tasks, n_episodes=2)
    return lambda: 1e3 * milliseconds(adaptation) / (n_tasks * 2 * 20)


def at_each(sizes: list[int], costs: list[Callable[[], float]]) -> list[float]:
    """
    :param sizes: of what grows
    :param costs: a cost at each of them
    :return: its medians, measured by turns
    """
    times = by_turns({str(size): cost for size, cost in zip(sizes, costs, strict=True)})
    return [float(np.median(durations)) for durations in times.values()]


Curves = dict[str, tuple[str, list[float]]]


def measure() -> Iterator[tuple[str, list[int], Curves]]:
    """What grows, its sizes, and what is measured at each: unit and values."""

    def curves(sizes: list[int], make: Callable[[int], PEARL], **costs: tuple[str, Cost]) -> Curves:
        models = [make(size) for size in sizes]
        return {
            name.replace("meta_batch", "meta-batch").replace("_", " "): (unit, at_each(sizes, [cost(m) for m in models]))
            for name, (unit, cost) in costs.items()
        }

    def with_tasks(n: int) -> PEARL:
        model = make_model(n_train_tasks=n)
        fill(model, 400_000)
        return model

    def with_transitions(n: int) -> PEARL:
        model = make_model(buffer_size=n)
        fill(model, n)
        return model

    def with_horizon(n: int) -> PEARL:
        model = make_model(horizon=n)
        fill(model, 200_000, n)
        return model

    def with_observations(n: int) -> PEARL:
        return make_model(obs_dim=n)

    ms, us = "ms", "microseconds"
    sizes = [80, 300, 1_000, 3_000, 10_000]
    yield (
        "training tasks",
        sizes,
        curves(
            sizes,
            with_tasks,
            a_meta_batch=(ms, draw),
            a_first_look_at_a_step=(us, first_look),
            the_index=(ms, index),
            an_episode_for_the_task_bank=(ms, bank),
        ),
    )
    sizes = [100_000, 1_000_000, 10_000_000]
    costs: dict[str, tuple[str, Cost]] = {"a_meta_batch": (ms, draw), "the_index": (ms, index), "what_is_logged": (ms, log)}
    yield "transitions in the replay", sizes, curves(sizes, with_transitions, **costs)
    sizes = [20, 50, 200, 1_000]
    costs = {"a_meta_batch": (ms, draw), "an_update": (ms, update), "an_episode_for_the_task_bank": (ms, bank)}
    yield "steps of an episode", sizes, curves(sizes, with_horizon, **costs)
    sizes = [2, 20, 100, 400]
    costs = {"a_meta_batch": (ms, draw), "an_update": (ms, update), "an_env_step": (us, collect)}
    yield "numbers of an observation", sizes, curves(sizes, with_observations, **costs)
    sizes = [1, 4, 16, 64, 256]
    yield "envs", sizes, curves(sizes, make_model, an_env_step=(us, collect))
    sizes = [1, 10, 100, 1_000]
    model = make_model().learn(4_001, log_interval=None)
    yield "tasks adapted to at once", sizes, {"an env step of a task": (us, at_each(sizes, [adapt(model, n) for n in sizes]))}


def plot(panels: list[tuple[str, list[int], Curves]]) -> None:
    """
    :param panels: what :func:`measure` gives
    """
    figure, all_axes = plt.subplots(2, 3, figsize=(13, 8), layout="constrained", sharey=True)
    colours = dict(zip(dict.fromkeys(what for _, _, curves in panels for what in curves), COLOURS, strict=False))
    for axes, (name, sizes, curves) in zip(all_axes.flat, panels, strict=True):
        for what, (unit, values) in curves.items():
            durations = np.array(values) / PER_MS[unit]
            marked_line(axes, np.array(sizes), durations, colours[what], "-", what)
        axes.set(xscale="log", yscale="log", xlabel=name)
    for axes in all_axes[:, 0]:
        axes.set_ylabel("ms")
    finish(figure, PICTURE, "Duration as work grows, one thread; both axes are logarithmic", legend_columns=1)


def main() -> None:
    """One thread."""
    th.set_num_threads(1)
    gym.register(ENV_ID, entry_point=make_envs, vector_entry_point=make_envs)  # type: ignore[arg-type]
    panels = list(measure())
    figures = []
    for name, sizes, curves in panels:
        for what, (unit, values) in curves.items():
            against = f"{sizes[0]:,} {name}"
            figures.append(
                Figure(f"{what}, {sizes[-1]:,} {name}", unit, values[-1], values[0], values[0] / values[-1], None, against)
            )
    points = [{"grows": name, "sizes": sizes, "costs": curves} for name, sizes, curves in panels]
    write("scaling", figures, points=points)
    plot(panels)


if __name__ == "__main__":
    main()
