"""What tests share: small settings, small experience, and envs that break a promise."""

from collections.abc import Callable
from typing import Any

import torch as th
from hypothesis import settings

from sb3_htr import PEARL

ENV_ID = "SparsePointRobot-v0"
MakePEARL = Callable[..., PEARL]

# A PEARL that trains in a moment
TINY: dict[str, Any] = {
    "n_tasks_per_rollout": 4,
    "n_episodes_per_task": 3,
    "learning_starts": 40,
    "gradient_steps": 3,
    "meta_batch_size": 8,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [16], "encoder_arch": [16], "latent_dim": 3},
    "seed": 0,
}
# Env steps of one rollout of these settings
ROLLOUT = 4 * 3 * 20
# PEARL's own protocol, with a posterior within the three episodes
PRIOR = {"name": "prior", "n_exploration_episodes": 1}


def parameters(model: PEARL) -> dict[str, th.Tensor]:
    """Copies of all that a model has learnt."""
    state = {**model.policy.state_dict(), **model.knowledge.state_dict(prefix="knowledge.")}
    return {name: value.clone() for name, value in state.items()}


def with_policy(**settings: Any) -> dict[str, Any]:
    """The tiny networks, with more settings."""
    return {**TINY["policy_kwargs"], **settings}


def many(test: Callable[..., None]) -> Callable[..., None]:
    """For fuzzing: 200 examples, or more if the profile has more."""
    return settings(max_examples=max(200, settings().max_examples))(test)
