"""Promises of the replay buffer and of relabelling."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import add_episode, make_buffer
from hypothesis import given
from hypothesis import strategies as st

from htr_envs import PointRobotFamily, Trajectory
from sb3_htr.common.type_aliases import MultiTaskSamples
from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.relabel.hindsight_task import HindsightTaskStrategy, choose_rare
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer, spread

FAMILY = PointRobotFamily()


def filled(walk_seed: int = 0, n_episodes: int = 6, lengths: tuple[int, ...] = (20,), **kwargs: Any) -> MultiTaskReplayBuffer:
    rng = np.random.default_rng(walk_seed)
    buffer = make_buffer(FAMILY, **kwargs)
    for i in range(n_episodes):
        add_episode(buffer, [i % 3, 3 + i % 4], lengths[i % len(lengths)], rng)
    return buffer


def assert_same(a: MultiTaskSamples, b: MultiTaskSamples) -> None:
    for name, x, y in zip(a._fields, a, b, strict=True):
        assert (np.asarray(x) == np.asarray(y)).all(), name


# --- spread: how rows are drawn


@given(st.integers(0, 1000), st.lists(st.tuples(st.integers(0, 50), st.integers(1, 40)), min_size=1), st.integers(1, 60))
def test_spread_draws_from_each_range_without_duplicates(seed: int, ranges: list[tuple[int, int]], width: int) -> None:
    start, length = np.array(ranges).T
    drawn, size = spread(np.random.default_rng(seed), np.stack([start, start + length], axis=1), width)
    assert size.tolist() == np.minimum(length, width).tolist()
    for values, first, n in zip(np.split(drawn, np.cumsum(size)[:-1]), start, length, strict=True):
        assert values.min() >= first and values.max() < first + n
        assert len(set(values)) == len(values)


def test_spread_gives_every_row_the_same_chance() -> None:
    n = 20_000
    drawn, _ = spread(np.random.default_rng(0), np.tile([0, 7], (n, 1)), 3)
    np.testing.assert_allclose(np.bincount(drawn, minlength=7) / n, 3 / 7, atol=0.02)


def by_task(values: Any, lengths: Any) -> list[np.ndarray]:
    """The rows of a sample, one array for each row of the meta-batch."""
    return np.split(np.asarray(values), np.cumsum(np.asarray(lengths))[:-1])


# --- storage


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 4)), max_size=40))
def test_store_keeps_the_latest_episodes_of_each_task_in_order(added: list[tuple[int, int]]) -> None:
    store = EpisodeStore(n_tasks=3, episodes_per_task=3, episode_length=4, row_dim=1)
    kept: list[list[list[float]]] = [[], [], []]
    for number, (task, length) in enumerate(added):
        store.add(task, np.full((length, 1), number, dtype=np.float32))
        kept[task] = [*kept[task], [float(number)] * length][-3:]
    index = store.index()
    assert index.tasks.tolist() == [task for task in range(3) if kept[task]]
    for task in range(3):
        rows = store.rows[index.rows[index.task_row[task] : index.task_row[task + 1]], 0]
        assert rows.tolist() == [value for episode in kept[task] for value in episode]
        starts = index.episode_row[index.task_episode[task] : index.task_episode[task + 1]]
        assert len(starts) == len(kept[task])


def test_store_hands_out_each_new_episode_once_and_costs_nothing_when_empty() -> None:
    store = EpisodeStore(n_tasks=1000, episodes_per_task=1000, episode_length=1000, row_dim=100)
    assert store.nbytes == 0
    store.add(3, np.ones((2, 100), dtype=np.float32))
    assert store.take_new()[1].tolist() == [2]
    assert len(store.take_new()[0]) == 0
    store.forget_taken()
    assert len(store.take_new()[0]) == 1


def test_only_complete_episodes_can_be_sampled() -> None:
    buffer = make_buffer(FAMILY, n_envs=1)
    step = np.zeros((1, 2), dtype=np.float32)
    buffer.add(step, step, step, np.zeros(1), np.zeros(1, bool), [{"task_id": 0, "task_free_reward": 0.0}])
    assert buffer.size() == 0
    with pytest.raises(ValueError, match="no complete episode"):
        buffer.sample(4)
    buffer.discard_open_episodes()
    add_episode(buffer, [5], 20, np.random.default_rng(0))
    assert buffer.size() == 20 and buffer.n_episodes[5] == 1
    buffer.reset()
    assert buffer.size() == 0


def test_a_time_limit_is_not_a_termination() -> None:
    for terminated in (False, True):
        buffer = make_buffer(FAMILY, relabel_probability=0)
        add_episode(buffer, [0, 1], 5, np.random.default_rng(0), terminated=terminated)
        assert buffer.sample(5).dones.max() == float(terminated)


# --- relabelling


@given(
    st.integers(0, 2**20),
    st.sampled_from([(20,), (1, 7, 20)]),
    st.floats(0, 1),
    st.sampled_from(HindsightTaskStrategy),
)
def test_every_reward_is_that_of_one_task_per_row(
    seed: int, lengths: tuple[int, ...], k: float, strategy: HindsightTaskStrategy
) -> None:
    """Rows that are not relabelled keep the env's reward; relabelled ones carry the reward of one task that was reached."""
    buffer = filled(seed, lengths=lengths, relabel_probability=k, seed=seed, hindsight_task_strategy=strategy)
    data = buffer.sample(8, meta_batch_size=16, context_size=20)
    assert all(
        x.dtype == (th.int64 if "lengths" in name else th.float32) for name, x in data._asdict().items() if th.is_tensor(x)
    )
    own = FAMILY.train_tasks[data.task_ids]
    for row, context in enumerate(by_task(data.context, data.context_lengths)):
        traj, reward = _traj(context), context[:, -1]
        if not data.relabelled[row]:
            np.testing.assert_array_equal(reward, FAMILY.compute_reward(traj, own[row]), err_msg="own task")
        else:
            # The whole episode, so the step that reached the hindsight task too
            assert (reward > 0).any()
            reached = traj.next_observations  # the task that a state solves is the place itself
            candidates = FAMILY.compute_reward(type(traj)(*(x[None] for x in traj)), reached)
            assert (candidates == reward).all(axis=1).any(), "no reached state gives these rewards"


