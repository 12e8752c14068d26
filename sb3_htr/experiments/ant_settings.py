"""SparseAnt-v0: which settings does HTR need to learn to walk? Half of the budget tells them apart."""

from collections.abc import Sequence
from typing import Any

from sb3_htr.experiments.command import run_experiment
from sb3_htr.experiments.runner import Cell

# What differs from the settings of the env
SETTINGS: dict[str, dict[str, Any]] = {
    "as-shipped": {},
    "ent-coef-0.01": {"ent_coef": 0.01},
    "not-normalized": {"normalize": False},
    "strategy-random": {"replay_buffer_kwargs": {"relabel_probability": 0.8, "hindsight_task_strategy": "random"}},
    "twice-the-updates": {"gradient_steps": 800},
}


def cells(n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param n_seeds: runs per setting
    :param n_timesteps: budget of env steps
    :return: HTR with the settings for this env, and with one of them changed
    """
    return [
        Cell("SparseAnt-v0", name, seed, n_timesteps, hyperparams=hyperparams, explorers=("search",))
        for seed in range(1, n_seeds + 1)
        for name, hyperparams in SETTINGS.items()
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    :param argv: arguments, by default those of the process
    """
    run_experiment("ant_settings", __doc__, cells, 300_000, argv, eval_freq=100_000)


if __name__ == "__main__":
    main()
