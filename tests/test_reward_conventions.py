"""Rewards of -1 and 0 teach what those of 0 and 1 do: rewards are told by what they are more than the task-free part."""

from typing import Any

import numpy as np
import pytest
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from helpers import ROLLOUT, MakePEARL
from helpers.experience import filled
from htr_envs import DynamicsEnv, DynamicsVectorEnv, PointRobotFamily, check_task_env
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.vec_env import BatchedTaskVecEnv


class PaidDynamics(PointRobotDynamics):
    """Point robots to which each step brings something, whatever their task."""

    def __init__(self, num_envs: int, wage: float) -> None:
        super().__init__(num_envs)
        self.wage = wage

    def step(self, actions: Any) -> Any:
        states, _, terminated = super().step(actions)
        return states, np.full(self.num_envs, self.wage, dtype=np.float32), terminated


def point_robots(num_envs: int, wage: float) -> VecEnv:
    """With near goals, so that random walks find them."""
    family = PointRobotFamily(goal_distance=0.4)
    return BatchedTaskVecEnv(DynamicsVectorEnv(family, PaidDynamics(num_envs, wage), max_episode_steps=20))


def test_the_contract_holds() -> None:
    class Paid(DynamicsEnv):
        max_episode_steps = 20

        def __init__(self) -> None:
            super().__init__(PointRobotFamily(), PaidDynamics(1, -1.0))

    env = Paid()
    check_task_env(env)
    env.reset(options={"task": np.array([0.1, 0.0])})
    rewards = [env.step(np.array([push, 0], dtype=np.float32))[1] for push in (1, 1, 1, 1)]
    np.testing.assert_allclose(rewards, [0, -0.1, -1, -1], atol=1e-6)


@pytest.mark.parametrize("relabeller", ["SingleEpisodeRelabelling", "EpisodeClustering"])
@pytest.mark.parametrize("task_free", [-1.0, -0.3, 0.7])
def test_training_data_are_those_of_0_and_1_shifted(relabeller: str, task_free: float) -> None:
    plain, shifted = (
        filled(n_episodes=12, task_free=free, relabeller=relabeller, relabel_probability=0.6) for free in (0.0, task_free)
    )
    for _ in range(3):
        a, b = (buffer.sample(8, meta_batch_size=32, context_size=16, n_labelled=50) for buffer in (plain, shifted))
        assert a.labels is not None and b.labels is not None
        assert (a.relabelled == b.relabelled).all() and (a.unrewarded == b.unrewarded).all()
        th.testing.assert_close(b.rewards, a.rewards + task_free, atol=1e-6, rtol=0)
        th.testing.assert_close(b.context.rewards, a.context.rewards + task_free, atol=1e-6, rtol=0)
        th.testing.assert_close(b.next_observations, a.next_observations, atol=0, rtol=0)
        th.testing.assert_close(b.labels.task_free, a.labels.task_free + task_free, atol=1e-6, rtol=0)
        for name in ("rows", "reward", "inferred"):
            th.testing.assert_close(getattr(b.labels, name), getattr(a.labels, name), atol=1e-6, rtol=0, msg=name)
        assert 0 < a.labels.inferred.mean() < 1
    ours, theirs = plain.stats(), shifted.stats()
    assert ours == theirs


def expect(model: PEARL, wage: float) -> None:
    """Have networks that know rewards of 0 and 1 expect so much more for each step."""
    factors, task_free = model.encoder.factors, model.reward_model.task_free_net
    assert isinstance(factors, th.nn.Sequential) and isinstance(task_free, th.nn.Sequential)
    first: Any = factors[0]
    last: Any = task_free[-1]
    with th.no_grad():
        first.bias -= wage * first.weight[:, -1]
        last.bias += wage
        for network in model.critic.networks:
            bias: Any = network[-1].bias  # type: ignore[index]
            bias += wage / (1 - model.gamma)


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_particles_and_belief_are_the_same(tiny_pearl: MakePEARL) -> None:
    models: list[PEARL] = []
    outcomes: list[tuple[NDArray[Any], NDArray[Any]]] = []
    for wage in (0.0, -1.0):
        # Random episodes, and the same networks
        model = tiny_pearl(point_robots(4, wage), learning_starts=10_000, gamma=0.9).learn(2 * ROLLOUT)
        expect(model, wage)
        assert model.task_bank is not None
        means = th.randn(20, 3, generator=th.Generator().manual_seed(0))
        model.knowledge.learn(model.policy, means, model.task_bank, model.gamma)
        models.append(model)
        outcomes.append(evaluate_adaptation(model, point_robots(20, wage), n_episodes=4))
    plain, shifted = (model.knowledge for model in models)
    assert plain.n_particles == shifted.n_particles > 20
    for ours, theirs in zip(plain.particles(), shifted.particles(), strict=True):
        th.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    th.testing.assert_close(shifted.threshold, plain.threshold, atol=1e-5, rtol=0)
    th.testing.assert_close(shifted.task_free_value, plain.task_free_value - 10, atol=1e-4, rtol=0)
    (returns, successes), (shifted_returns, shifted_successes) = outcomes
    np.testing.assert_array_equal(successes, shifted_successes)
    np.testing.assert_allclose(returns - 20, shifted_returns, atol=1e-3)
    assert successes.any(axis=1).mean() > 0.1


def test_an_env_that_hides_what_failures_return_is_refused(tiny_pearl: MakePEARL) -> None:
    class Silent(DynamicsVectorEnv):
        """-1 and 0, and the infos say nothing of -1."""

        def step(self, actions: Any) -> Any:
            *rest, infos = super().step(actions)
            return *rest, {**infos, "task_free_reward": np.zeros(self.num_envs)}

    class MinusOne(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            return np.where(self.is_success(traj, task), 0, -1).astype(np.float32)

    env = BatchedTaskVecEnv(Silent(MinusOne(), PointRobotDynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=r"A step is worth 0 under the task that it solves.*-1 where rewards are -1 and 0"):
        tiny_pearl(env).learn(1)
