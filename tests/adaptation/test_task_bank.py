"""The best episode of each training task, and what becomes of it."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID, ROLLOUT, MakePEARL
from htr_envs import PointRobotFamily, Trajectory
from sb3_htr import PEARL
from sb3_htr.adaptation.knowledge import KnownTasks
from sb3_htr.adaptation.task_bank import TaskBank
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr.transitions import Transitions

CPU = th.device("cpu")


def make_bank(family: PointRobotFamily) -> TaskBank:
    env = gym.make(ENV_ID)
    return TaskBank(family, Transitions(env.observation_space, env.action_space))


def walks(bank: TaskBank, n: int, seed: int, lengths: tuple[int, ...] = (20,)) -> list[np.ndarray]:
    """Random walks that lead somewhere, as the buffer hands them out."""
    rng, columns = np.random.default_rng(seed), bank.transitions
    episodes = []
    for i in range(n):
        length = lengths[i % len(lengths)]
        rows = np.zeros((length, columns.width), dtype=np.float32)
        rows[:, columns.action] = np.clip(rng.normal(0, 0.3, (length, 2)) + rng.uniform(-1, 1, 2), -1, 1)
        rows[:, columns.next_observation] = np.cumsum(0.1 * rows[:, columns.action], axis=0)
        rows[1:, columns.observation] = rows[:-1, columns.next_observation]
        episodes.append(rows)
    return episodes


@given(st.integers(0, 99), st.sampled_from([(20,), (1, 7, 20), (20, 30)]), st.integers(1, 12))
def test_each_task_has_the_best_of_all_episodes(seed: int, lengths: tuple[int, ...], chunk: int) -> None:
    """By the formula of the reward, one task after the other."""
    family = PointRobotFamily(goal_distance=0.5, n_train_tasks=9)
    bank = make_bank(family)
    episodes = walks(bank, 12, seed, lengths)
    for i, episode in enumerate(episodes):
        bank.on_episode(0, episode)
        if i % chunk == 0:
            bank.update()
    bank.update()
    for task, goal in enumerate(family.train_tasks):
        distance = [np.linalg.norm(e[:, bank.transitions.next_observation] - goal, axis=1) for e in episodes]
        returns = np.array([np.where(d < family.goal_radius, 1 - d, 0).sum() for d in distance])
        assert bank.best_return[task] == pytest.approx(returns.max(), abs=1e-4)
        assert (task in bank.solved) == (returns.max() > 0)
        if returns.max() > 0:
            kept = bank.episodes[task, : bank.length[task]]
            alike = [len(e) == len(kept) and np.array_equal(e, kept) for e in episodes]
            assert max(returns[alike]) == pytest.approx(returns.max(), abs=1e-4)


def test_episodes_count_when_they_are_taken_in_and_the_bank_has_copies() -> None:
    bank = make_bank(PointRobotFamily(goal_distance=0.1))
    (episode,) = walks(bank, 1, 0)
    kept = episode.copy()
    bank.on_episode(3, episode)
    episode[:] = 99.0
    assert len(bank.solved) == 0
    bank.update()
    assert len(bank.solved) > 0
    np.testing.assert_array_equal(bank.episodes[bank.solved[0]], kept)
    before = bank.best_return.copy()
    bank.update()
    np.testing.assert_array_equal(bank.best_return, before)
    other = make_bank(PointRobotFamily(goal_distance=0.1))
    other.load_state_dict(bank.state_dict())
    for ours, theirs in zip(bank.best_episodes(20, CPU)[1:], other.best_episodes(20, CPU)[1:], strict=True):
        np.testing.assert_array_equal(ours, theirs)


class Counting(PointRobotFamily):
    """Counts the rewards that are computed."""

    n_rewards = 0

    def compute_reward(self, traj: Trajectory, task: Any, reward_type: str = "sparse") -> Any:
        rewards = super().compute_reward(traj, task, reward_type)
        self.n_rewards += rewards.size
        return rewards


def cost(n_train_tasks: int) -> tuple[int, int]:
    """Rewards that are computed for 300 episodes, and bytes that the bank takes."""
    family = Counting(n_train_tasks=n_train_tasks, n_test_tasks=1, n_validation_tasks=1)
    bank = make_bank(family)
    for episode in walks(bank, 300, seed=0):
        bank.on_episode(0, episode)
    bank.update()
    size = sum(value.nbytes for value in vars(bank).values() if isinstance(value, np.ndarray))
    bank.best_episodes(20, CPU)
    return family.n_rewards, size


def test_cost_and_size_are_flat_from_128_training_tasks_on() -> None:
    at_64, at_128, at_8000 = (cost(n) for n in (64, 128, 8000))
    assert at_64[0] < at_128[0] and at_64[1] < at_128[1]
    # Other tasks are solved, so other episodes are rewarded under one another, but hardly more of them
    assert at_8000[0] < 1.2 * at_128[0] and at_8000[1] == at_128[1]


@pytest.mark.parametrize("n", [1, 80, 128, 129, 1000])
def test_up_to_128_training_tasks_are_all_kept_and_of_more_evenly_spread_ones(n: int) -> None:
    family = PointRobotFamily(n_train_tasks=n, n_test_tasks=1, n_validation_tasks=1)
    bank = make_bank(family)
    if n <= 128:
        np.testing.assert_array_equal(bank.tasks, family.train_tasks)
    else:
        index = [int(np.flatnonzero((family.train_tasks == task).all(axis=1))[0]) for task in bank.tasks]
        assert len(set(index)) == 128 and index[0] == 0 and index[-1] == n - 1 and np.ptp(np.diff(index)) <= 1


def test_a_family_of_many_tasks_trains(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 4, env_kwargs={"n_train_tasks": 500, "goal_distance": 0.3})
    model = tiny_pearl(env, buffer_size=500 * 20).learn(3 * ROLLOUT)
    assert model.task_bank is not None
    assert 20 < len(model.knowledge.known_tasks().z) == len(model.task_bank.solved) <= 128


def test_known_tasks_are_those_that_were_ever_reached(tiny_pearl: MakePEARL) -> None:
    """Under the reward formula, written down here once more, each best episode does what it is said to do."""
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3}))
    model.learn(4 * ROLLOUT)
    bank = model.task_bank
    assert isinstance(bank, TaskBank) and len(bank.solved) > 20
    context, returns, first_success = bank.best_episodes(20, CPU)
    assert (context.lengths == 20).all()
    obs, actions = (values.reshape(len(returns), 20, 2).numpy() for values in context[:2])
    position = obs + 0.1 * np.clip(actions, -1, 1)
    distance = np.linalg.norm(position[:, None] - bank.tasks[bank.solved][:, None], axis=-1)
    reward = np.where(distance < 0.2, 1 - distance, 0)
    np.testing.assert_allclose(returns, reward.sum(axis=-1), atol=0.9)  # a step on the rim may count or not
    assert (np.diag(returns) > 0).all() and (np.diag(first_success) < 20).all()
    np.testing.assert_array_equal(np.isfinite(first_success), returns > 0)
    np.testing.assert_allclose(context.rewards.reshape(-1, 20), np.einsum("iit->it", reward), atol=0.9)
    np.testing.assert_array_equal(model.knowledge.known_tasks().returns, returns)
    assert bank.best_episodes(5, CPU)[0].lengths.tolist() == [5] * len(returns)


def test_known_tasks_of_a_loaded_model_are_not_replaced_by_fewer(tiny_pearl: MakePEARL, tmp_path: Any) -> None:
    """Without its replay buffer, a model knows few tasks when training goes on."""
    tiny_pearl().save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.2}))
    for n, kept in ((128, True), (1, False)):
        known = KnownTasks(np.ones((n, 3), np.float32), np.eye(n, dtype=np.float32), np.zeros((n, n), np.float32))
        loaded.knowledge.set_known_tasks(known)
        loaded.learn(ROLLOUT)
        assert 1 < len(loaded.task_bank.solved) < 128  # type: ignore[union-attr]
        assert (len(loaded.knowledge.known_tasks().z) == n) == kept
