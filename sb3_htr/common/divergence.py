"""Notices that a training cannot go on."""

from collections.abc import Mapping

from torch import nn


class DivergedError(FloatingPointError):
    """Training cannot go on: a loss or a weight is not finite."""


def check_not_diverged(networks: nn.Module, losses: Mapping[str, float], n_updates: int, num_timesteps: int) -> None:
    """
    :param networks: whose weights are checked
    :param losses: means over the latest updates
    :param n_updates: for the message
    :param num_timesteps: for the message
    :raises DivergedError: naming the first loss or weight that is not finite
    """
    where = f"at env step {num_timesteps}, update {n_updates}"
    advice = "lower learning_rate, or look for extreme observations and rewards"
    bad = [name for name, weight in networks.named_parameters() if not bool(weight.isfinite().all())]
    for name, loss in losses.items():
        if not abs(loss) < float("inf"):
            also = f" and so are weights ({bad[0]} first)" if bad else ""
            raise DivergedError(f"{name} is {loss} {where}{also}: {advice}.")
    if bad:
        raise DivergedError(f"The weights {bad[0]} are not finite {where}: {advice}.")
