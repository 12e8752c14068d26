"""Objects by name, by name and settings, or as they are."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from sb3_htr.adaptation import Aggregate, Belief, Explorer, Prior
from sb3_htr.adaptation.explorers import EXPLORERS, to_explorer
from sb3_htr.common.settings import check_numbers, make, name_of
from sb3_htr.htr import Relabeller
from sb3_htr.htr.relabel import RELABELLERS

Kinds = Mapping[str, Callable[..., Any]]


def test_a_name_a_name_with_settings_and_an_object_are_the_same() -> None:
    own = Belief(margin=2.0)
    assert to_explorer(own) is own
    assert to_explorer("belief") == Belief() and to_explorer({"name": "belief", "margin": 2}) == own
    assert to_explorer({"name": "prior", "n_exploration_episodes": 9}) == Prior(9)
    assert type(to_explorer("aggregate")) is Aggregate
    assert name_of("belief") == name_of({"name": "belief", "margin": 2}) == "belief"
    assert name_of({"margin": 2}) is None and name_of(own) is own


@pytest.mark.parametrize(
    ("what", "kinds", "base"), [("explorer", EXPLORERS, Explorer), ("relabeller", RELABELLERS, Relabeller)]
)
@pytest.mark.parametrize(
    "value", ["nobody", {}, {"name": "nobody"}, {"name": None}, {"scale": 1}, None, 3, [], Belief, {3: 4}]
)
def test_anything_else_is_answered_with_what_there_is(what: str, kinds: Kinds, base: Any, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{what} is .*, expected one of .*object derived from {base.__name__}") as error:
        make(what, value, kinds, base)
    assert all(name in str(error.value) for name in kinds) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kinds", "base", "settings", "message"),
    [
        (EXPLORERS, Explorer, {"name": "aggregate", "max_setback": 2}, "'max_setback': did you mean max_setbacks"),
        (EXPLORERS, Explorer, {"name": "prior", "scale": 2}, "'prior' has no setting 'scale': expected one of"),
        (EXPLORERS, Explorer, {"name": "prior", 3: 4}, "'prior' has no setting 3: expected one of"),
        (EXPLORERS, Explorer, {"name": "aggregate", "scale": -1}, "scale is -1, expected a number of at least 0"),
        (EXPLORERS, Explorer, {"name": "aggregate", "clearly_better": 0.9}, "clearly_better is 0.9, expected a number of at"),
        (EXPLORERS, Explorer, {"name": "belief", "doubt": 0.6}, "doubt is 0.6, expected a number from 1e-06 to 0.5"),
        (EXPLORERS, Explorer, {"name": "learned-prior", "temperature": 2}, "temperature is 2, expected a number from 0 to 1"),
        (EXPLORERS, Explorer, {"name": "aggregate", "max_setbacks": 1.5}, "max_setbacks is 1.5, expected a whole number"),
        (EXPLORERS, Explorer, {"name": "prior", "n_exploration_episodes": -1}, "n_exploration_episodes is -1"),
        (RELABELLERS, Relabeller, {"name": "EpisodeClustering", "cellsize": 1}, "'cellsize': did you mean cell_size"),
        (RELABELLERS, Relabeller, {"name": "EpisodeClustering", "self": 1}, "no setting 'self'"),
    ],
)
def test_a_setting_that_cannot_be_is_named(kinds: Kinds, base: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make("it", settings, kinds, base)


def test_numbers_of_numpy_are_compared_as_numbers() -> None:
    check_numbers(rate=(np.float32(1e-3), 0.0), steps=(np.int32(3), 1))
    for value in (np.float32(np.nan), np.float32(-1), np.bool_(True), np.complex64(1)):
        with pytest.raises(ValueError, match=r"rate is .*, expected a number of at least 0"):
            check_numbers(rate=(value, 0.0))


def test_limits_are_told_in_full() -> None:
    with pytest.raises(ValueError, match=r"seed is 4294967296, expected a whole number from 0 to 4294967295\."):
        check_numbers(seed=(2**32, 0, 2**32 - 1))
    with pytest.raises(ValueError, match=r"doubt is 1, expected a number from 1e-06 to 0\.5\."):
        check_numbers(doubt=(1, 1e-6, 0.5))
