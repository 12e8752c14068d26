"""``sb3-htr experiment``: repeat an experiment of this project, all its runs and its tables and pictures."""

import importlib
from collections.abc import Sequence
from pathlib import Path

from sb3_htr.zoo.commands.arguments import make_parser

EXAMPLE = """  sb3-htr experiment point_robot --jobs 2
  sb3-htr experiment ant --quick                   one seed, a tenth of the env steps: does it run?"""


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    # Experiments use the zoo, and not the other way round
    grid, report, runner = (importlib.import_module(f"sb3_htr.experiments.{name}") for name in ("grid", "report", "runner"))
    names = "\n".join(f"  {name:<16} {experiment.env_id}: {experiment.about}" for name, experiment in grid.EXPERIMENTS.items())
    parser = make_parser("experiment", f"Repeat an experiment; a killed one goes on where it stopped.\n\n{names}", EXAMPLE)
    parser.add_argument("name", choices=list(grid.EXPERIMENTS), metavar="NAME", help="one of the above")
    parser.add_argument("--seeds", type=int, help="runs of each variant (default: those of the experiment)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, each on one thread (default: 2)")
    parser.add_argument("--quick", action="store_true", help="one seed, a tenth of the env steps")
    runs = "folder for the runs; those of an experiment resume from RUNS/NAME (default: runs)"
    parser.add_argument("--runs", type=Path, default=Path("runs"), help=runs)
    parser.add_argument("-o", "--output", type=Path, help="folder for the results (default: results/NAME)")
    args = parser.parse_args(argv)
    experiment = grid.EXPERIMENTS[args.name]
    cells = experiment.cells(1, 0.1) if args.quick else experiment.cells(args.seeds)
    quick = "quick-" if args.quick else ""
    output = args.output or Path("results", quick + args.name)
    how = "--quick" if args.quick else f"--seeds {len({cell.seed for cell in cells})}"
    results = runner.run_cells(cells, args.runs / "quick" if args.quick else args.runs, args.jobs)
    report.write(f"sb3-htr experiment {args.name} {how}", experiment, results, output)
    print(f"Results: {output}")
