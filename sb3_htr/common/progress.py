"""A progress bar for trainings that spend most of their time between env steps."""

import time
from typing import Any

from stable_baselines3.common.callbacks import ProgressBarCallback


class MetaProgressBarCallback(ProgressBarCallback):
    """
    SB3's progress bar of env steps, which stands still during the updates after a rollout. This one moves: a rollout's steps
    are shared out between its env steps and its updates, as their durations were in the iteration before.
    """

    def __init__(self) -> None:
        super().__init__()
        # Share of an iteration's time that its updates take, and what is left of the rollout's steps for them
        self._share = 0.0
        self._credit = 0.0
        self._per_update = 0.0
        self._n_updates = 0
        self._rollout_start = self._rollout_end = 0.0

    def _on_training_start(self) -> None:
        super()._on_training_start()
        # Those restored from a checkpoint are times of another process, whose clock began elsewhere
        self._n_updates, self._rollout_start, self._rollout_end = 0, 0.0, 0.0
        self.pbar.smoothing = 0.05
        # A model that does not tell has SB3's bar
        self._listeners: list[Any] = getattr(self.model, "update_listeners", [])
        self._listeners.append(self._on_update)

    def _on_rollout_start(self) -> None:
        now = time.monotonic()
        if self._n_updates:
            self._share = (now - self._rollout_end) / (now - self._rollout_start)
        self._settle()
        self._n_updates, self._rollout_start = 0, now

    def _on_step(self) -> bool:
        n_envs = self.training_env.num_envs
        self._credit += n_envs * self._share
        self.pbar.update(n_envs * (1 - self._share))
        return True

    def _on_rollout_end(self) -> None:
        self._rollout_end = time.monotonic()
        self._per_update = self._credit / max(getattr(self.model, "gradient_steps", 1), 1)

    def _on_update(self) -> None:
        self._n_updates += 1
        self._credit -= self._per_update
        self.pbar.update(self._per_update)

    def _on_training_end(self) -> None:
        self._listeners.remove(self._on_update)
        self._settle()
        super()._on_training_end()

    def _settle(self) -> None:
        """What was shared out adds up to whole steps."""
        self.pbar.update(round(self.pbar.n + self._credit) - self.pbar.n)
        self._credit = 0.0
