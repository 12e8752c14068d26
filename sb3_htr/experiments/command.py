"""``sb3-htr experiment``: repeat experiments of this project, all their runs, tables and pictures."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sb3_htr.common.checks import check_device
from sb3_htr.common.settings import check_numbers
from sb3_htr.experiments import driver, executors, grid, raw_results, report
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.storage import storage_at
from sb3_htr.zoo.commands.arguments import OF_PACKAGES, make_parser
from sb3_htr.zoo.run.soft_interrupt import terminated_as_interrupted
from sb3_htr.zoo.run.trust import import_packages

EXAMPLE = """  sb3-htr experiment point_robot --jobs 2
  sb3-htr experiment rivals wheeled ant --ray auto --runs /shared/runs
                                                        all methods on three envs, five seeds each, on a Ray cluster
  sb3-htr experiment rivals --with-results results/rivals
                                                        all but the runs that are in results/rivals already
  sb3-htr experiment ant --quick                        one seed, a tenth of the env steps: does it run?
  sb3-htr experiment ant --finished                     a table and pictures, of what has been run so far
  sb3-htr experiment mine --gym-packages my_method --with-results results/rivals
                                                        beside runs that were made before, which are not trained again"""


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    args = _parse(argv)
    how_many = (args.seeds or 1, 0.1) if args.quick else (args.seeds,)
    grids = {name: grid.EXPERIMENTS[name].cells(*how_many) for name in args.names}
    given = {"gym_packages": tuple(args.gym_packages), "device": args.device}
    grids = {name: [replace(cell, **given) for cell in cells] for name, cells in grids.items()}
    chosen = [cell for cells in grids.values() for cell in cells]
    if args.cell is not None:
        if not 0 <= args.cell < len(chosen):
            raise ValueError(f"--cell is {args.cell}, expected 0 to {len(chosen) - 1}: there are {len(chosen)} runs.")
        chosen = [chosen[args.cell]]
    of_command = {*chosen}
    quick = "quick-" if args.quick else ""
    runs = f"{args.runs.rstrip('/')}/quick" if args.quick else args.runs
    storage = storage_at(runs)
    here = storage.fetch_results(chosen)
    outputs = {name: Path("results", quick + name) for name in grids}
    if args.output is not None:
        outputs = {name: args.output / name if len(grids) > 1 else args.output for name in grids}
    earlier = {name: [folder / name if len(grids) > 1 else folder for folder in args.with_results] for name in grids}
    for name, cells in grids.items():
        for folder in earlier[name]:
            print(f"{raw_results.unpack(folder, cells, here)} of {len(cells)} runs are in {folder}.")
        report.check(finished([cell for cell in cells if cell in of_command], here))
        if not args.finished and args.cell is None:
            raw_results.check_none_lost(outputs[name], cells)
    storage.send_results(chosen)
    failed: ValueError | None = None
    if not args.finished:
        on_this_machine = executors.SerialExecutor() if args.cell is not None else executors.Processes(args.jobs)
        try:
            executor = executors.Ray(args.ray, args.device) if args.ray else on_this_machine
            with terminated_as_interrupted():  # Ray has a handler of its own
                driver.Driver(chosen, runs, executor).run()
        except KeyboardInterrupt:
            print(f"\nStopped. What ran goes on from its checkpoint in {storage} with the same command.", file=sys.stderr)
            raise SystemExit(130) from None
        except ValueError as error:
            # Experiments whose cells are all done have their results before it is raised
            failed = error
    try:
        here = storage.fetch_results(chosen)
    except OSError as error:
        raise failed or error from None
    results = {} if args.cell is not None else {name: finished(cells, here) for name, cells in grids.items()}
    for name, done in results.items():
        print(f"{len(done)} of {len(grids[name])} runs of {name} are finished.")
        if not done or (failed and len(done) < len(grids[name])):
            continue
        report.write(_command(args, grids[name], outputs[name], earlier[name]), grid.EXPERIMENTS[name], done, outputs[name])
        print(f"Results: {outputs[name]}")
    if failed:
        raise failed
    if nothing := [name for name, done in results.items() if not done]:
        raise ValueError(
            f"No run of {' and of '.join(nothing)} is finished in {storage}: run it without --finished, or name other --runs."
        )


def _command(args: argparse.Namespace, cells: Sequence[Cell], output: Path, earlier: Sequence[Path]) -> str:
    """What repeats all runs of an experiment."""
    words = ["sb3-htr", "experiment", cells[0].experiment, *["--quick"] * args.quick]
    words += ["--seeds", str(len({cell.seed for cell in cells}))]
    words += ["--gym-packages", *args.gym_packages] if args.gym_packages else []
    words += ["--device", args.device] if args.device != "cpu" else []
    # Those of its own folder are runs of the experiment, made by this command before
    others = [str(folder) for folder in earlier if folder.resolve() != output.resolve()]
    words += ["--with-results", *others] if others else []
    return shlex.join(words)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    own.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help=OF_PACKAGES)
    # Before the names of experiments are asked for
    import_packages(own.parse_known_args(argv)[0].gym_packages)
    names = "\n".join(f"  {name:<16} {experiment.env_id}: {experiment.about}" for name, experiment in grid.EXPERIMENTS.items())
    about = f"Repeat experiments; a killed one goes on where it stopped.\n\n{names}"
    parser = make_parser("experiment", about, EXAMPLE, parents=[own])
    several = "one of the above, or several, whose cells are in one queue"
    parser.add_argument("names", nargs="+", choices=list(grid.EXPERIMENTS), metavar="NAME", help=several)
    parser.add_argument("--seeds", type=int, help="runs of each variant (default: those of the experiment)")
    parser.add_argument("--quick", action="store_true", help="a tenth of the env steps, and one seed unless told otherwise")
    runs = "folder for the runs, or a URL of fsspec; those of an experiment resume from RUNS/NAME (default: runs)"
    parser.add_argument("--runs", default="runs", help=runs)
    output = "folder for the results, of several experiments in OUTPUT/NAME (default: results/NAME)"
    parser.add_argument("-o", "--output", type=Path, help=output)
    earlier = "folders of results, of several experiments FOLDER/NAME: runs that they have are finished, and not trained again"
    parser.add_argument("--with-results", type=Path, nargs="+", default=[], metavar="FOLDER", help=earlier)
    device = "torch device to train on (default: cpu, whose bits are promised); final models are evaluated on the CPU"
    parser.add_argument("--device", default="cpu", help=device)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=int, default=2, help="runs at a time, each on one thread (default: 2)")
    where.add_argument("--ray", metavar="ADDRESS", help="run on a Ray cluster; auto for the one of this machine")
    where.add_argument("--cell", type=int, metavar="I", help="run number I alone, from 0, for job arrays; writes no results")
    where.add_argument("--finished", action="store_true", help="train nothing: results of the runs that are finished")
    args = parser.parse_args(argv)
    for name in args.names:
        experiment = grid.EXPERIMENTS[name]
        if experiment.name != name or not experiment.variants:
            raise ValueError(
                f'EXPERIMENTS["{name}"] is an Experiment named {experiment.name!r} with {len(experiment.variants)} variants: '
                "expected the same name, which its folders and commands have, and at least one variant."
            )
    given = {"--seeds": args.seeds, "--jobs": args.jobs}
    check_numbers(**{name: (n, 1) for name, n in given.items() if n is not None})
    if not args.ray:  # whose nodes may have others
        check_device(args.device)
    elif ":" in args.device:
        raise ValueError(f"--device is {args.device}, but Ray chooses which GPU a run sees: give --device cuda.")
    return args


def finished(cells: Sequence[Cell], runs: Path) -> dict[Cell, Path]:
    """
    :param cells: of an experiment
    :param runs: folder of all experiments' runs
    :return: raw results of those that have one there
    """
    return {cell: path for cell in cells if (path := cell.result(runs)).exists()}
