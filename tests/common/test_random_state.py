"""Random generators, and what starts a GPU."""

import pytest
import torch as th

from sb3_htr.common.random_state import get_global_state, seeded_actions, set_global_state


@pytest.fixture
def idle_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two, which start when they are asked for their generators."""
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 2)
    for name in ("get_rng_state", "get_rng_state_all"):
        monkeypatch.setattr(th.cuda, name, lambda *_: pytest.fail("asks a GPU that nobody uses"))


@pytest.mark.usefixtures("idle_gpus")
def test_a_training_on_the_cpu_starts_no_gpu() -> None:
    state = get_global_state()
    assert state["cuda"] == []
    set_global_state(state)


@pytest.mark.usefixtures("idle_gpus")
@pytest.mark.filterwarnings("error")
def test_nor_does_an_evaluation_whose_actions_are_drawn() -> None:
    before = th.get_rng_state()
    draws = []
    for _ in range(2):
        with seeded_actions((3, 1), deterministic=False):
            draws.append(th.rand(2).tolist())
    assert draws[0] == draws[1]
    assert th.equal(th.get_rng_state(), before)
