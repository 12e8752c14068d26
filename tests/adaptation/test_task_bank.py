"""The best episode of each training task, and what becomes of it."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID, ROLLOUT, MakePEARL, with_policy
from helpers.adaptations import know_tasks
from htr_envs import PointRobotFamily, Trajectory
from sb3_htr import PEARL
from sb3_htr.adaptation.knowledge import Particles
from sb3_htr.adaptation.task_bank import SolvedTasks, TaskBank
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr.transitions import Transitions

CONTEXT_SIZE = 20


def make_bank(family: PointRobotFamily) -> TaskBank:
    env = gym.make(ENV_ID)
    return TaskBank(family, Transitions(env.observation_space, env.action_space), CONTEXT_SIZE, seed=0)


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
    """By the formula of the reward, one task after the other; hindsight tasks since they are known."""
    family = PointRobotFamily(goal_distance=0.5, n_train_tasks=9)
    bank = make_bank(family)
    episodes = walks(bank, 12, seed, lengths)
    for i, episode in enumerate(episodes):
        bank.on_episode(0, episode)
        if i % chunk == 0:
            bank.update()
    bank.update()
    solved = list(bank.solved().returns)
    for task, goal in enumerate(bank.tasks):
        distance = [np.linalg.norm(e[:, bank.transitions.next_observation] - goal, axis=1) for e in episodes]
        returns = np.array([np.where(d < family.goal_radius, 1 - d, 0).sum() for d in distance])
        if task >= bank.n_train:
            assert 0 < bank.best_return[task] <= returns.max() + 1e-4
            continue
        assert bank.best_return[task] == pytest.approx(returns.max(), abs=1e-4)
        assert (bank.length[task] > 0) == (returns.max() > 0)
        if returns.max() > 0:
            assert solved.pop(0) == bank.best_return[task]
            kept = bank.episodes[task, : bank.length[task]]
            alike = np.array([np.isin(kept, e).all() and len(kept) == min(len(e), CONTEXT_SIZE) for e in episodes])
            assert returns[alike].max() == pytest.approx(returns.max(), abs=1e-4)


@given(st.integers(0, 99), st.integers(1, 30))
def test_hindsight_tasks_are_as_far_apart_as_a_task_reaches(seed: int, n_episodes: int) -> None:
    """None is solved by the state that made another; and what most of the new episodes reach solves one of them."""
    family = PointRobotFamily(goal_distance=0.5, n_train_tasks=9)
    bank = make_bank(family)
    episodes = walks(bank, n_episodes, seed)
    for episode in episodes:
        bank.on_episode(0, episode)
    bank.update()
    goals = bank.tasks[bank.n_train :]
    distance = np.linalg.norm(goals[:, None] - goals, axis=-1) + 9 * np.eye(len(goals))
    assert distance.min() >= family.goal_radius - 1e-6
    reached = np.concatenate([e[:, bank.transitions.next_observation] for e in episodes])
    covered = np.linalg.norm(reached[:, None] - goals, axis=-1).min(axis=1) < family.goal_radius
    assert covered.mean() > 0.5


def test_of_too_many_hindsight_tasks_the_least_likely_ones_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few until they are judged, and never a training task."""
    monkeypatch.setattr("sb3_htr.adaptation.task_bank.MAX_HINDSIGHT_TASKS", 5)
    monkeypatch.setattr("sb3_htr.adaptation.task_bank.MAX_NEWCOMERS", 2)
    bank = make_bank(PointRobotFamily(n_train_tasks=3))

    def update(seed: int) -> np.ndarray:
        """Which tasks stayed."""
        before = bank.tasks
        for episode in walks(bank, 5, seed):
            bank.on_episode(0, episode)
        bank.update()
        solved = bank.solved()
        assert np.add.reduceat(solved.success, np.cumsum(solved.lengths) - solved.lengths).all(), "each is of an episode"
        return np.asarray([task in bank.tasks.tolist() for task in before.tolist()])

    update(0)
    assert len(bank.tasks) == bank.n_train + 5
    assert update(1).all(), "all are newcomers"
    for i in range(2, 10):
        # Those furthest to the left are the least likely
        bank.rank(bank.tasks[bank.length > 0, 0])
        x = bank.tasks[bank.n_train :, 0]
        stayed = update(i)
        assert stayed[: bank.n_train].all() and stayed.sum() == bank.n_train + 3
        assert x[~stayed[bank.n_train :]].max() <= x[stayed[bank.n_train :]].min()
        assert update(200 + i).all(), "two newcomers are not judged yet"


def test_a_bank_of_another_version_is_refused_in_one_sentence() -> None:
    bank = make_bank(PointRobotFamily(n_train_tasks=3))
    state = bank.state_dict()
    del state["likelihood"]
    with pytest.raises(ValueError, match=r"has no likelihood: load it with the version that saved it\."):
        bank.load_state_dict(state)