def _traj(context: np.ndarray) -> Trajectory:
    obs, action = context[:, :2], context[:, 2:4]
    return Trajectory(obs, action, (obs + 0.1 * action).astype(np.float32), np.zeros(len(obs), dtype=np.float32))


@pytest.mark.parametrize("k", [0.0, 1.0])
def test_k_zero_and_one_mean_never_and_always(k: float) -> None:
    buffer = filled(relabel_probability=k)
    relabelled = np.concatenate([buffer.sample(4, meta_batch_size=64).relabelled for _ in range(20)])
    assert relabelled.all() if k else not relabelled.any()


def test_k_is_the_probability_of_relabelling() -> None:
    buffer = filled(relabel_probability=0.3)
    share = np.mean([buffer.sample(1, meta_batch_size=200).relabelled.mean() for _ in range(50)])
    assert abs(share - 0.3) < 0.02


def test_relabelling_leaves_the_other_rows_alone_bit_for_bit() -> None:
    """K = 0 is plain PEARL: rows that are not relabelled are the same whatever K is."""
    plain, mixed = filled(relabel_probability=0.0), filled(relabel_probability=0.5)
    for _ in range(5):
        a, b = plain.sample(8, meta_batch_size=32), mixed.sample(8, meta_batch_size=32)
        same = ~b.relabelled
        assert same.any() and not same.all()
        assert (a.task_ids == b.task_ids).all()
        for lengths in ("context_lengths", "lengths"):
            columns = (
                ["context"] if lengths == "context_lengths" else ["observations", "actions", "next_observations", "rewards"]
            )
            for name in columns:
                x, y = (by_task(getattr(data, name), getattr(data, lengths)) for data in (a, b))
                assert all(np.array_equal(x[i], y[i]) for i in np.flatnonzero(same)), name


