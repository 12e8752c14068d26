"""Settings that searches found on the Point Robot, by `sb3-htr optimize`; docs/rivals.md has the commands."""

from sb3_htr.experiments.cell import KwArgs

# The best of 50 trials, 60,000 env steps each, on validation tasks
TUNED_DENSE: KwArgs = {
    "learning_rate": "lin_0.001897",
    "gamma": 0.91581,
    "tau": 0.01187,
    "ent_coef": 0.00881,
    "kl_coef": 0.000919,
    "gradient_steps": 512,
    "policy_kwargs": {"latent_dim": 6},
}

# The best of 33 and 39 trials, 60,000 env steps each, on validation tasks
TUNED_HFR: KwArgs = {
    "learning_rate": "lin_0.001646",
    "gamma": 0.96053,
    "tau": 0.01246,
    "ent_coef": 0.004592,
    "kl_coef": 0.08634,
    "n_steps": 7,
    "learning_starts": 2930,
    "gradient_steps": 512,
    "policy_kwargs": {"latent_dim": 5},
    "replay_buffer_kwargs": {"relabel_probability": 1.0, "relabeller": {"temperature": 0.07124}},
}
TUNED_HIPI: KwArgs = {
    "learning_rate": "lin_0.001222",
    "gamma": 0.94862,
    "tau": 0.02546,
    "ent_coef": 0.01549,
    "kl_coef": 0.003007,
    "n_steps": 3,
    "learning_starts": 3920,
    "gradient_steps": 512,
    "policy_kwargs": {"latent_dim": 7},
    "replay_buffer_kwargs": {"relabel_probability": 1.0, "relabeller": {"temperature": 0.6583}},
}

# The best of 50 trials, 200,000 env steps each, on validation tasks
TUNED_RL2: KwArgs = {
    "learning_rate": 0.000982,
    "gamma": 0.92779,
    "gae_lambda": 0.84538,
    "ent_coef": 0.000789,
    "max_grad_norm": 0.3711,
    "n_epochs": 18,
    "clip_range": 0.2,
    "policy_kwargs": {"lstm_hidden_size": 64, "net_arch": [64, 64]},
}