def test_episodes_count_when_they_are_taken_in_and_the_bank_has_copies() -> None:
    bank = make_bank(PointRobotFamily(goal_distance=0.1))
    (episode,) = walks(bank, 1, 0)
    kept = episode.copy()
    bank.on_episode(3, episode)
    episode[:] = 99.0
    assert len(bank.solved().lengths) == 0
    bank.update()
    solved = np.flatnonzero(bank.length)
    assert len(solved) == len(bank.solved().lengths) > 0
    np.testing.assert_array_equal(bank.episodes[solved[0]], kept)
    before = bank.best_return.copy()
    bank.update()
    np.testing.assert_array_equal(bank.best_return, before)
    other = make_bank(PointRobotFamily(goal_distance=0.1))
    other.load_state_dict(bank.state_dict())
    for ours, theirs in zip(bank.solved(), other.solved(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for one in (bank, other):
        for episode in walks(one, 3, 7):
            one.on_episode(0, episode)
        one.update()
    np.testing.assert_array_equal(bank.tasks, other.tasks)


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
    bank.solved()
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
    particles = model.knowledge.particles()
    assert model.task_bank is not None and int(particles.is_train.sum()) == model.task_bank.n_train_solved
    assert 20 < int(particles.is_train.sum()) <= 128 and 5 < int((~particles.is_train).sum()) <= 256


def test_particles_are_the_tasks_that_were_ever_reached(tiny_pearl: MakePEARL) -> None:
    """Under the reward formula, written down here once more, each best episode does what it is said to do."""
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3}))
    model.learn(4 * ROLLOUT)
    bank = model.task_bank
    assert isinstance(bank, TaskBank)
    solved, columns = bank.solved(), bank.transitions
    goal = np.repeat(bank.tasks[bank.length > 0], solved.lengths, axis=0)
    obs, action = solved.rows[:, columns.observation], solved.rows[:, columns.action]
    distance = np.linalg.norm(obs + 0.1 * np.clip(action, -1, 1) - goal, axis=1)
    inside = distance < 0.2
    on_the_rim = np.abs(distance - 0.2) < 1e-5
    assert ((solved.success == inside) | on_the_rim).all()
    reward = solved.rows[:, columns.reward]
    np.testing.assert_allclose(reward[~on_the_rim], np.where(inside, 1 - distance, 0)[~on_the_rim], atol=1e-5)
    ends = np.cumsum(solved.lengths)
    np.testing.assert_allclose(solved.returns, np.add.reduceat(reward, ends - solved.lengths), atol=1e-4)
    particles = model.knowledge.particles()
    n = len(solved.lengths)
    assert len(particles.z) == n > 20
    assert particles.gain.shape == particles.returns.shape == (n, n) and (particles.gain >= 0).all()
    np.testing.assert_allclose(particles.returns.diag(), solved.returns, rtol=1e-4)
    assert particles.log_prior.exp().sum().item() == pytest.approx(1, abs=1e-4)
    np.testing.assert_array_equal(particles.is_train, solved.is_train)


@pytest.mark.parametrize(
    ("goal_distance", "n", "n_train", "kept"), [(1.0, 384, 384, True), (0.2, 384, 384, False), (1.0, 384, 0, False)]
)
def test_particles_of_a_loaded_model_are_kept_until_as_many_tasks_are_known(
    tiny_pearl: MakePEARL, tmp_path: Any, goal_distance: float, n: int, n_train: int, kept: bool
) -> None:
    """Without its replay buffer, a model knows few when training goes on: all of its training tasks are enough."""
    tiny_pearl().save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": goal_distance}))
    known = Particles(th.ones(n, 3), th.eye(n), th.eye(n), th.zeros(n), th.arange(n) < n_train)
    loaded.knowledge.set_particles(known)
    loaded.learn(ROLLOUT)
    assert 1 < len(loaded.task_bank.solved().lengths) < n  # type: ignore[union-attr]
    assert (int(loaded.knowledge.n_particles) == n) == kept


def test_a_threshold_waits_for_a_success_that_the_bank_has_kept(tiny_pearl: MakePEARL) -> None:
    """Of a long episode, the steps that are kept may miss the one that was rewarded."""
    model = tiny_pearl().learn(ROLLOUT)
    bank, before = model.task_bank, model.knowledge.threshold.clone()
    assert bank is not None
    solved = bank.solved
    bank.solved = lambda: solved()._replace(success=np.zeros_like(solved().success))  # type: ignore[method-assign]
    model.learn(ROLLOUT, reset_num_timesteps=False)
    assert model.knowledge.threshold == before