def test_context_and_rl_batch_come_from_one_episode_without_duplicates_in_the_context() -> None:
    buffer = filled(n_episodes=12, relabel_probability=1.0)
    data = buffer.sample(16, meta_batch_size=32, context_size=20)
    rl = th.cat([data.observations, data.actions, data.rewards[:, None]], dim=1)
    for context, batch in zip(by_task(data.context, data.context_lengths), by_task(rl, data.lengths), strict=True):
        steps = {tuple(step) for step in context}
        assert len(context) == len(steps) == 20
        assert len(batch) == len({tuple(step) for step in batch}) == 16
        assert {tuple(step) for step in batch} <= steps


def test_a_batch_larger_than_an_episode_is_the_whole_episode_once() -> None:
    data = filled(relabel_probability=1.0).sample(256, meta_batch_size=8, context_size=1024)
    assert (data.lengths == 20).all() and (data.context_lengths == 20).all()


def test_ablation_draws_the_rl_batch_from_the_whole_task() -> None:
    episode, task = (filled(n_episodes=24, relabel_probability=1.0, rl_batch_source=s) for s in ("episode", "task"))
    zero = [(buffer.sample(16, meta_batch_size=200).rewards == 0).float().mean() for buffer in (episode, task)]
    # B.2: the whole buffer under one episode's task is mostly unrewarded
    assert zero[1] > zero[0] + 0.1


def test_final_strategy_takes_the_last_state() -> None:
    buffer = filled(relabel_probability=1.0, hindsight_task_strategy="final")
    data = buffer.sample(4, meta_batch_size=16, context_size=20)
    # At the goal itself the reward is 1 - 0, and that place must be where an episode ended
    index = buffer.episodes.index()
    ends = {tuple(row) for row in buffer.episodes.rows[index.rows[index.episode_row[1:] - 1], 5:7]}
    reached = _traj(data.context.numpy()).next_observations[data.context[:, -1].numpy() == 1]
    assert len(reached) >= 16 and {tuple(place) for place in reached} <= ends


def hindsight_places(strategy: str) -> np.ndarray:
    """(n, 2) hindsight tasks that are drawn from random walks, most of whose states are near the start."""
    buffer = filled(n_episodes=60, relabel_probability=1.0, hindsight_task_strategy=strategy)
    places = []
    for _ in range(20):
        data = buffer.sample(1, meta_batch_size=64, context_size=20)
        at_goal = data.context[:, -1].numpy() == 1  # at the goal itself the reward is 1 - 0
        places.append(_traj(data.context.numpy()).next_observations[at_goal])
    return np.concatenate(places)


def test_even_strategy_draws_tasks_that_are_rarely_reached_more_often() -> None:
    random, even = (np.linalg.norm(hindsight_places(strategy), axis=1) for strategy in ("random", "even"))
    assert len(random) == len(even) == 20 * 64
    far = np.quantile(random, 0.9)
    assert (even > far).mean() > 0.25, "a tenth of all states is that far from the start"


@given(st.lists(st.lists(st.floats(0.1, 100), min_size=3, max_size=3), min_size=1, max_size=5), st.integers(0, 99))
def test_choose_rare_chooses_inversely_to_the_count(counts: list[list[float]], seed: int) -> None:
    count = np.repeat(np.array(counts), 4000, axis=0)
    chosen = choose_rare(count, np.random.default_rng(seed)).reshape(len(counts), 4000)
    expected = (1 / np.array(counts)) / (1 / np.array(counts)).sum(axis=1, keepdims=True)
    frequency = np.stack([np.bincount(row, minlength=3) for row in chosen]) / 4000
    np.testing.assert_allclose(frequency, expected, atol=0.05)


def test_unrewarded_rows_are_those_without_a_reward_of_their_task() -> None:
    buffer = filled(relabel_probability=0.5)
    data = buffer.sample(16, meta_batch_size=200)
    np.testing.assert_array_equal(data.unrewarded, [(r == 0).all() for r in by_task(data.rewards, data.lengths)])
    # A cost that no task has a part in hides nothing
    buffer.episodes.rows[:, [buffer._reward, buffer._task_free_reward]] -= 0.25
    costly = buffer.sample(16, meta_batch_size=200)
    assert 0.2 < costly.unrewarded.mean() < 0.7
    rewards = by_task(costly.rewards, costly.lengths)
    assert all((rewards[i] == -0.25).all() for i in np.flatnonzero(costly.unrewarded))


