"""Says what is wrong where YAML makes of a setting something else than was meant."""

from typing import Any

from sb3_htr.common.settings import plain

# Of these rl_zoo3 makes a schedule, which may fall over a training: "lin_0.001"
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")
# These it evaluates as Python if they are texts, which files need --trust for
MAY_BE_TEXT = ("policy_kwargs",)


def checked_kinds(hyperparams: dict[str, Any], file: object) -> dict[str, Any]:
    """
    :param hyperparams: settings
    :param file: where they come from, for messages
    :return: the same, without keywords that are left empty
    :raises ValueError: for what was to be a number, as the text that 1e-3 is to YAML, and for keywords that are none
    """
    for name, value in hyperparams.items():
        is_text = isinstance(value, str)
        if name.endswith("kwargs") and not isinstance(value, dict | None) and not (is_text and name in MAY_BE_TEXT):
            raise ValueError(f"{name} is {value!r} ({file}), expected names and values.")
        if is_text and (name == "n_timesteps" or (name in SCHEDULES and not _is_linear(value))):
            advice = "leave the quotes out" if file == "-params" else "in YAML, 1.0e-3 is one, and 1e-3 is not"
            raise ValueError(f"{name} is the text {value!r} ({file}), expected a number: {advice}.")
        if name in SCHEDULES and not is_text and type(plain(value)) not in (int, float):
            raise ValueError(f"{name} is {value!r} ({file}), expected a number, or a text such as 'lin_0.001'.")
    return {name: value for name, value in hyperparams.items() if value is not None or not name.endswith("kwargs")}


def _is_linear(text: str) -> bool:
    try:
        float(text.removeprefix("lin_"))
    except ValueError:
        return False
    return text.startswith("lin_")
