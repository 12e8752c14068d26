"""Notices that learning has gone wrong, before a run is lost to it."""

from collections.abc import Mapping

from torch import nn

from sb3_htr.common.warn_once import WarnOnce

# Mean KL divergence of the posterior from N(0, I), in nats: below, z says nothing about the task; above, it is no probability
# that floats can handle. A task takes 5 to 25 nats on the envs of this package.
COLLAPSED, EXPLODED = 0.01, 1000.0


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


def check_posterior(kl_divergence: float, warn_once: WarnOnce) -> None:
    """
    Warns once for each way in which the posterior can stop being of use.

    :param kl_divergence: mean over the latest updates, in nats
    :param warn_once: of the model
    """
    if kl_divergence < COLLAPSED:
        what = "collapsed: z says nothing about the task. Lower kl_coef, or relabel more often"
    elif kl_divergence > EXPLODED:
        what = "exploded: z is far from anything that the prior covers. Raise kl_coef"
    else:
        return
    warn_once(what, f"The posterior has {what} (KL divergence from the prior {kl_divergence:.3g} nats).", stacklevel=3)
