"""Models of unknown origin."""

import os
import re
import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import LinearSchedule

from sb3_htr.adaptation import explorers
from sb3_htr.common.checks import check_is_env, check_recorded_spaces, check_spaces
from sb3_htr.common.errors import OPEN_ERRORS, last_line
from sb3_htr.common.safe_load import Refused, read_model
from sb3_htr.common.saving import with_suffix
from sb3_htr.common.settings import LEARNT_ENT_COEF, keywords_of
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.encoder import ENCODERS
from sb3_htr.pearl.pearl import PEARL
from sb3_htr.pearl.policies import PEARLPolicy

# How large networks may be
MAX_LAYERS, MAX_UNITS = 16, 2**14
# How many steps of an episode the bank of tasks may keep
MAX_CONTEXT = 2**14
EXPLORERS = ("explorer", "train_explorer")
# Of an object, SB3 writes its plain attributes beside its type and its pickle
TYPE, PICKLED = ":type:", ":serialized:"
# How many transitions a replay buffer may have room for: it takes memory as they come, but for 8 bytes an episode
MAX_BUFFER = 2 * 10**7
# Arguments of PEARL that are numbers and take no memory, one that is a truth value, those that may be words, and counters
NUMBERS = (
    *("learning_rate", "learning_starts", "batch_size", "tau", "gamma", "gradient_steps", "ent_coef", "target_entropy"),
    *("target_update_interval", "meta_batch_size", "context_size", "n_steps"),
    *("kl_coef", "final_kl_coef", "reward_coef"),
    *("n_tasks_per_rollout", "n_episodes_per_task", "buffer_size"),
)
FLAG = "cuda_graph"
# Truth values among those of its policy, and what they are where a file says nothing of them
POLICY_FLAGS = {"normalize_observations": True, "use_next_obs_in_context": False}
WORDS = {"ent_coef": LEARNT_ENT_COEF, "target_entropy": "auto", "matmul_precision": "highest|high|medium"}
COUNTERS = ("num_timesteps", "_n_updates")
# Arguments of the replay buffer that are plain data
REPLAY = ("relabel_probability", "relabeller", "rl_reward_type", "context_episodes")


