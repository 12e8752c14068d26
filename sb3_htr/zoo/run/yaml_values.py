"""Values of YAML files that rl_zoo3 would evaluate as Python, read as data instead: files come from strangers."""

import ast
from typing import Any

from rl_zoo3.utils import get_class_by_name

from sb3_htr.htr import MultiTaskReplayBuffer

# Settings that may be a string in rl_zoo3, and then are Python
EVALUATED = ("policy_kwargs", "replay_buffer_kwargs", "monitor_kwargs")
BUFFERS = {"MultiTaskReplayBuffer": MultiTaskReplayBuffer}


def without_code(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: of a YAML file
    :return: the same, with strings that rl_zoo3 would evaluate replaced by what they say
    :raises ValueError: for a string that is no plain value, and for an unknown replay buffer
    """
    hyperparams = dict(hyperparams)
    for key in EVALUATED:
        if isinstance(hyperparams.get(key), str):
            try:
                hyperparams[key] = ast.literal_eval(hyperparams[key])
            except (ValueError, SyntaxError):
                raise ValueError(
                    f"{key} is {hyperparams[key]!r}, which is code: write it as YAML, for example {key}: {{name: value}}."
                ) from None
    name = hyperparams.get("replay_buffer_class")
    if isinstance(name, str):
        if name in BUFFERS:
            hyperparams["replay_buffer_class"] = BUFFERS[name]
        elif all(part.isidentifier() for part in name.split(".")) and "." in name:
            hyperparams["replay_buffer_class"] = get_class_by_name(name)
        else:
            raise ValueError(f"replay_buffer_class is {name!r}, expected one of {sorted(BUFFERS)} or package.module.Class.")
    return hyperparams
