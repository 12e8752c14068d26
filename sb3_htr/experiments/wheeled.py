"""SparseWheeled-v0: HTR against PEARL without relabelling, and against PEARL with a dense proxy reward."""

from collections.abc import Sequence
from typing import Any

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell

ENV_ID = "SparseWheeled-v0"


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per method
    :param n_timesteps: budget of env steps
    :return: HTR with the settings for this env; and the same without relabelling, with the sparse reward and with the dense
        proxy reward for actor and critics
    """
    sparse: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}}
    dense: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}}
    methods: dict[str, dict[str, Any]] = {"htr-ser": {}, "pearl-sparse": sparse, "pearl-dense": dense}
    # Method by method, so that the first one is complete first
    return [
        Cell(ENV_ID, method, seed, n_timesteps, hyperparams=hyperparams, explorers=("search",))
        for method, hyperparams in methods.items()
        for seed in range(1, n_seeds + 1)
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("wheeled", __doc__, cells, 600_000, argv, eval_freq=50_000)


if __name__ == "__main__":
    main()
