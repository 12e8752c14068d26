"""SparsePointRobot-v0: HTR against PEARL without relabelling, and against PEARL with a dense proxy reward."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_htr.experiments.report import write
from sb3_htr.experiments.runner import Cell, run_cells

ENV_ID = "SparsePointRobot-v0"


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per method
    :param n_timesteps: budget of env steps
    :return: HTR with this library's defaults, by sample-time relabelling (SER) and by episode clustering (EC); PEARL as its
        paper has it: no relabelling, z from N(0, I) when exploring; the defaults but for the relabelling; and those with the
        dense proxy reward for actor and critics
    """
    no_relabelling: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}}
    dense = {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}}
    plain = {**no_relabelling, "train_explorer": "prior", "explorer": "prior"}
    return [
        cell
        for seed in range(1, n_seeds + 1)
        for cell in (
            Cell(ENV_ID, "htr-ser", seed, n_timesteps),
            Cell(ENV_ID, "pearl-sparse", seed, n_timesteps, hyperparams=plain, explorers=("prior",)),
            Cell(ENV_ID, "pearl-sparse-search", seed, n_timesteps, hyperparams=no_relabelling),
            Cell(ENV_ID, "htr-ec", seed, n_timesteps, hyperparams={"replay_buffer_class": "EpisodeClustering"}),
            Cell(ENV_ID, "pearl-dense", seed, n_timesteps, hyperparams=dense),
        )
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_htr.experiments.point_robot", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="runs per method")
    parser.add_argument("--timesteps", type=int, default=150_000, help="env steps per run")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, each on one thread")
    parser.add_argument("--runs", type=Path, default=Path("runs/point_robot"), help="folder for the runs; resumes from it")
    args = parser.parse_args(argv)
    print(write("point_robot", run_cells(cells(args.seeds, args.timesteps), args.runs, args.jobs)))


if __name__ == "__main__":
    main()
