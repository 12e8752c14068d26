"""Agents that are adapted to one task: saved, and loaded without the model."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn

from helpers import ENV_ID, MakePEARL, with_policy
from helpers.bombs import bombs
from helpers.envs import Rescaled
from sb3_htr import AdaptedAgent
from sb3_htr.adaptation import Step
from sb3_htr.common.random_state import seeded_actions

pytestmark = pytest.mark.filterwarnings("ignore:No reward was found")


@pytest.mark.parametrize(
    ("settings", "wrap"),
    [({}, None), ({"normalize_observations": True, "net_arch": [12, 8], "activation_fn": nn.Tanh}, None), ({}, Rescaled)],
)
def test_a_saved_agent_acts_as_it_did(settings: dict[str, Any], wrap: Any, tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    env = gym.make(ENV_ID)
    env = env if wrap is None else wrap(env)
    model = tiny_pearl(env, policy_kwargs=with_policy(**settings), n_tasks_per_rollout=2).learn(240)
    agent = model.adapt(env, n_episodes=2, task=0)
    agent.save(tmp_path / "agent")
    assert [path.name for path in tmp_path.iterdir()] == ["agent.pt"] and (tmp_path / "agent.pt").stat().st_size < 20_000
    loaded = AdaptedAgent.load(tmp_path / "agent")
    rng = np.random.default_rng(0)
    for obs in (rng.normal(size=2).astype(np.float32), rng.normal(size=(100, 2)).astype(np.float32)):
        ours, theirs = (each.predict(obs, deterministic=True)[0] for each in (loaded, agent))
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype
        th.manual_seed(0)
        samples = [loaded.predict(obs)[0] for _ in range(2)]
        assert (samples[0] != samples[1]).any()
    np.testing.assert_array_equal(loaded.returns, agent.returns)
    np.testing.assert_array_equal(loaded.successes, agent.successes)
    scores = [evaluate_policy(each, env, n_eval_episodes=2, warn=False) for each in (loaded, agent)]
    assert scores[0] == scores[1]
    loaded.save(tmp_path / "again.pt")
    again = AdaptedAgent.load(tmp_path / "again.pt")
    np.testing.assert_array_equal(again.predict(obs, deterministic=True)[0], theirs)


def test_an_agent_is_loaded_to_a_device_that_there_is(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().adapt(gym.make(ENV_ID), n_episodes=1).save(tmp_path / "agent")
    with pytest.raises(ValueError, match="The device 'gpu' cannot be used: give cpu, cuda or cuda:N"):
        AdaptedAgent.load(tmp_path / "agent", "gpu")
    if not th.cuda.is_available():
        with pytest.warns(UserWarning, match="There is no cuda that torch could use: cpu is used") as caught:
            AdaptedAgent.load(tmp_path / "agent", "cuda")
        assert caught[0].filename == __file__


def test_an_actor_of_ones_own_is_refused(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    agent = tiny_pearl(policy_kwargs=with_policy(activation_fn=nn.Softsign)).adapt(gym.make(ENV_ID), n_episodes=1)
    with pytest.raises(ValueError, match=r"Only SB3's Actor with one of the activations ReLU, .* can be saved alone"):
        agent.save(tmp_path / "agent")
    assert not list(tmp_path.iterdir())


def change(state: dict[str, Any], *path: str, value: Any) -> dict[str, Any]:
    """The same with something else in one place."""
    first, *rest = path
    return {**state, first: change(state[first], *rest, value=value) if rest else value}


HUGE = th.zeros(()).expand(10**6, 10**6)
BOX = {"low": th.zeros(2, 2), "high": th.ones(2, 2)}


def test_agents_of_strangers_run_nothing_and_take_no_memory(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    path = tmp_path / "agent.pt"
    tiny_pearl().adapt(gym.make(ENV_ID), n_episodes=1).save(path)
    good = path.read_bytes()
    state = th.load(path, weights_only=True)
    hostile: list[Any] = [
        [],
        {},
        change(state, "format", value=2),
        change(state, "z", value=th.zeros(())),
        change(state, "z", value=th.zeros(10**6)),
        change(state, "z", value=HUGE),
        change(state, "returns", value="evil"),
        change(state, "policy", value=None),
        change(state, "policy", "activation", value="Transformer"),
        change(state, "policy", "observation_space", value=BOX),
        change(state, "policy", "action_space", value={}),
        change(state, "policy", "normalizer", value={}),
        change(state, "policy", "actor", value={"latent_pi.evil.weight": th.zeros(1)}),
        change(state, "policy", "actor", "latent_pi.0.weight", value=HUGE),
        change(state, "policy", "actor", "latent_pi.0.weight", value=th.zeros(10**6)),
        change(state, "policy", "actor", "latent_pi.2.weight", value=th.zeros(10**6)),
        change(state, "policy", "actor", "mu.bias", value=3),
    ]
    contents = [good[: len(good) // 2], b"", *bombs(tmp_path / "fuse")]
    for i, content in enumerate([*hostile, *contents]):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            th.save(content, path)
        with pytest.raises(ValueError, match=r"agent\.pt is damaged, or no agent saved by AdaptedAgent\.save"):
            AdaptedAgent.load(path)
            raise AssertionError(f"file {i} was taken")
    assert not (tmp_path / "fuse").exists()
    with pytest.raises(FileNotFoundError):
        AdaptedAgent.load(tmp_path / "absent")


def test_sampled_actions_of_an_adaptation_are_those_of_its_seed(tiny_pearl: MakePEARL) -> None:
    """And training does not notice."""
    model, env = tiny_pearl(), gym.make(ENV_ID)
    state = th.get_rng_state()
    actions: list[list[np.ndarray]] = []

    class Watched(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            actions[-1].append(action)
            return self.env.step(action)

    for seed in (0, 0, 1):
        actions.append([])
        model.adapt(Watched(env), n_episodes=2, task=0, deterministic=False, seed=seed)
    np.testing.assert_array_equal(actions[0], actions[1])
    assert (np.array(actions[0]) != np.array(actions[2])).any()
    # Nor are they the numbers that z is drawn by
    with seeded_actions(3, deterministic=False):
        assert not set(th.randn(20).tolist()) & set(th.randn(20, generator=th.Generator().manual_seed(3)).tolist())
    assert th.equal(state, th.get_rng_state())


def test_agents_of_one_model_act_side_by_side(tiny_pearl: MakePEARL) -> None:
    """Each thread's robot has a task of its own, and all share the networks."""
    policy = tiny_pearl().policy
    agents = [AdaptedAgent(policy, z, np.zeros(0), np.zeros(0, dtype=bool)) for z in np.eye(3, dtype=np.float32) * 5]
    obs = np.ones(2, dtype=np.float32)
    alone = [agent.predict(obs, deterministic=True)[0] for agent in agents]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as threads:
            actions = threads.map(lambda agent: [agent.predict(obs, deterministic=True)[0] for _ in range(200)], agents)
            for expected, found in zip(alone, actions, strict=True):
                np.testing.assert_array_equal(found, np.broadcast_to(expected, (200, 2)))
    finally:
        sys.setswitchinterval(interval)


def test_an_agent_stays_as_it_is_when_the_adaptation_goes_on(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    adaptation = model.start_adaptation(2, explorer="prior")
    agent = AdaptedAgent(model.policy, adaptation.explorer.final_z()[0], np.zeros(0), np.zeros(0, dtype=bool))
    before, obs = agent.z.copy(), np.zeros((2, 2), dtype=np.float32)
    adaptation.observe(Step(obs, obs, [0.0, 0.0], obs, [True, True]))  # type: ignore[arg-type]
    assert (adaptation.z[0] != before).any()
    np.testing.assert_array_equal(agent.z, before)
