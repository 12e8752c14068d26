"""Pictures of the adaptations of one agent."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from htr_envs import Trajectory
from sb3_htr.adaptation.evaluation import AdaptationRecord, first_success
from sb3_htr.zoo.plots.style import BLUE, GREEN, GREY, ORANGE, save, span_unit_if_flat

# Tasks in a picture of paths, evenly taken from all of them
N_PATHS = 6


def start_position(env: gym.Env) -> np.ndarray | None:
    """
    :param env: env of a task family whose tasks are places
    :return: where its episodes begin (2,); None if they begin in several places
    """
    family, action = env.get_wrapper_attr("task_family"), env.action_space.sample()[None]
    observations = [env.reset(seed=seed)[0][None] for seed in range(2)]
    free = np.zeros(1, dtype=np.float32)
    first, second = (family.hindsight_task(Trajectory(obs, action, obs, free), 0) for obs in observations)
    return np.asarray(first) if np.array_equal(first, second) else None


def plot_adaptation_curve(record: AdaptationRecord, path: Path, title: str) -> None:
    """
    Return and success of each adaptation episode, with the spread over tasks.

    :param record: adaptations
    :param path: picture to write
    :param title: what was adapted
    """
    returns, successes = record.returns, record.successes
    episodes = np.arange(1, returns.shape[1] + 1)
    figure = Figure(figsize=(6.4, 5.2))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    low, high = np.quantile(returns, [0.25, 0.75], axis=0)
    top.fill_between(episodes, low, high, color=BLUE, alpha=0.2, linewidth=0, label="middle half of the tasks")
    top.plot(episodes, returns.mean(axis=0), color=BLUE, marker="o", markersize=4, label="mean over tasks")
    top.set_ylabel("return")
    top.set_title(title)
    span_unit_if_flat(top)
    top.legend(frameon=False, loc="lower right")
    bottom.plot(episodes, 100 * successes.mean(axis=0), color=ORANGE, marker="o", markersize=4, label="in this episode")
    found = 100 * np.maximum.accumulate(successes, axis=1).mean(axis=0)
    bottom.plot(episodes, found, color=GREY, linestyle="--", label="so far")
    bottom.set_ylabel("share of tasks\nsolved (%)")
    bottom.set_ylim(-4, 104)
    bottom.set_xlabel("adaptation episode")
    bottom.set_xticks(episodes)
    bottom.legend(frameon=False, loc="lower right")
    for axes in (top, bottom):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    save(figure, path)


def plot_adaptation_paths(
    record: AdaptationRecord,
    tasks: np.ndarray,
    goal_radius: float | None,
    start: np.ndarray | None,
    path: Path,
    title: str,
) -> None:
    """
    The ways of the adaptation episodes on the plane, for task spaces that are a plane.

    :param record: adaptations
    :param tasks: (n, 2) goals
    :param goal_radius: radius of the goals, drawn as a point if None
    :param start: of all episodes, see :func:`start_position`; paths begin after the first step if None
    :param path: picture to write
    :param title: what was adapted
    """
    shown = np.unique(np.linspace(0, len(tasks) - 1, N_PATHS).astype(int))
    order = np.argsort(np.arctan2(tasks[:, 1], tasks[:, 0]))[shown]
    columns = min(3, len(order))
    rows = -(-len(order) // columns)
    figure = Figure(figsize=(3.1 * columns, 2.3 * rows + 0.8), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(order) :]:
        axes.set_visible(False)
    for axes, task in zip(grid.flat, order, strict=False):
        successes = record.successes[task]
        first = int(first_success(successes))
        axes.add_patch(Circle(tasks[task], goal_radius or 0.03, facecolor=GREEN, alpha=0.35, edgecolor=GREEN))
        # A step's achieved task is where it led; the start is not part of it
        ways = record.achieved[task]
        if start is not None:
            ways = np.concatenate([np.broadcast_to(start, (len(ways), 1, 2)), ways], axis=1)
        for episode, way in enumerate(ways, start=1):
            line = {"color": GREY, "alpha": 0.8, "linewidth": 1.0} if episode < first else {"color": BLUE, "linewidth": 1.2}
            axes.plot(way[:, 0], way[:, 1], **line)
        axes.plot(ways[-1, :, 0], ways[-1, :, 1], color=ORANGE, linewidth=2)
        text = f"solved in episode {first}" if successes.any() else "not solved"
        axes.set_title(f"task {task + 1}: {text},\nlast return {record.returns[task, -1]:.1f}", fontsize=9)
        axes.set_aspect("equal")
        axes.spines[["top", "right"]].set_visible(False)
    handles = [
        Line2D([], [], color=GREY, label="before the first success"),
        Line2D([], [], color=BLUE, label="after it"),
        Line2D([], [], color=ORANGE, linewidth=2, label="last episode"),
        Line2D([], [], color=GREEN, marker="o", linestyle="", alpha=0.5, markersize=9, label="hidden goal"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(title if len(order) == len(tasks) else f"{title}; {len(order)} of them", fontsize=11)
    for axes in grid[-1]:
        axes.set_xlabel("x (units of length)")
    for axes in grid[:, 0]:
        axes.set_ylabel("y (units of length)")
    save(figure, path)
