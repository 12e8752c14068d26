"""The progress bar moves during updates, and the time that it says remains is what remains."""

import copy
import time
from itertools import pairwise
from typing import Any

import pytest
from stable_baselines3.common.callbacks import ConvertCallback

from helpers import ROLLOUT, MakePEARL
from sb3_htr.common import progress
from sb3_htr.common.progress import MetaProgressBarCallback


class Clock:
    """Time passes when somebody says so."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Bar:
    """What tqdm is asked to show."""

    def __init__(self, **_: Any) -> None:
        self.n, self.total = 0.0, 0
        self.shown: list[tuple[float, float]] = []

    def update(self, n: float) -> None:
        self.n += n
        self.shown.append((clock.now, self.n))

    def refresh(self) -> None: ...

    def close(self) -> None: ...


clock = Clock()


@pytest.mark.parametrize(("of_step", "of_update"), [(0.001, 5.0), (0.5, 1.0), (0.2, 0.0)])
def test_progress_is_as_even_as_time(
    of_step: float, of_update: float, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In seconds for a step of the four envs, and for an update: where most of the time goes to updates, to both, to steps."""
    clock.now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", clock)
    callback, bar = MetaProgressBarCallback(), Bar()

    def start() -> None:
        callback.pbar = bar

    monkeypatch.setattr("stable_baselines3.common.callbacks.ProgressBarCallback._on_training_start", lambda _: start())
    monkeypatch.setattr("stable_baselines3.common.callbacks.ProgressBarCallback._on_training_end", lambda _: None)
    on_step = callback._on_step

    def step() -> bool:
        clock.now += of_step
        return on_step()

    def update() -> None:
        clock.now += of_update

    monkeypatch.setattr(callback, "_on_step", step)
    model = tiny_pearl(learning_starts=0, gradient_steps=10)
    model.update_listeners.append(update)
    model.learn(8 * 240, callback=callback)
    assert bar.n == 8 * 240, "as many as there were, at the end"
    shown = [n for _, n in bar.shown]
    assert all(later > before - 1e-6 for before, later in pairwise(shown)), "it never goes back"
    end = clock.now
    # What tqdm makes of it, once it has seen a quarter
    for now, n in bar.shown:
        if 0.25 * end < now < 0.9 * end:
            assert now / n * 8 * 240 - now == pytest.approx(end - now, rel=0.2), (now, n)
    assert max(later - before for (before, _), (later, _) in pairwise(bar.shown)) <= max(of_step, of_update) + 1e-9


def test_a_training_after_one_that_was_interrupted_in_its_first_rollout(tiny_pearl: MakePEARL) -> None:
    """As in a notebook: SB3 does not end the bar then."""

    def interrupt(local: dict[str, Any], _: Any) -> bool:
        raise KeyboardInterrupt

    model = tiny_pearl()
    with pytest.raises(KeyboardInterrupt):
        model.learn(ROLLOUT, callback=interrupt, progress_bar=True)
    assert model.learn(ROLLOUT).num_timesteps == ROLLOUT


def test_a_training_that_was_interrupted_leaves_nothing_that_cannot_be_copied(tiny_pearl: MakePEARL) -> None:
    def fail(*_: Any) -> bool:
        raise RuntimeError

    model = tiny_pearl()
    with pytest.raises(RuntimeError):
        model.learn(ROLLOUT, fail, progress_bar=True)
    copy.deepcopy(model)


def test_a_clock_of_another_process_is_no_clock(tiny_pearl: MakePEARL) -> None:
    """As a checkpoint has it."""
    bar, shares = MetaProgressBarCallback(), []
    now = time.monotonic()
    bar._n_updates, bar._rollout_start, bar._rollout_end = 3, now + 100, now + 1000

    def look(local: dict[str, Any], _: Any) -> bool:
        shares.append(bar._share)
        return True

    tiny_pearl().learn(2 * ROLLOUT, [bar, ConvertCallback(look)])
    assert 0 <= min(shares) <= max(shares) <= 1
