"""SparseTargetSpeed-v0, tasks that are no places: SER and EC against PEARL with sparse and with dense rewards."""

from collections.abc import Sequence
from typing import Any

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell

ENV_ID = "SparseTargetSpeed-v0"
METHODS: dict[str, dict[str, Any]] = {
    "htr-ser": {},
    "htr-ec": {"replay_buffer_class": "EpisodeClustering"},
    "pearl-dense": {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}},
    "pearl-sparse": {"replay_buffer_kwargs": {"relabel_probability": 0.0}},
}


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per method
    :param n_timesteps: budget of env steps
    :return: the defaults with both kinds of relabelling, with the dense proxy for actor and critics, and without relabelling
    """
    return [
        Cell(ENV_ID, method, seed, n_timesteps, hyperparams)
        for seed in range(1, n_seeds + 1)
        for method, hyperparams in METHODS.items()
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("target_speed", __doc__, cells, 60_000, argv)


if __name__ == "__main__":
    main()
