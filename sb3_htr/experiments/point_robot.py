"""SparsePointRobot-v0: HTR against PEARL without relabelling, and against PEARL with a dense proxy reward."""

from collections.abc import Sequence
from typing import Any

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell

ENV_ID = "SparsePointRobot-v0"


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per method
    :param n_timesteps: budget of env steps
    :return: HTR with this library's defaults, by sample-time relabelling (SER) and by episode clustering (EC); PEARL as its
        paper has it: no relabelling, z from N(0, I) when exploring; and the defaults without relabelling, but with the dense
        proxy reward for actor and critics
    """
    dense = {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}}
    plain: dict[str, Any] = {
        "replay_buffer_kwargs": {"relabel_probability": 0.0},
        "train_explorer": "prior",
        "explorer": "prior",
    }
    return [
        cell
        for seed in range(1, n_seeds + 1)
        for cell in (
            Cell(ENV_ID, "htr-ser", seed, n_timesteps),
            Cell(ENV_ID, "pearl-sparse", seed, n_timesteps, hyperparams=plain, explorers=("prior",)),
            Cell(ENV_ID, "htr-ec", seed, n_timesteps, hyperparams={"replay_buffer_class": "EpisodeClustering"}),
            Cell(ENV_ID, "pearl-dense", seed, n_timesteps, hyperparams=dense),
        )
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("point_robot", __doc__, cells, 150_000, argv)


if __name__ == "__main__":
    main()
