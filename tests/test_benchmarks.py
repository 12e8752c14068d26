"""Benchmarks fit the code that they measure."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import ROLLOUT, MakePEARL

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("[a-z]*.py")))
def test_a_benchmark_can_be_imported(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    assert callable(importlib.import_module(name).main)


def test_the_profile_names_parts_that_are_called(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    model, called = tiny_pearl(), set()

    def noting(function: Callable[..., Any], where: str) -> Callable[..., Any]:
        def noted(*args: Any, **kwargs: Any) -> Any:
            called.add(where)
            return function(*args, **kwargs)

        return noted

    for where in importlib.import_module("profile_training").PARTS.values():
        *owners, attribute = where.split(".")
        owner: Any = model
        for part in owners:
            owner = getattr(owner, part)

        monkeypatch.setattr(owner, attribute, noting(getattr(owner, attribute), where))
    model.learn(2 * ROLLOUT)
    assert called == set(importlib.import_module("profile_training").PARTS.values())


def test_the_benchmark_of_rl2_has_both_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    benchmark, written = importlib.import_module("rl2"), []
    monkeypatch.setattr(
        benchmark, "by_turns", lambda durations: {name: np.array([each()]) for name, each in durations.items()}
    )
    monkeypatch.setattr(benchmark, "seconds", lambda function, n: function() or 1.0)
    monkeypatch.setattr(benchmark, "write", lambda name, figures: written.extend(figures))
    benchmark.main()
    assert [figure.ratio for figure in written] == [1.0]
