"""The pictures of experiments, from the raw results of their cells."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np

from htr_envs.point_robot import STEP_SIZE, PointRobotFamily
from sb3_htr.common.arrays import load_arrays
from sb3_htr.experiments.calibration import expected_calibration_error
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.protocol import SOLVED_SHARE, scores
from sb3_htr.experiments.runner import in_training
from sb3_htr.zoo.plots.curves import band, finish, marked_line
from sb3_htr.zoo.plots.intervals import iqm_interval
from sb3_htr.zoo.plots.style import BLUE, GREY, curve_colours, curve_styles, save

Results = dict[Cell, Path]
# Draws the results of an experiment into a file
Figure = Callable[[Results, Path], None]


def by_variant(results: Results, and_env: bool = True) -> dict[str, list[tuple[Cell, Any]]]:
    """
    :param results: raw results of the cells
    :param and_env: whether runs of a variant in several envs are several curves
    :return: cells and their arrays, by variant
    """
    groups: dict[str, list[tuple[Cell, Any]]] = {}
    envs: dict[str, set[str]] = {}
    for cell in results:
        envs.setdefault(cell.variant, set()).add(str(cell.env_kwargs))
    for cell, result in results.items():
        name = cell.variant if len(envs[cell.variant]) == 1 or not and_env else f"{cell.variant} {cell.env_kwargs}"
        groups.setdefault(name, []).append((cell, load_arrays(result)))
    return groups


def n_seeds(results: Results) -> int:
    """
    :param results: raw results of the cells
    :return: seeds of them all; a variant may have fewer runs
    """
    return len({cell.seed for cell in results})


def _title(results: Results) -> str:
    n = n_seeds(results)
    # The IQM of three is their mean
    interval = "95 % interval" + " (of learning curves, the range)" * (n < 4)
    shown = "one seed" if n == 1 else f"{'mean' if n < 4 else 'IQM'} over {n} seeds, {interval}"
    return f"{next(iter(results)).env_id}: {shown}"


def label(variant: str, runs: list[tuple[Cell, Any]], results: Results) -> str:
    """
    :param variant: its name
    :param runs: of this variant
    :param results: of all
    :return: the name, with the number of runs where others have more
    """
    return variant if len(runs) == n_seeds(results) else f"{variant} (seeds: {len(runs)})"


def explorer_lines(cell: Cell) -> dict[str, str]:
    """
    :param cell: of a variant
    :return: lines of the explorers whose adaptation curves are drawn, that of its evaluations in training and the prior
    """
    lines = {"prior": "--", in_training(cell).explorer: "-"}
    return {own.explorer: lines[own.explorer] for own in cell.evaluations if not own.tested_on and own.explorer in lines}


def curves(runs: Sequence[Any], key: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param runs: raw results; where rollouts are longer than the time between evaluations, some have one more than others
    :param key: ``"curve"`` or ``"solved"``
    :return: env steps (n,), and means over the validation tasks (n_runs, n), of the evaluations that all have
    """
    n = min(len(raw["timesteps"]) for raw in runs)
    return runs[0]["timesteps"][:n], np.stack([raw[key][:n].mean(axis=1) for raw in runs])


