"""The methods that are compared on the locomotion envs."""

from typing import Any

from sb3_htr.experiments.runner import Cell


def cells(env_id: str, n_seeds: int, n_timesteps: int) -> list[Cell]:
    """
    :param env_id: registered env
    :param n_seeds: runs per method
    :param n_timesteps: budget of env steps
    :return: HTR with the settings for this env; and the same without relabelling, with the dense proxy reward for actor and
        critics, and with the sparse reward
    """
    dense: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0, "rl_reward_type": "dense"}}
    sparse: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}}
    methods: dict[str, dict[str, Any]] = {"htr-ser": {}, "pearl-dense": dense, "pearl-sparse": sparse}
    # Method by method, so that the first one is complete first
    return [
        Cell(env_id, method, seed, n_timesteps, hyperparams=hyperparams, explorers=("search",))
        for method, hyperparams in methods.items()
        for seed in range(1, n_seeds + 1)
    ]
