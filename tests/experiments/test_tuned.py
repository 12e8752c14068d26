"""Settings that are said to be those of a search are."""

import csv
import pathlib
from typing import Any

import pytest

from examples import experiments
from sb3_htr.experiments import tuned
from sb3_htr.zoo.run import search_space

RESULTS = pathlib.Path(__file__).parents[2] / "results"
SEARCHES = [
    ("rivals/dense_search.csv", search_space.PEARL, tuned.TUNED_DENSE),
    ("rivals/hfr_search.csv", search_space.PEARL, tuned.TUNED_HFR),
    ("rivals/hipi_search.csv", search_space.PEARL, tuned.TUNED_HIPI),
    ("rivals/rl2_search.csv", search_space.RL2, tuned.TUNED_RL2),
    ("dense_context/search.csv", search_space.PEARL, experiments.TUNED_DENSE_CONTEXT),
]


@pytest.mark.parametrize(("file", "space", "settings"), SEARCHES, ids=[file for file, *_ in SEARCHES])
def test_settings_are_those_of_the_best_trial(file: str, space: search_space.SearchSpace, settings: dict[str, Any]) -> None:
    with open(RESULTS / file) as lines:
        trials = [trial for trial in csv.DictReader(lines) if trial["state"] == "COMPLETE"]
    best = max(trials, key=lambda trial: float(trial["value"]))
    sampled = {name.removeprefix("params_"): _value(text) for name, text in best.items() if name.startswith("params_")}
    expected = {name: pytest.approx(value, rel=1e-3) for name, value in _flat(space.convert(sampled)).items()}
    # What the time limit of the Point Robot asks for need not be said
    assert {"n_steps": 1} | _flat(settings) == {"n_steps": 1} | expected


def _value(text: str) -> Any:
    """A number of a CSV file, or a name."""
    try:
        return float(text) if "." in text else int(text)
    except ValueError:
        return text


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """All settings by their own names, as numbers or lists of numbers."""
    result: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            result |= _flat(value)
        else:
            result[name] = float(value.removeprefix("lin_")) if isinstance(value, str) else value
    return result