def learning(results: Results, path: Path) -> None:
    """
    Left: learning curves on validation tasks. Right: the final models' adaptation to the test tasks, by the same explorer and
    by the prior.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure = matplotlib.figure.Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    groups = by_variant(results)
    lines = {variant: explorer_lines(runs[0][0]) for variant, runs in groups.items()}
    explorers = {explorer for shown in lines.values() for explorer in shown}
    # In the titles where there is one alone, else in the legends
    of_all = f", {min(explorers)}" if len(explorers) == 1 else ""
    for colour, (variant, runs) in zip(curve_colours([*groups]), groups.items(), strict=True):
        timesteps, curve = curves([raw for _, raw in runs], "curve")
        name, own = label(variant, runs, results), in_training(runs[0][0]).explorer
        band(left, timesteps / 1000, curve, colour, "-", name if of_all else f"{name}, {own}")
        for explorer, line in lines[variant].items():
            returns = np.stack([raw[f"returns_{explorer}"] for _, raw in runs])
            of_line = name if of_all else f"{name}, {explorer}"
            band(right, np.arange(1, returns.shape[-1] + 1), returns, colour, line, of_line)
    left.set_xlim(left=0)
    left.set_xlabel("thousand env steps of meta-training")
    left.set_ylabel("return of the last adaptation episode")
    left.set_title(f"validation tasks, during meta-training{of_all} (interval over seeds)", fontsize=9)
    right.set_xlabel("adaptation episode")
    right.set_ylabel("return")
    right.xaxis.get_major_locator().set_params(integer=True)
    right.set_title(f"test tasks, final models{of_all} (over seeds, tasks and evaluation seeds)", fontsize=9)
    finish(figure, path, _title(results))


def race(results: Results, path: Path) -> None:
    """
    Validation tasks solved during meta-training, over env steps and over the minutes that these, updates and evaluations took
    in the median run.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure = matplotlib.figure.Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    groups = by_variant(results)
    for colour, (variant, runs) in zip(curve_colours([*groups]), groups.items(), strict=True):
        timesteps, solved = curves([raw for _, raw in runs], "solved")
        name = f"{label(variant, runs, results)}, {in_training(runs[0][0]).explorer}"
        band(left, timesteps / 1000, 100 * solved, colour, "-", name, alpha=0.08)
        minutes = np.median([raw["elapsed_s"][: len(timesteps)] for _, raw in runs], axis=0) / 60
        band(right, minutes, 100 * solved, colour, "-", f"_{name}", alpha=0.08)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.axhline(100 * SOLVED_SHARE, color=GREY, linestyle=":", linewidth=1)
        axes.xaxis.set_major_formatter("{x:g}")
    left.set_xlabel("thousand env steps of meta-training")
    right.set_xlabel("minutes of meta-training, with evaluations")
    left.set_ylabel("validation tasks solved (%)")
    finish(figure, path, _title(results))


def optimal_return(goal_distance: float, max_episode_steps: int) -> float:
    """
    :param goal_distance: argument of SparsePointRobot-v0
    :param max_episode_steps: argument of the env
    :return: mean return over the test tasks of going to the goal as fast as possible and staying there
    """
    family = PointRobotFamily(goal_distance=goal_distance)
    goals = family.test_tasks.astype(np.float64)
    position, total = np.zeros_like(goals), np.zeros(len(goals))
    for _ in range(max_episode_steps):
        # Each axis is clipped on its own, so this is at least as fast as the straight way
        position += np.clip(goals - position, -STEP_SIZE, STEP_SIZE)
        distance = np.linalg.norm(goals - position, axis=1)
        total += np.where(distance < family.goal_radius, 1 - distance, 0)
    return float(total.mean())