def load_untrusted(
    path: str | os.PathLike[str],
    env: GymEnv | str,
    device: th.device | str = "auto",
    model_class: type[PEARL] = PEARL,
    **kwargs: Any,
) -> PEARL:
    """
    Load a model of unknown origin: weights and plain settings, without running code of the file, and in as much memory as its
    weights take.

    SB3's ``load`` unpickles what is no plain JSON in the file, and a pickle can run anything. This function reads the sizes of
    the networks, the explorers, the relabeller and their settings, a linear schedule, and plain numbers and words; it makes a
    new model with them and fills in the weights. What only training needs is left at its default where it is no plain data:
    other schedules, a relabeller that is an object, a replay buffer of one's own. An entropy coefficient that is learnt begins
    anew.

    :param path: file of ``PEARL.save``
    :param env: env of a task family, as for a training, of the same spaces, which are compared with what the file says of
        them in words
    :param device: torch device
    :param model_class: what to make of it; what its constructor takes and PEARL's does not is at its default, or in ``kwargs``
    :param kwargs: arguments of PEARL, in place of those of the file
    :return: a model to predict, adapt and evaluate with
    :raises OSError: if there is no such file, or it cannot be opened
    :raises ValueError: if it is no such file, or its weights or spaces do not fit
    """
    model_class.check_names(kwargs)
    # As SB3's load does
    path = path if os.path.exists(path) else with_suffix(path, ".zip")
    try:
        _check_weights(model_class)
        data, weights = read_model(path, ("policy", "knowledge"))
        _check_is_ours("policy", data["policy_class"].get("__module__", ""))
        settings: dict[str, Any] = {name: _plain(name, data[name]) for name in EXPLORERS if name not in kwargs}
        settings |= {name: data[name] for name in NUMBERS if type(data.get(name)) in (int, float)}
        settings |= {FLAG: data[FLAG]} if type(data.get(FLAG)) is bool else {}
        # A schedule may be one that is read below; no other number is an object
        for name in [name for name in NUMBERS if isinstance(data.get(name), dict) and name != "learning_rate"]:
            warnings.warn(f"{name} is in {path} as no plain number, and is left at its default.", stacklevel=2)
        settings |= {name: data[name] for name, words in WORDS.items() if re.fullmatch(words, str(data.get(name)))}
        settings |= _schedule(data.get("learning_rate"))
        replay = data.get("replay_buffer_kwargs")
        replay = replay if isinstance(replay, dict) else {}
        if PICKLED in replay:
            replay = {}
            if "replay_buffer_kwargs" not in kwargs:
                warnings.warn(
                    f"replay_buffer_kwargs are in {path} as no plain data, and are left at their default: pass them.",
                    stacklevel=2,
                )
        settings["replay_buffer_kwargs"] = {name: replay[name] for name in REPLAY if name in replay}
        _check_memory(settings)
        counters = {name: data[name] for name in COUNTERS if type(data.get(name)) is int}
        settings["policy_kwargs"] = _policy_kwargs(data.get("policy_kwargs", {}))
    except (*OPEN_ERRORS, Warning):
        raise
    except Refused as error:
        raise ValueError(f"Nothing of {path} was loaded: {error}") from None
    except Exception:  # whatever a stranger can put into a file
        raise ValueError(f"{path} is damaged, or no model saved by PEARL: nothing of it was loaded.") from None
    if isinstance(env, str):
        env = make_task_vec_env(env)
    check_is_env(env)
    for name in ("policy_kwargs", "replay_buffer_kwargs"):
        kwargs[name] = {**settings.pop(name), **(kwargs.get(name) or {})}
    _check_shapes(path, weights["policy"], env, kwargs["policy_kwargs"])
    check_recorded_spaces(env, data)
    model = model_class("MlpPolicy", env, device=device, _init_setup_model=False, **{**settings, **kwargs})
    # Which settings follow from: where the env has others, that is warned of
    vars(model).update({name: data[name] for name in ("max_episode_steps", "n_rollout_tasks") if type(data.get(name)) is int})
    model._setup_model()
    try:
        model.policy.load_state_dict(weights["policy"])
        model.knowledge.load_state_dict(weights["knowledge"])
    except (RuntimeError, TypeError, AttributeError) as error:
        raise ValueError(f"The weights in {path} do not fit the env or the settings: {last_line(error)}") from None
    for name, value in counters.items():
        setattr(model, name, value)
    return model


def check_loadable(hyperparams: dict[str, Any], model_class: type[PEARL] = PEARL) -> None:
    """
    :param hyperparams: of a training to come, which looks itself at what PEARL does not know or take
    :param model_class: what is trained
    :raises Refused: for what PEARL takes, and no file of its model may have
    """
    _check_weights(model_class)
    given = hyperparams.get("policy_kwargs") or {}
    _check_policy_settings({name: value for name, value in given.items() if name in keywords_of(PEARLPolicy)})
    _check_memory(hyperparams)
    for name in EXPLORERS:
        if name in hyperparams:
            _check_explorer(name, str(type(explorers.to_explorer(hyperparams[name], name))))


def _check_weights(model_class: type[PEARL]) -> None:
    if model_class._get_torch_save_params is not PEARL._get_torch_save_params:
        raise Refused(
            f"its class {model_class.__name__} has weights that PEARL has not, which only {model_class.__name__}.load "
            "restores (on the command line, --trust), and that may run code of the file."
        )


def _check_is_ours(what: str, module: str, registered: str = "") -> None:
    """Of a class that is in ``module``, or that the user could have registered."""
    if not module.startswith("sb3_htr."):
        raise Refused(
            f"its {what} is a class of its own{registered}, which only PEARL.load restores (on the command line, --trust), "
            "and that may run code of the file."
        )


def _check_explorer(what: str, kind: str) -> None:
    """``kind`` is its class in words: one of this package, or one that the user has registered and a file only names."""
    if kind not in map(str, explorers.EXPLORERS.values()):
        registered = " that is not registered (sb3_htr.adaptation.register_explorer)"
        _check_is_ours(what, kind.removeprefix("<class '"), registered)


