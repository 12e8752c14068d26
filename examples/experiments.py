"""Experiments of one's own: families of this folder, by the protocol of the package. In the root of the repository:

    sb3-htr experiment two_link_arm --gym-packages examples.experiments
    sb3-htr experiment hidden_target_reacher --gym-packages examples.experiments
    sb3-htr experiment sparse_half_cheetah_velocity --gym-packages examples.experiments
    sb3-htr experiment ant_goal --gym-packages examples.experiments
    sb3-htr experiment ant_goal_disc --gym-packages examples.experiments
    sb3-htr experiment four_corners --gym-packages examples.experiments
    sb3-htr experiment half_cheetah_velocity --gym-packages examples.experiments
    sb3-htr experiment dense_context --gym-packages examples.experiments
    sb3-htr experiment turned_controls --gym-packages examples.experiments

All settings are the defaults, those of SparseAnt-v0 on both ants, but for the last three, in which nothing is relabelled and
which explore by PEARL's own prior, and for the variants of ant_goal that say so.
"""

from examples import (  # noqa: F401 register the envs
    ant_goal_disc,
    dense_point_robot,
    four_corners,
    half_cheetah_velocity,
    hidden_target_reacher,
    sparse_half_cheetah_velocity,
    turned_controls,
    two_link_arm,
)
from sb3_htr.experiments.grid import BELIEF, EXPERIMENTS, Experiment, Variant, by
from sb3_htr.experiments.tuned import TUNED_DENSE, TUNED_HIPI

HTR = (Variant("htr-ser"),)
RIVALS = (*HTR, Variant("htr-hfr"), Variant("htr-hipi"))
# HFR's ant: a goal is reached from further away. TWO: with contexts of the latest collection alone, docs/trials.md
WIDE = {"goal_radius": 0.8}
TWO = {"context_episodes": 2}
ANT_GOAL = (
    *(
        variant
        for rival in RIVALS
        for variant in (
            Variant(rival.method, env_kwargs=WIDE),
            Variant(rival.method, f"{rival.method}-two", {"replay_buffer_kwargs": TWO}, WIDE),
        )
    ),
    # Of what a search found on the Point Robot, that which no time limit and no robot asks for
    Variant(
        "htr-hipi",
        "htr-hipi-two, tuned K and temperature",
        {"replay_buffer_kwargs": {**TUNED_HIPI["replay_buffer_kwargs"], **TWO}},
        WIDE,
    ),
)

for name, env_id, n_timesteps, n_episodes, variants in (
    ("two_link_arm", "TwoLinkArm-v0", 200_000, 20, HTR),
    ("hidden_target_reacher", "HiddenTargetReacher-v0", 150_000, 20, HTR),
    # The families of HFR, with HFR and what it was compared with; and that of HyperX
    ("sparse_half_cheetah_velocity", "SparseHalfCheetahVelocity-v0", 1_000_000, 20, RIVALS),
    ("ant_goal", "SparseAnt-v0", 600_000, 20, ANT_GOAL),
    ("four_corners", "FourCorners-v0", 150_000, 20, RIVALS),
    ("ant_goal_disc", "AntGoalDisc-v0", 600_000, 6, (Variant("htr-ser", settings={"ent_coef": 0.05}),)),
):
    EXPERIMENTS[name] = Experiment(
        name,
        "An example's family.",
        env_id,
        n_timesteps,
        variants,
        eval_freq=n_timesteps // 4,
        evaluations=by(BELIEF),
        n_episodes=n_episodes,
    )

# PEARL's own benchmark, by its protocol: the third episode counts
EXPERIMENTS["half_cheetah_velocity"] = Experiment(
    "half_cheetah_velocity",
    "Plain PEARL on one of its own families, whose rewards are dense.",
    "HalfCheetahVelocity-v0",
    1_000_000,
    (Variant("pearl-sparse-prior", "pearl", {"n_envs": 10, **half_cheetah_velocity.SETTINGS}),),
    eval_freq=100_000,
    evaluations=by(("prior",)),
    n_episodes=3,
)

# One episode of the prior: its rewards tell the goal
FIRST = {"name": "prior", "n_exploration_episodes": 1}
# The best of 50 trials of `sb3-htr optimize`, as those of the dense proxy with sparse contexts; docs/rivals.md has the command
TUNED_DENSE_CONTEXT = {
    "learning_rate": "lin_0.002459",
    "gamma": 0.98367,
    "n_steps": 3,
    "tau": 0.002978,
    "ent_coef": 0.004087,
    "kl_coef": 0.03463,
    "gradient_steps": 512,
    "policy_kwargs": {"latent_dim": 3},
}
# With the budget of the tuned proxy, and with the settings that were searched for sparse contexts, too
EXPERIMENTS["dense_context"] = Experiment(
    "dense_context",
    "PEARL whose contexts have the dense proxy reward too, in training and at meta-test.",
    "DensePointRobot-v0",
    450_000,
    tuple(
        Variant("pearl-sparse-prior", name, {**tuned, "explorer": FIRST, "train_explorer": FIRST})
        for name, tuned in (
            ("pearl, dense context, tuned", TUNED_DENSE_CONTEXT),
            ("pearl, dense context", TUNED_DENSE),
        )
    ),
    eval_freq=50_000,
    evaluations=by(("prior",)),
)

# Tasks that change the dynamics: how much o' in contexts helps, with sparse rewards and with dense ones
EXPERIMENTS["turned_controls"] = Experiment(
    "turned_controls",
    "Plain PEARL where tasks change the dynamics, with and without the next observation in contexts.",
    "TurnedControls-v0",
    100_000,
    tuple(
        Variant(
            "pearl-sparse-prior",
            f"{reward_type} rewards, {'o, a, r, next o' if use_next_obs else 'o, a, r'}",
            {"explorer": FIRST, "train_explorer": FIRST, "policy_kwargs": {"use_next_obs_in_context": use_next_obs}},
            {"reward_type": reward_type},
        )
        for reward_type in ("sparse", "dense")
        for use_next_obs in (True, False)
    ),
    eval_freq=10_000,
    evaluations=by(("prior",)),
    n_episodes=3,
)