def goal_distance(results: Results, path: Path) -> None:
    """
    Left: return, relative to the optimum, against the distance. Right: success.

    :param results: raw results of the cells
    :param path: picture to write
    """
    figure = matplotlib.figure.Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    groups = by_variant(results, and_env=False)
    for colour, (variant, runs) in zip(curve_colours([*groups]), groups.items(), strict=True):
        x = sorted({cell.env_kwargs["goal_distance"] for cell, _ in runs})
        # A line is of the seeds that have been run at each distance
        n_distances = Counter(cell.seed for cell, _ in runs)
        ordered = [run for run in runs if n_distances[run[0].seed] == len(x)]
        if not ordered:
            continue
        ordered.sort(key=lambda run: (run[0].env_kwargs["goal_distance"], run[0].seed))
        optimum = [optimal_return(**cell.env_kwargs) for cell, _ in ordered]
        for axes, metric in ((left, "last_episode_return"), (right, "success_rate")):
            values = scores([raw for _, raw in ordered], metric, "belief")
            if axes is left:
                values = values / np.array(optimum)[:, None, None]
            # (n_seeds, n_eval_seeds, n_tasks, n_distances)
            name = label(variant, ordered[: len(ordered) // len(x)], results)
            band(axes, np.array(x), np.stack(np.split(values, len(x)), axis=-1), colour, "-", name)
    left.axhline(1, color=GREY, linestyle=":", linewidth=1)
    left.set_ylabel("return of the last episode / optimum")
    right.set_ylabel("test tasks solved in the last episode")
    for axes in (left, right):
        axes.set_xlabel("distance of the goals (1.5: 30 steps, 2: 40 steps, else 20)")
        axes.set_ylim(-0.03, 1.05)
    finish(figure, path, _title(results))


def relabelling(results: Results, path: Path) -> None:
    """
    Left: K against the return on test tasks. Right: learning curves of the other variants on validation tasks.

    :param results: raw results of the cells
    :param path: picture to write
    """
    groups = {variant: [raw for _, raw in runs] for variant, runs in by_variant(results).items()}
    figure = matplotlib.figure.Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    probabilities = sorted(float(variant.removeprefix("K = ")) for variant in groups if variant.startswith("K = "))
    returns = [scores(groups[f"K = {k:g}"], "last_episode_return", "belief") for k in probabilities]
    # A band needs as many runs of each
    n = min(map(len, returns), default=0)
    if n:
        heights = np.stack([values[:n] for values in returns], axis=-1)
        seeds = f" (seeds: {n})" * (n < n_seeds(results))
        band(left, np.array(probabilities), heights, BLUE, "-", f"IQM and 95 % interval{seeds}")
    for k, values in zip(probabilities, returns, strict=True):
        text = "one seed" if k == 0 else None
        left.plot([k] * len(values), values.mean(axis=(1, 2)), "o", color=GREY, markersize=3, label=text)
    left.set_xlabel("K, probability of relabelling")
    left.set_ylabel("return of the last adaptation episode")
    left.set_title("test tasks, final models", fontsize=10)
    shown = [variant for variant in groups if variant == "K = 0.8" or not variant.startswith("K = ")]
    for colour, variant in zip(curve_colours(shown), shown, strict=True):
        timesteps, curve = curves(groups[variant], "curve")
        band(right, timesteps / 1000, curve, colour, "-", "even, K = 0.8, the default" if variant == "K = 0.8" else variant)
    right.set_xlabel("thousand env steps of meta-training")
    right.set_ylabel("return of the last adaptation episode")
    right.set_title("validation tasks, hindsight task strategies and ablation", fontsize=10)
    finish(figure, path, _title(results))


def evaluations(results: Results, path: Path) -> None:
    """
    Return of the last adaptation episode by each explorer, in each env that the models were evaluated in.

    :param results: raw results of the cells of one variant
    :param path: picture to write
    """
    ((_, runs),) = by_variant(results).items()
    cell, raws = runs[0][0], [raw for _, raw in runs]
    explorers = list(dict.fromkeys(evaluation.explorer for evaluation in cell.evaluations))
    places = [evaluation.tested_on for evaluation in cell.evaluations if evaluation.explorer == explorers[0]]
    figure = matplotlib.figure.Figure(figsize=(3 + 2 * len(places), 3.6), layout="constrained")
    grid = figure.subplots(1, len(places), sharey=True, squeeze=False)
    for axes, tested_on in zip(grid.flat, places, strict=True):
        for evaluation in [evaluation for evaluation in cell.evaluations if evaluation.tested_on == tested_on]:
            row = explorers.index(evaluation.explorer)
            estimate, low, high = iqm_interval(scores(raws, "last_episode_return", evaluation.name))
            axes.plot([low, high], [row, row], color=BLUE, linewidth=3, alpha=0.4)
            axes.plot(estimate, row, "o", color=BLUE)
        axes.set_title(", ".join(f"{key} {value}" for key, value in tested_on.items()) or "as in training", fontsize=10)
        axes.set_xlim(left=-0.5)
        axes.grid(alpha=0.25)
    grid[0, 0].set_yticks(range(len(explorers)), explorers)
    grid[0, 0].invert_yaxis()
    figure.supxlabel("return of the last adaptation episode", fontsize=10)
    figure.suptitle(_title(results), fontsize=11)
    save(figure, path)


def reliability(results: Results, path: Path) -> None:
    """
    Frequency of success against its probability by the reward model, on validation tasks.

    :param results: raw results of the cells
    :param path: picture to write, if there is such a model: a family without successes has none, as have some rivals
    """
    variants = by_variant(results).items()
    groups = {variant: np.sum([raw["calibration"] for _, raw in runs], axis=0) for variant, runs in variants}
    if not any(bins.any() for bins in groups.values()):
        return
    # Higher by each line of the legend, and wide enough for the longest
    figure = matplotlib.figure.Figure(figsize=(5.4, 3.6 + len(groups) / 6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, linewidth=1)
    for (colour, line), (variant, bins) in zip(curve_styles([*groups]), groups.items(), strict=True):
        if not bins.any():
            continue
        n, probability, successes = bins[bins[:, 0] > 0].T
        text = f"{variant}: {expected_calibration_error(bins):.3f}"
        marked_line(axes, probability / n, successes / n, colour, line, text)
    axes.set_title("behind each name: expected calibration error", fontsize=9)
    axes.set_xlabel("probability of success by the reward model")
    axes.set_ylabel("frequency of success")
    finish(figure, path, f"{next(iter(results)).env_id}: states and validation tasks of {n_seeds(results)} seeds", 1)
