"""What is taken out is not there, and all else is."""

import numpy as np
import pytest
import torch as th

from helpers import ENV_ID
from helpers.adaptations import begin, know_tasks, play, walk
from sb3_htr import PEARL
from sb3_htr.experiments.ablations import (
    ABLATIONS,
    InTurn,
    NoInference,
    NoPosterior,
    NoValue,
    TrainingTasksAlone,
    UniformPrior,
)


@pytest.fixture
def model() -> PEARL:
    """Tasks 0 and 1 of a line are training tasks, 2 and 3 hindsight tasks; the first is by far the likeliest."""
    model = PEARL("MlpPolicy", ENV_ID, policy_kwargs={"latent_dim": 3, "net_arch": [16]}, seed=0)
    know_tasks(model)
    model.knowledge.is_train[2:4] = False
    model.knowledge.log_prior[:4] = th.tensor([0.0, -3.0, -6.0, -9.0])
    return model


def places(model: PEARL, explorer: object, task: float = 3.0) -> list[float]:
    """Where it goes in five episodes on a task."""
    return walk(begin(model, explorer), np.array([task]), 5)[0].ravel().tolist()


def test_the_parts_of_the_default_explorer(model: PEARL) -> None:
    assert 3 in places(model, "belief"), "a hindsight task is found"
    assert set(places(model, TrainingTasksAlone())) <= {0, 1}, "without particles of hindsight tasks it is not"
    assert set(places(model, NoInference())) == {0}, "without inference, the likeliest stays so"
    prior = begin(model, UniformPrior()).explorer
    assert isinstance(prior, UniformPrior) and prior.weights(np.arange(1)).tolist() == [[0.25] * 4]
    for name, explorer in ABLATIONS.items():
        assert 0 in places(model, explorer, 0.0), f"{name}: a training task is found"


def test_training_tasks_in_turn(model: PEARL) -> None:
    model.knowledge.is_train[2:4] = True
    assert places(model, InTurn(), 7.0)[::3] == [1, 3, 0, 2, 1], "the middle, then the furthest from all that were tried"
    assert places(model, InTurn(), 0.0)[::3] == [1, 3, 0, 0, 0], "what was rewarded is kept"


def test_without_the_posterior_the_encoder_has_no_word(model: PEARL) -> None:
    known = model.knowledge.z[:4].tolist()
    episodes = [[0.0], [5.0], [1.0], [1.0]]
    with_posterior, without = (play(begin(model, explorer), episodes) for explorer in ("belief", NoPosterior()))
    assert with_posterior[2][0].tolist() not in known, "its posterior mean is tried after the first reward"
    assert all(z[0].tolist() in known for z in without)


def test_without_values_it_does_not_matter_where_the_policy_gets(model: PEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model.policy, "values", lambda obs, z: (4 * z[..., 0]).exp())
    assert places(model, "belief", 7.0)[0] == 3, "the value of going there outweighs that it is unlikely"
    assert places(model, NoValue(), 7.0)[0] == 0
