"""Models of unknown origin."""

import inspect
import io
import json
import os
import pickle
import zipfile
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_htr.pearl.pearl import PEARL

# Arguments of PEARL that a file of unknown origin may set: numbers and names, no classes
POLICY_KWARGS = ("latent_dim", "net_arch", "encoder_arch", "normalize_observations")
EXPLORERS = ("explorer", "train_explorer")


def load_untrusted(
    path: str | os.PathLike[str], env: GymEnv | str, device: th.device | str = "auto", **kwargs: Any
) -> "PEARL":
    """
    Load a model of unknown origin: weights and plain settings, without running code of the file.

    SB3's ``load`` unpickles what is no plain JSON in the file, and a pickle can run anything. This function reads the numbers
    and names among the settings, makes a new model with them and fills in the weights. Schedules, classes and optimizers are
    left out.

    :param path: file of ``PEARL.save``
    :param env: env of the same spaces; its spaces are not read from the file
    :param device: torch device
    :param kwargs: arguments of PEARL, in place of those of the file
    :return: a model to predict, adapt and evaluate with
    :raises ValueError: if it is no such file, or its weights do not fit
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
            weights, knowledge = (
                th.load(io.BytesIO(archive.read(f"{name}.pth")), map_location="cpu", weights_only=True)
                for name in ("policy", "knowledge")
            )
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError, pickle.UnpicklingError):
        raise ValueError(f"{path} is damaged, or no model saved by PEARL: nothing of it was loaded.") from None
    arguments = set(inspect.signature(PEARL.__init__).parameters) - {"policy", "env", "device", "tensorboard_log"}
    settings = {name: data[name] for name in arguments & data.keys() if isinstance(data[name], int | float | str)}
    # Of an object, SB3 writes its plain attributes beside the pickle
    for name in EXPLORERS:
        explorer = data.get(name)
        plain = isinstance(explorer, dict)
        settings[name] = {key: explorer[key] for key in explorer if not key.startswith(":")} if plain else explorer
    given = data.get("policy_kwargs", {})
    settings["policy_kwargs"] = {name: given[name] for name in POLICY_KWARGS if name in given}
    model = PEARL("MlpPolicy", env, device=device, **{**settings, **kwargs})
    try:
        model.policy.load_state_dict(weights)
        model.knowledge.load_state_dict(knowledge)
    except RuntimeError as error:
        raise ValueError(
            f"The weights in {path} do not fit the env or the settings: {str(error).splitlines()[1].strip()}"
        ) from None
    return model
