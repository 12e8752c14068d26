"""The reliability diagram compares what the reward model says with what happened."""

from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from helpers import ENV_ID
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr import PEARL
from sb3_htr.common.type_aliases import Context
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.experiments import calibration as calibration_module
from sb3_htr.experiments import protocol
from sb3_htr.experiments.calibration import N_BINS, calibration, expected_calibration_error
from sb3_htr.experiments.grid import Experiment, Variant
from sb3_htr.rivals.scripted import ScriptedAgent


@pytest.fixture
def model() -> PEARL:
    """It moves, and knows nothing."""
    return PEARL("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [8]}, seed=0)


def test_probabilities_are_compared_with_what_happened(model: PEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    """Goals are so near that their discs overlap at the start: some states solve some tasks."""
    near = {"goal_distance": 0.15, "n_validation_tasks": 6}
    n, probability, successes = (bins := calibration(model, ENV_ID, near, 3)).T
    n_solved = n.sum() / (6 * 3 * 20)
    assert n_solved in range(1, 7) and 0 < successes.sum() < n.sum() and (successes <= n).all()
    edges = np.linspace(0, 1, N_BINS + 1)
    assert (probability >= edges[:-1] * n).all() and (probability <= edges[1:] * n).all()

    def know_nothing(states: th.Tensor, tasks: th.Tensor) -> th.Tensor:
        return th.zeros(*states.shape[:-1], len(tasks))

    monkeypatch.setattr(model.policy.reward_model, "success_logits", know_nothing)
    half = calibration(model, ENV_ID, near, 3)
    assert half[N_BINS // 2].tolist() == [n.sum(), n.sum() / 2, successes.sum()] and half.sum() == half[N_BINS // 2].sum()
    assert expected_calibration_error(half) == pytest.approx(abs(0.5 - successes.sum() / n.sum()))
    assert expected_calibration_error(bins) == pytest.approx(np.abs(probability - successes).sum() / n.sum())


def test_a_success_may_be_worth_0_and_all_else_less(model: PEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    family = {"goal_distance": 0.5, "n_validation_tasks": 6}

    def pairs_and_successes() -> list[float]:
        walk = ScriptedAgent(make_task_vec_env(ENV_ID).action_space)
        monkeypatch.setattr(model, "start_adaptation", walk.start_adaptation)
        return calibration(model, ENV_ID, family, 20)[:, [0, 2]].sum(axis=0).tolist()

    expected, step = pairs_and_successes(), PointRobotDynamics.step
    assert min(expected) > 0

    def paid(self: Any, actions: Any) -> Any:
        states, rewards, terminated = step(self, actions)
        return states, rewards - 1, terminated

    monkeypatch.setattr(PointRobotDynamics, "step", paid)
    assert pairs_and_successes() == expected


def test_the_context_of_a_task_is_that_of_its_adaptation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step that solved it is in it, though others of the episode are left out."""
    model = PEARL("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [8]}, context_size=2, seed=0)
    infer, seen = model.policy.infer, list[Context]()

    def watched(context: Context) -> Any:
        seen.append(context)
        return infer(context)

    monkeypatch.setattr(model.policy, "infer", watched)
    bins = calibration(model, ENV_ID, {"goal_distance": 0.15, "n_validation_tasks": 6}, 3)
    # After those of the adaptation, one of each task that was solved
    n_solved = round(bins[:, 0].sum() / (6 * 3 * 20))
    assert n_solved and all(context.rewards.max() > 0 for context in seen[-n_solved:])
    for context in seen[-n_solved:]:
        np.testing.assert_allclose(context.next_observations, context.observations + 0.1 * context.actions, atol=1e-6)


@pytest.mark.parametrize("module", [calibration_module, protocol])
def test_no_env_stays_open(module: ModuleType, model: PEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    made, closed = list[VecEnv](), list[VecEnv]()

    def noting(*args: Any, **kwargs: Any) -> VecEnv:
        made.append(make_task_vec_env(*args, **kwargs))
        monkeypatch.setattr(made[-1], "close", partial(closed.append, made[-1]))
        return made[-1]

    monkeypatch.setattr(module, "make_task_vec_env", noting)
    few = {"n_validation_tasks": 2, "n_test_tasks": 2}
    (cell,) = Experiment("toy", "", ENV_ID, 1000, (Variant("htr-ser", env_kwargs=few),), 1, n_episodes=1).cells()
    protocol.evaluate(cell, model, None, lambda name, make: make())
    assert made and len(closed) == len(made)


def test_a_model_that_solves_nothing_has_no_diagram(model: PEARL) -> None:
    bins = calibration(model, ENV_ID, {"goal_distance": 9.0}, 1)
    assert not bins.any() and np.isnan(expected_calibration_error(bins))
