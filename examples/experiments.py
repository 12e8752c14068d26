"""Experiments of one's own: two families of this folder, by the protocol of the package.

    sb3-htr experiment two_link_arm --gym-packages examples.experiments
    sb3-htr experiment hidden_target_reacher --gym-packages examples.experiments

All settings are the defaults.
"""

from examples import hidden_target_reacher, two_link_arm  # noqa: F401 register the envs
from sb3_htr.experiments.grid import BELIEF, EXPERIMENTS, Experiment, Variant, by

for name, env_id, n_timesteps in (
    ("two_link_arm", "TwoLinkArm-v0", 200_000),
    ("hidden_target_reacher", "HiddenTargetReacher-v0", 150_000),
):
    EXPERIMENTS[name] = Experiment(
        name,
        "An example's family, with the default settings.",
        env_id,
        n_timesteps,
        (Variant("htr-ser"),),
        eval_freq=50_000,
        evaluations=by(BELIEF),
    )
