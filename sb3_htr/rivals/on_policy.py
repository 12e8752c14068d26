"""Rivals that learn from what they have just collected."""

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_htr.common.checks import get_max_episode_steps
from sb3_htr.rivals.base import Rival


class OnPolicyRival(Rival, OnPolicyAlgorithm):
    """
    A mixin for on-policy algorithms of Stable-Baselines3. A rollout begins with a reset of all envs, so it must be long enough
    for whole episodes: ``n_steps`` is the time limit of the env or more, best a multiple of it.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.env is not None and self.n_steps < (longest := get_max_episode_steps(self.env)):
            raise ValueError(
                f"n_steps is {self.n_steps}, and episodes have up to {longest} steps: give it as many or more, because a "
                "rollout begins with a reset, and none would see the end of an episode."
            )

    @property
    def n_steps_per_rollout(self) -> int:
        return self.n_steps * self.n_envs

    def dump_logs(self, iteration: int = 0) -> None:
        """
        :param iteration: not used: rollouts are counted from the beginning of the training, which may have been resumed
        """
        if self.logs_now():
            super().dump_logs(self.n_rollouts)
