"""Turns the raw results of an experiment into ``results/<name>/``."""

import json
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.versions import UNKNOWN_HARDWARE
from sb3_htr.experiments import raw_results
from sb3_htr.experiments.calibration import expected_calibration_error
from sb3_htr.experiments.cell import MOVE, REMOVE, Cell, Evaluation
from sb3_htr.experiments.grid import Experiment
from sb3_htr.experiments.protocol import EVAL_SEEDS, METRICS, OF_TRAINING, TIMES, env_steps_to_solved, is_solved, scores
from sb3_htr.experiments.runner import LOGGED, in_training
from sb3_htr.experiments.table import table
from sb3_htr.zoo.plots.intervals import iqm_difference, iqm_interval

RETURN = "last_episode_return"
STEPS = env_steps_to_solved.__name__


class Runs(NamedTuple):
    """
    Of one variant, in one env.

    :param cells: one for each seed
    :param raws: their raw results
    """

    cells: list[Cell]
    raws: list[Any]

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        """Of each of them."""
        return self.cells[0].evaluations

    @property
    def in_training(self) -> Evaluation:
        """The one that is by the explorer of the training's own evaluations."""
        return in_training(self.cells[0])

    def returns(self, evaluation: Evaluation) -> np.ndarray:
        """(n_runs, n_eval_seeds, n_tasks), of the last adaptation episode."""
        return scores(self.raws, RETURN, evaluation.name)

    @property
    def n_unsolved(self) -> int:
        """Runs that never solved enough of the validation tasks: how much later they would have is not known."""
        return sum(not is_solved(raw).any() for raw in self.raws)

    @property
    def n_at_first(self) -> int:
        """Runs that did at their first evaluation: how much sooner they would have been seen to is not known."""
        return sum(bool(is_solved(raw)[0]) for raw in self.raws)

    def about(self, evaluation: Evaluation) -> dict[str, Any]:
        """What a number is of."""
        first = self.cells[0]
        what = {"env": first.env_id, "env_kwargs": first.env_kwargs, "method": first.method, "variant": first.variant}
        settings = {"settings": first.settings, "env_steps": first.n_timesteps, "n_seeds": len(self.cells)}
        settings["n_episodes"] = first.n_episodes
        return {**what, **settings, **evaluation._asdict()}

    def means(self) -> dict[str, float | None]:
        """Over all runs; None where an algorithm does not tell."""
        means = {key: float(np.mean([raw[key] for raw in self.raws])) for key in LOGGED}
        means["wall_s"] = float(np.mean([raw["elapsed_s"][-1] for raw in self.raws]))
        means["calibration_error"] = expected_calibration_error(np.sum([raw["calibration"] for raw in self.raws], axis=0))
        return {key: None if np.isnan(mean) else round(mean, 4) for key, mean in means.items()}


def summarize(command: str, results: dict[Cell, Path]) -> dict[str, Any]:
    """
    :param command: that repeats it
    :param results: raw results of the cells of an experiment
    :return: content of ``summary.json``
    """
    groups: dict[str, dict[str, Runs]] = {}
    for cell, path in results.items():
        runs = groups.setdefault(str(cell.env_kwargs), {}).setdefault(cell.variant, Runs([], []))
        runs.cells.append(cell)
        runs.raws.append(load_arrays(path))
    compared = [[*variants.values()] for variants in groups.values()]
    all_runs = [runs for group in compared for runs in group]
    return {
        "name": next(iter(results)).experiment,
        "command": command,
        **{key: ", ".join(sorted({str(raw[key]) for runs in all_runs for raw in runs.raws})) for key in raw_results.COMMITS},
        "date": date.today().isoformat(),
        "machine": "; ".join(sorted({str(raw.get("machine", UNKNOWN_HARDWARE)) for runs in all_runs for raw in runs.raws})),
        "n_eval_seeds": len(EVAL_SEEDS),
        "rows": [row for runs in all_runs for row in _rows(runs)],
        "differences": [row for first, *others in compared for other in others for row in _differences(first, other)],
        "slowdowns": [_slowdown(first, other) for first, *others in compared for other in others],
        "explorer_differences": [row for runs in all_runs for row in _explorer_differences(runs)],
    }


