"""A training that goes on from a checkpoint is the one that was never interrupted."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import Logger

from helpers import ENV_ID
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.sac_her import SACHER

# Env steps of a rollout
ROLLOUT = 2 * 40


def rl2(**policy_kwargs: Any) -> RL2:
    nets = {"lstm_hidden_size": 4, "net_arch": [4], **policy_kwargs}
    env = make_task_vec_env(ENV_ID, 2, seed=0)
    return RL2("MlpLstmPolicy", env, 2, n_trials_per_rollout=1, n_epochs=1, seed=0, policy_kwargs=nets)


def rl2_on_one_scale() -> RL2:
    return rl2(normalize_observations=True)


def sac_her(learning_starts: int = 0) -> SACHER:
    env = make_task_vec_env(ENV_ID, 4, seed=0)
    # The buffer is full and begins anew within the run
    nets = {"net_arch": [4]}
    return SACHER("MultiInputPolicy", env, 2, seed=0, policy_kwargs=nets, learning_starts=learning_starts, buffer_size=200)


def with_random_actions() -> SACHER:
    return sac_her(3 * ROLLOUT)


@pytest.mark.parametrize("make", [rl2, rl2_on_one_scale, sac_her, with_random_actions])
def test_it_goes_on_exactly(make: Callable[[], Any]) -> None:
    # One at a time: they share the global generators
    unbroken = make().learn(4 * ROLLOUT)
    state = copy.deepcopy(make().learn(2 * ROLLOUT).state_dict())
    second = make()
    second.load_state_dict(state)
    second.learn(2 * ROLLOUT, reset_num_timesteps=False)
    assert second.num_timesteps == unbroken.num_timesteps and second._n_updates == unbroken._n_updates
    for name, value in unbroken.policy.state_dict().items():
        assert th.equal(value, second.policy.state_dict()[name]), name


@pytest.mark.parametrize("make", [rl2_on_one_scale, sac_her])
def test_what_came_after_a_state_is_forgotten_with_it(make: Callable[[], Any]) -> None:
    used = make().learn(ROLLOUT)
    state = used.state_dict()
    used.learn(3 * ROLLOUT, reset_num_timesteps=False)
    weights = []
    for model in (used, make()):
        model.load_state_dict(state)
        model.learn(2 * ROLLOUT, reset_num_timesteps=False)
        weights.append(model.policy.state_dict())
    for name, value in weights[0].items():
        assert th.equal(value, weights[1][name]), name


@pytest.mark.parametrize("make", [rl2, sac_her])
def test_it_logs_the_rollouts_that_it_would_have_logged(make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[int] = []
    monkeypatch.setattr(Logger, "dump", lambda logger, step=0: logged.append(step))
    for parts in ((6,), (2, 4)):
        logged.append(0)
        model = make()
        for i, n_rollouts in enumerate(parts):
            model.learn(n_rollouts * ROLLOUT, log_interval=3, reset_num_timesteps=i == 0)
    assert logged == [0, 3 * ROLLOUT, 6 * ROLLOUT] * 2


@pytest.mark.parametrize("make", [rl2, sac_her])
def test_a_deep_copy_has_an_env_of_its_own_with_all_wrappers(make: Callable[[], Any]) -> None:
    model = make()
    twin = copy.deepcopy(model)
    assert type(twin.env) is type(model.env) and twin.env is not model.env
    np.testing.assert_equal(twin.env.reset(), model.env.reset())
