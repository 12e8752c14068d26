"""Check that an environment keeps the promises of a task family."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


def check_task_env(env: gym.Env[Any, Any]) -> None:
    """Placeholder until the next commit."""
