"""Hyperparameters that ``sb3-htr optimize`` searches through."""

from typing import TYPE_CHECKING, Any

from sb3_htr.htr import HindsightTaskStrategy

if TYPE_CHECKING:
    import optuna

# As in rl_zoo3, layers are sampled by name
NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "paper": [300, 300, 300]}
# HTR paper, A.2
RELABEL_PROBABILITIES = (0.1, 0.3, 0.5, 0.8, 1.0)
STRATEGIES = [strategy.value for strategy in HindsightTaskStrategy]
ENCODER_ARCHS = {"small": [64, 64], "medium": [128, 128], "paper": [200, 200, 200]}


def sample_pearl_params(trial: "optuna.Trial", relabels: bool = True, chooses_states: bool = True) -> dict[str, Any]:
    """
    :param trial: draws the values
    :param relabels: whether the method relabels; how often it does is sampled then
    :param chooses_states: whether its hindsight tasks are states that an episode reached; which ones is sampled then
    :return: arguments of PEARL
    """
    params: dict[str, Any] = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        # Episodes have some tens to hundreds of steps
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.005, 0.2, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.05, log=True),
        "ent_coef": trial.suggest_float("ent_coef", 1e-3, 1e-1, log=True),
        "kl_coef": trial.suggest_float("kl_coef", 1e-4, 1e-1, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 3, 8),
        "meta_batch_size_pow": trial.suggest_int("meta_batch_size_pow", 3, 6),
        "gradient_steps_pow": trial.suggest_int("gradient_steps_pow", 6, 9),
        "latent_dim": trial.suggest_int("latent_dim", 2, 8),
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
        "encoder_arch": trial.suggest_categorical("encoder_arch", list(ENCODER_ARCHS)),
    }
    if relabels:
        params["relabel_probability"] = trial.suggest_categorical("relabel_probability", RELABEL_PROBABILITIES)
    if relabels and chooses_states:
        params["hindsight_task_strategy"] = trial.suggest_categorical("hindsight_task_strategy", STRATEGIES)
    return convert_pearl_params(params)


def convert_pearl_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: of a trial
    :return: arguments of PEARL
    """
    params = dict(sampled_params)
    converted: dict[str, Any] = {"gamma": 1 - params.pop("one_minus_gamma")}
    for name in ("batch_size", "meta_batch_size", "gradient_steps"):
        converted[name] = 2 ** params.pop(f"{name}_pow")
    converted["policy_kwargs"] = {
        "latent_dim": params.pop("latent_dim"),
        "net_arch": NET_ARCHS[params.pop("net_arch")],
        "encoder_arch": ENCODER_ARCHS[params.pop("encoder_arch")],
    }
    if "relabel_probability" in params:
        converted["replay_buffer_kwargs"] = {"relabel_probability": params.pop("relabel_probability")}
    if "hindsight_task_strategy" in params:
        converted["replay_buffer_kwargs"]["relabeller"] = {"hindsight_task_strategy": params.pop("hindsight_task_strategy")}
    return {**converted, **params}