def _plain(what: str, explorer: dict[str, Any]) -> dict[str, Any]:
    _check_explorer(what, explorer.get(TYPE, ""))
    settings = {key: value for key, value in explorer.items() if key not in (TYPE, PICKLED)}
    name = settings.get("name")
    if not isinstance(name, str) or name not in explorers.EXPLORERS:
        return settings
    known = {"name", *keywords_of(explorers.EXPLORERS[name])}
    if unknown := sorted(settings.keys() - known):
        warnings.warn(f"Explorer {name!r} has no setting {unknown[0]!r:.60} in this version: it is left out.", stacklevel=3)
    return {key: value for key, value in settings.items() if key in known}


def _schedule(learning_rate: Any) -> dict[str, LinearSchedule]:
    """Of the kind that ``lin_...`` of YAML files is."""
    if not isinstance(learning_rate, dict) or learning_rate.get(TYPE) != str(LinearSchedule):
        return {}
    numbers = [learning_rate[name] for name in ("start", "end", "end_fraction")]
    if not all(type(number) in (int, float) for number in numbers):
        raise TypeError
    schedule = LinearSchedule(*numbers)
    if not all(np.isfinite(schedule(remaining)) for remaining in (1.0, 0.0)):
        raise ValueError
    return {"learning_rate": schedule}


def _check_memory(settings: dict[str, Any]) -> None:
    for name, most in (("context_size", MAX_CONTEXT), ("buffer_size", MAX_BUFFER)):
        if type(settings.get(name)) in (int, float) and settings[name] > most:
            raise Refused(f"PEARL has no {name} of {settings[name]} here: expected {most} at most.")


def _check_policy_settings(given: dict[str, Any]) -> set[str]:
    """
    :param given: settings of a policy
    :return: names of those that a file may have
    :raises Refused: if there are others
    """
    known = {"latent_dim", "net_arch", "encoder_arch", "n_critics", *POLICY_FLAGS}
    if given.get("encoder_class") in list(ENCODERS):
        known.add("encoder_class")
    # SB3 marks some with a colon; and what says how weights are learnt says nothing of those in a file
    unknown = [name for name in given if name not in (*known, "optimizer_kwargs") and not name.startswith(":")]
    if unknown:
        registered = " of no registered name (sb3_htr.pearl.register_encoder)" if unknown[0] == "encoder_class" else ""
        raise Refused(
            f"its policy has the setting {unknown[0]!r}{registered}, which only PEARL.load restores (on the command line, "
            "--trust), and that may run code of the file."
        )
    return known


def _policy_kwargs(given: dict[str, Any]) -> dict[str, Any]:
    known = _check_policy_settings(given)
    kwargs = {name: value for name, value in given.items() if name in known and value is not None}
    n_critics = kwargs.get("n_critics", 2)
    if type(n_critics) is not int or not 1 <= n_critics <= MAX_LAYERS:
        raise Refused(f"PEARL does not have {n_critics} critics here: expected from 1 to {MAX_LAYERS}.")
    arch = kwargs.get("net_arch", [])
    # SB3 takes one for actor and critics each, too
    parts = [*arch.values()] if isinstance(arch, dict) and arch.keys() == {"pi", "qf"} else [arch]
    for units in (*parts, kwargs.get("encoder_arch", []), [kwargs.get("latent_dim", 1)]):
        whole = isinstance(units, list) and all(type(unit) is int and 1 <= unit <= MAX_UNITS for unit in units)
        if not whole or len(units) > MAX_LAYERS:
            raise Refused(f"PEARL's networks do not have layers of {units} units.")
    return {**kwargs, **{name: bool(kwargs.get(name, default)) for name, default in POLICY_FLAGS.items()}}


def _check_shapes(path: str | os.PathLike[str], weights: dict[str, Any], env: GymEnv, policy_kwargs: dict[str, Any]) -> None:
    """Without memory for the weights."""
    check_spaces(env)
    assert isinstance(env.observation_space, spaces.Box) and isinstance(env.action_space, spaces.Box)
    with th.device("meta"):
        expected = PEARLPolicy(env.observation_space, env.action_space, lambda _: 0.0, **policy_kwargs).state_dict()
    for name in {**expected, **weights}:
        here, there = (getattr(tensors.get(name), "shape", None) for tensors in (expected, weights))
        if here != there:
            raise ValueError(
                f"The weights in {path} do not fit the env or the settings: {name} has shape {there and tuple(there)}, "
                f"expected {here and tuple(here)}."
            )
