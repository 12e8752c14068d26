"""SparseAnt-v0: HTR against PEARL without relabelling, and against PEARL with a dense proxy reward."""

from collections.abc import Sequence
from functools import partial

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.locomotion import cells


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("ant", __doc__, partial(cells, "SparseAnt-v0"), 600_000, argv, eval_freq=100_000)


if __name__ == "__main__":
    main()