def _rows(runs: Runs) -> Iterator[dict[str, Any]]:
    means, in_training = runs.means(), runs.in_training
    for evaluation in runs.evaluations:
        # No other explorer, and no other tasks, have those of the training
        for metric in [name for name in METRICS if evaluation == in_training or name not in OF_TRAINING]:
            interval: dict[str, Any] = _rounded(iqm_interval(scores(runs.raws, metric, evaluation.name)))
            if metric in TIMES:
                interval |= _limits(at_most=runs.n_at_first, at_least=runs.n_unsolved)
            yield {**runs.about(evaluation), "metric": metric, **interval, **means}


def _differences(first: Runs, other: Runs) -> Iterator[dict[str, Any]]:
    """First variant minus the other, by the same explorer on the same tasks; by its first one, if it has not the same."""
    for evaluation in other.evaluations:
        there = [own for own in first.evaluations if own.tested_on == evaluation.tested_on]
        own = evaluation if evaluation in there else there[0]
        interval = _rounded(iqm_difference(first.returns(own), other.returns(evaluation)))
        yield {**other.about(evaluation), "of": first.cells[0].variant, "metric": RETURN, **interval}


def _slowdown(first: Runs, other: Runs) -> dict[str, Any]:
    """How many times the env steps of the first variant the other needs to solve enough of the validation tasks."""
    steps = [np.log(scores(runs.raws, STEPS, runs.in_training.name)) for runs in (other, first)]
    estimate, low, high = np.exp(iqm_difference(*steps))
    interval: dict[str, Any] = _rounded((estimate, low, high))
    bounds = {"at_most": other.n_at_first + first.n_unsolved > 0, "at_least": other.n_unsolved + first.n_at_first > 0}
    numbers = {"n_unsolved": other.n_unsolved, "n_at_first": other.n_at_first}
    about = {**other.about(other.in_training), "of": first.cells[0].variant, "metric": STEPS}
    return {**about, **interval, **_limits(**bounds), **bounds, **numbers}


def _limits(at_most: float, at_least: float) -> dict[str, None]:
    """The ends that an interval does not have, as its number may be any smaller, or any larger."""
    return {**({"low": None} if at_most else {}), **({"high": None} if at_least else {})}


def _explorer_differences(runs: Runs) -> Iterator[dict[str, Any]]:
    """First explorer minus each other one, of the same models."""
    for evaluation in runs.evaluations:
        first = next(other for other in runs.evaluations if other.tested_on == evaluation.tested_on)
        if evaluation != first:
            interval = _rounded(iqm_interval(runs.returns(first) - runs.returns(evaluation)))
            yield {**runs.about(evaluation), "of": first.explorer, "metric": RETURN, **interval}


def _rounded(interval: tuple[float, float, float]) -> dict[str, Any]:
    """None for an end that is NaN, for which JSON has no number."""
    # adding 0 turns -0 into 0
    numbers = zip(("iqm", "low", "high"), interval, strict=True)
    return {key: None if np.isnan(value) else round(value, 6) + 0.0 for key, value in numbers}


def check(results: dict[Cell, Path]) -> None:
    """
    :param results: raw results of cells
    :raises ValueError: if one is damaged, or not of its cell, see :func:`sb3_htr.experiments.raw_results.check`
    """
    for cell, path in results.items():
        raw = load_arrays(path, advice=REMOVE)
        raw_results.check(cell, raw, str(path), MOVE, f"it may be of another version. {REMOVE}")


def write(command: str, experiment: Experiment, results: dict[Cell, Path], folder: Path) -> None:
    """
    Print the table, and write ``summary.json``, a ``raw-METHOD.npz`` for each method and the pictures of an experiment.

    :param command: that repeats it
    :param experiment: draws the picture
    :param results: raw results of its cells
    :param folder: where they go
    :raises ValueError: if a result lacks something, or runs that are in the folder would be lost; nothing is written then
    """
    check(results)
    raw_results.check_none_lost(folder, [*results])
    # Of what is finished, too, the first variant is what the others are compared with
    variants = [variant.name or variant.method for variant in experiment.variants]
    results = dict(sorted(results.items(), key=lambda result: variants.index(result[0].variant)))
    folder.mkdir(parents=True, exist_ok=True)
    raw_results.pack(results, folder)
    summary = summarize(command, results)
    with atomic_path(folder / "summary.json") as path:
        path.write_text(json.dumps(summary, indent=1) + "\n")
    experiment.figure(results, folder / f"{experiment.name}.png")
    for draw in experiment.also:
        draw(results, folder / f"{draw.__name__}.png")
    print(f"\n{table(summary)}")