def test_dense_proxy_is_only_in_the_rl_batch() -> None:
    sparse, dense = (filled(relabel_probability=0.0, rl_reward_type=t) for t in ("sparse", "dense"))
    a, b = sparse.sample(8), dense.sample(8)
    assert (a.context == b.context).all()
    goals = FAMILY.train_tasks[b.task_ids].repeat(b.lengths.numpy(), axis=0)
    distance = np.linalg.norm(b.next_observations.numpy() - goals, axis=-1)
    np.testing.assert_allclose(b.rewards, -distance, rtol=1e-5)


def test_pickling_keeps_the_random_stream() -> None:
    buffer = filled()
    copy = pickle.loads(pickle.dumps(buffer))
    assert_same(buffer.sample(4), copy.sample(4))


def test_actions_reach_the_reward_hook_in_the_bounds_of_the_env() -> None:
    from gymnasium import spaces

    buffer = make_buffer(FAMILY)
    buffer.action_space = spaces.Box(np.array([0.0, -3.0]), np.array([2.0, 5.0]), dtype=np.float64)
    rows = np.zeros((3, buffer.episodes.rows.shape[1]), dtype=np.float32)
    rows[:, 2:4] = [[-1, -1], [0, 0], [1, 1]]
    np.testing.assert_allclose(buffer.trajectory(rows).actions, [[0, -3], [1, 1], [2, 5]])


# --- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"relabel_probability": 1.5}, "relabel_probability is 1.5, expected a number from 0 to 1"),
        ({"relabel_probability": float("nan")}, "relabel_probability is nan"),
        ({"hindsight_task_strategy": "best"}, "expected one of .'even', 'final', 'random'."),
        ({"rl_batch_source": "x"}, "rl_batch_source is 'x'"),
        ({"rl_reward_type": "x"}, "rl_reward_type is 'x'"),
        ({"context_episodes": 0}, "context_episodes is 0"),
        ({"buffer_size": 100}, "too small for one episode"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage is not supported"),
    ],
)
def test_bad_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(FAMILY, **kwargs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task_id": 80}, "task_id'. is 80, expected a training task from 0 to 79"),
        ({"task_id": -1}, "only training tasks may enter the replay buffer"),
        ({"reward": np.nan}, "The reward of task 7 .* is nan"),
        ({"next_obs": np.inf}, "The next observation of task 7"),
        ({"obs": np.nan}, "The observation of task 7"),
    ],
)
def test_bad_steps(change: dict[str, float], message: str) -> None:
    buffer = make_buffer(FAMILY, n_envs=1)
    values = {"obs": 0.0, "next_obs": 0.0, "reward": 0.0, "task_id": 7, **change}
    obs, next_obs = (np.full((1, 2), values[name], dtype=np.float32) for name in ("obs", "next_obs"))
    info = {"task_id": values["task_id"], "task_free_reward": 0.0}
    with pytest.raises(ValueError, match=message):
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.array([values["reward"]]), np.array([False]), [info])


def test_a_task_that_changes_within_an_episode_and_an_episode_without_end() -> None:
    buffer = make_buffer(FAMILY, n_envs=1)
    step = np.zeros((1, 2), dtype=np.float32)

    def add(task: int) -> None:
        buffer.add(step, step, step, np.zeros(1), np.zeros(1, bool), [{"task_id": task, "task_free_reward": 0.0}])

    add(1)
    with pytest.raises(ValueError, match="changed from 1 to 2 within an episode"):
        add(2)
    for _ in range(19):
        add(1)
    with pytest.raises(ValueError, match="longer than the env's time limit of 20"):
        add(1)


def test_a_reward_hook_that_returns_nan_is_refused() -> None:
    buffer = filled(relabel_probability=1.0)

    class Broken(PointRobotFamily):
        def _goal_reward(self, distance: Any) -> Any:
            return distance * np.nan

    buffer.task_family = Broken()
    with pytest.raises(ValueError, match="compute_reward returned NaN or infinity"):
        buffer.sample(4)
