"""The command line that all experiments share."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from sb3_htr.experiments.report import Plot, plot_learning, write
from sb3_htr.experiments.runner import Cell, run_cells


def run_experiment(
    name: str,
    description: str | None,
    cells: Callable[[int, int], list[Cell]],
    n_timesteps: int,
    argv: Sequence[str] | None,
    plot: Plot = plot_learning,
    eval_freq: int = 10_000,
) -> None:
    """
    :param name: of the experiment, its module and its folder of results
    :param description: for ``--help``
    :param cells: gives the runs for a number of seeds and a budget of env steps
    :param n_timesteps: default of the budget
    :param argv: arguments, None for those of the process
    :param plot: draws the picture
    :param eval_freq: env steps between evaluations on the validation tasks
    """
    parser = argparse.ArgumentParser(prog=f"python -m sb3_htr.experiments.{name}", description=description)
    parser.add_argument("--seeds", type=int, default=5, help="runs per method")
    parser.add_argument("--timesteps", type=int, default=n_timesteps, help="env steps per run")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, each on one thread")
    parser.add_argument("--runs", type=Path, default=Path("runs", name), help="folder for the runs; resumes from it")
    args = parser.parse_args(argv)
    print(write(name, run_cells(cells(args.seeds, args.timesteps), args.runs, args.jobs, eval_freq), plot))