def test_episodes_that_wait_for_the_next_update_are_saved(tiny_pearl: MakePEARL, tmp_path: Any) -> None:
    """As where a callback stops a training within a rollout."""
    model = tiny_pearl()
    bank = model.task_bank
    assert bank is not None
    for episode in walks(bank, 3, seed=0):
        bank.on_episode(1, episode)
    model.save_replay_buffer(tmp_path / "buffer")
    other = tiny_pearl()
    other.load_replay_buffer(tmp_path / "buffer")
    restored = other.task_bank
    assert restored is not None and len(restored.new) == 3
    for ours in (bank, restored):
        ours.update()
    np.testing.assert_array_equal(restored.tasks, bank.tasks)
    np.testing.assert_array_equal(restored.best_return, bank.best_return)


def test_particles_are_the_same_however_many_steps_are_looked_at_at_once(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3})).learn(2 * ROLLOUT)
    assert model.task_bank is not None and model.task_bank.n_solved > 0
    found = []
    for chunk in (2**14, 7):
        monkeypatch.setattr("sb3_htr.adaptation.knowledge.CHUNK", chunk)
        with th.no_grad():
            found.append(model.knowledge._solved(model.policy, model.task_bank, model.gamma))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_what_is_known_of_solved_tasks_is_that_of_the_docstrings(tiny_pearl: MakePEARL, monkeypatch: Any) -> None:
    """By hand, of three tasks on a line, at 0, 1 and 3: half a unit away from one, its chance is a half."""
    model = tiny_pearl(policy_kwargs=with_policy(normalize_observations=False))
    know_tasks(model, 3)
    z = th.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    monkeypatch.setattr(model.policy, "infer", lambda context: (z, None))
    columns = Transitions(model.observation_space, model.action_space)
    rows = np.zeros((6, columns.width), dtype=np.float32)
    rows[:, columns.next_observation] = np.array([[0, 0.5, 1, 1, 0, 3]]).T
    rows[:, columns.reward] = [1, 5, 5, 5, 0, 5]
    success, is_train = rows[:, columns.reward] > 0, np.array([True, True, False])
    solved = SolvedTasks(rows, np.array([2, 3, 1]), success, np.array([6, 10, 5], dtype=np.float32), is_train)
    bank: Any = type("Bank", (), {"transitions": columns, "solved": lambda self: solved})()
    with th.no_grad():
        particles = model.knowledge._solved(model.policy, bank, gamma=0.9)
    th.testing.assert_close(particles.gain, th.tensor([[3.75, 1.25, 0], [0, 5, 0], [0, 0, 5]]), atol=1e-4, rtol=0)
    th.testing.assert_close(particles.returns, th.tensor([[6.0, 2, 0], [0, 10, 0], [0, 0, 5]]), atol=1e-3, rtol=0)
    # 1 / 1.25 for those that the first is like, 1 / 5 for two units from a training task
    th.testing.assert_close(particles.log_prior.exp(), th.tensor([1, 0.8, 0.2]) / 2, atol=1e-4, rtol=0)
    assert model.knowledge.threshold.item() == pytest.approx(0.5, abs=0.02), "between nothing and the smallest reward"
    monkeypatch.setattr(model.policy.reward_model, "task_free", lambda *_: th.arange(-6.0, 0.0))
    with th.no_grad():
        model.knowledge._solved(model.policy, bank, gamma=0.9)
    assert model.knowledge.task_free_value.item() == pytest.approx(-35), "of -3.5 a step, discounted"


@pytest.mark.parametrize("stop", [-10.0, 10.0])
def test_what_is_task_free_and_hard_to_predict_makes_no_successes(stop: float, tiny_pearl: MakePEARL) -> None:
    """As a rare penalty for a safety stop, also in a step that solved a hindsight task."""
    model = tiny_pearl()
    know_tasks(model, 3)
    columns = Transitions(model.observation_space, model.action_space)
    rows = np.zeros((800, columns.width), dtype=np.float32)
    success = np.arange(800) % 2 == 0
    rows[:, columns.reward] = success + stop * (np.arange(800) % 200 < 2)
    ones = np.ones(1, dtype=np.float32)
    solved = SolvedTasks(rows, np.array([800]), success, ones, ones > 0)
    bank: Any = type("Bank", (), {"transitions": columns, "solved": lambda self: solved})()
    with th.no_grad():
        model.knowledge._solved(model.policy, bank, gamma=0.9)
    assert 0.2 < model.knowledge.threshold < 0.8


def test_what_the_bank_keeps_of_a_long_episode_has_its_reward() -> None:
    """Which lies between two of the steps that would be kept."""
    env, family = gym.make(ENV_ID), PointRobotFamily(n_train_tasks=3)
    bank = TaskBank(family, Transitions(env.observation_space, env.action_space), 5, seed=0)
    rows = np.zeros((50, bank.transitions.width), dtype=np.float32)
    rows[:, bank.transitions.next_observation] = 5.0
    rows[22, bank.transitions.next_observation] = family.train_tasks[0]
    bank.on_episode(0, rows)
    bank.update()
    solved = bank.solved()
    (first,) = np.flatnonzero(solved.is_train)
    assert np.split(solved.success, np.cumsum(solved.lengths)[:-1])[first].any()
