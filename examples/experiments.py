"""Experiments of one's own: families of this folder, by the protocol of the package.

    sb3-htr experiment two_link_arm --gym-packages examples.experiments
    sb3-htr experiment hidden_target_reacher --gym-packages examples.experiments
    sb3-htr experiment sparse_half_cheetah_velocity --gym-packages examples.experiments

All settings are the defaults.
"""

from examples import hidden_target_reacher, sparse_half_cheetah_velocity, two_link_arm  # noqa: F401 register the envs
from sb3_htr.experiments.grid import BELIEF, EXPERIMENTS, Experiment, Variant, by

HTR = ("htr-ser",)

for name, env_id, n_timesteps, methods in (
    ("two_link_arm", "TwoLinkArm-v0", 200_000, HTR),
    ("hidden_target_reacher", "HiddenTargetReacher-v0", 150_000, HTR),
    # On the family of HFR, HFR and what it was compared with
    ("sparse_half_cheetah_velocity", "SparseHalfCheetahVelocity-v0", 1_000_000, (*HTR, "htr-hfr", "htr-hipi")),
):
    EXPERIMENTS[name] = Experiment(
        name,
        "An example's family, with the default settings.",
        env_id,
        n_timesteps,
        tuple(map(Variant, methods)),
        eval_freq=n_timesteps // 4,
        evaluations=by(BELIEF),
    )
