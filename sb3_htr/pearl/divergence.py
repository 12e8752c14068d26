"""Notices that the posterior is of no use, before a run is lost to it."""

from sb3_htr.common.warn_once import WarnOnce

# Mean KL divergence of the posterior from N(0, I), in nats: below, z says nothing about the task; above, it is no probability
# that floats can handle. A task takes 5 to 25 nats on the envs of this package.
COLLAPSED, EXPLODED = 0.01, 1000.0


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
