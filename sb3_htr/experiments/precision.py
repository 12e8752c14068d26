"""SparsePointRobot-v0 with matrix products of float32 and of bfloat16 factors: what the faster updates cost."""

from collections.abc import Sequence

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell

ENV_ID = "SparsePointRobot-v0"


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per setting
    :param n_timesteps: budget of env steps
    :return: HTR with this library's defaults, with ``matmul_precision`` ``"highest"`` and ``"medium"``
    """
    return [
        Cell(ENV_ID, name, seed, n_timesteps, hyperparams={"matmul_precision": precision}, explorers=("search",))
        for seed in range(1, n_seeds + 1)
        for name, precision in (("htr-ser", "highest"), ("htr-ser-bf16", "medium"))
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("precision", __doc__, cells, 150_000, argv)


if __name__ == "__main__":
    main()
