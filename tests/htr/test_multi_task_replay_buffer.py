"""Promises of the replay buffer, whatever relabels."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from helpers import MakePEARL
from helpers.experience import FAMILY, add_episode, assert_same, by_task, filled, make_buffer
from htr_envs import PointRobotFamily
from sb3_htr.htr import EpisodeClustering, SingleEpisodeRelabelling
from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.groups import stratified_draw
from sb3_htr.htr.relabel.base import HindsightDraw, Relabeller
from sb3_htr.htr.transitions import Transitions

RELABELLERS = ["SingleEpisodeRelabelling", "EpisodeClustering"]
both_relabellers = pytest.mark.parametrize("relabeller", RELABELLERS)


# --- spread: how rows are drawn


@given(st.integers(0, 1000), st.lists(st.tuples(st.integers(0, 50), st.integers(1, 40)), min_size=1), st.integers(1, 60))
def test_spread_draws_from_each_range_without_duplicates(seed: int, ranges: list[tuple[int, int]], width: int) -> None:
    start, length = np.array(ranges).T
    drawn, size = stratified_draw(np.random.default_rng(seed), np.stack([start, start + length], axis=1), width)
    assert size.tolist() == np.minimum(length, width).tolist()
    for values, first, n in zip(np.split(drawn, np.cumsum(size)[:-1]), start, length, strict=True):
        assert values.min() >= first and values.max() < first + n
        assert len(set(values)) == len(values)


def test_spread_gives_every_row_the_same_chance() -> None:
    n = 20_000
    drawn, _ = stratified_draw(np.random.default_rng(0), np.tile([0, 7], (n, 1)), 3)
    np.testing.assert_allclose(np.bincount(drawn, minlength=7) / n, 3 / 7, atol=0.02)


# --- storage


def test_only_complete_episodes_can_be_sampled() -> None:
    buffer = make_buffer(n_envs=1)
    heard: list[tuple[int, int]] = []
    buffer.episode_listeners.append(lambda task, episode: heard.append((task, len(episode))))
    step = np.zeros((1, 2), dtype=np.float32)
    buffer.add(step, step, step, np.zeros(1), np.zeros(1, bool), [{"task_id": 0, "task_free_reward": 0.0}])
    with pytest.raises(ValueError, match=r"An action of 50 was to be stored, expected numbers from -1 to 1"):
        buffer.add(step, step, step + 50, np.zeros(1), np.zeros(1, bool), [{"task_id": 0, "task_free_reward": 0.0}])
    assert buffer.size() == 0 and not heard
    with pytest.raises(ValueError, match="no complete episode"):
        buffer.sample(4)
    buffer.discard_open_episodes()
    add_episode(buffer, [5], 20, np.random.default_rng(0))
    assert buffer.size() == 20 and buffer.n_episodes[5] == 1
    assert heard == [(5, 20)], "listeners are told of an episode once, when it is complete"
    buffer.reset()
    assert buffer.size() == 0


def test_a_task_counts_as_rewarded_if_one_of_its_own_episodes_is() -> None:
    """Whatever depends on no task, such as a cost of each step, is no reward."""
    buffer, cost = make_buffer(n_envs=1), -0.25
    assert buffer.stats()["replay/tasks_rewarded"] == 0
    for task, reward in ((3, 0.0), (3, 1.0), (3, 0.0), (5, 0.0), (7, 0.5), (9, 0.0)):
        step, info = np.zeros((1, 2), dtype=np.float32), {"task_id": task, "task_free_reward": cost}
        for last in (False, True):
            buffer.add(step, step, step, np.array([cost + reward]), np.array([last]), [info])
    assert buffer.stats()["replay/tasks_rewarded"] == 2
    assert buffer.rewarded(buffer.episodes).tolist() == [False, True, False, False, True, False]


def test_a_time_limit_is_not_a_termination() -> None:
    for terminated in (False, True):
        buffer = make_buffer(relabel_probability=0)
        add_episode(buffer, [0, 1], 5, np.random.default_rng(0), terminated=terminated)
        assert buffer.sample(5).dones.max() == float(terminated)


# --- relabelling


@both_relabellers
@pytest.mark.parametrize("k", [0.0, 0.3, 1.0])
def test_k_is_the_probability_of_relabelling(relabeller: str, k: float) -> None:
    buffer = filled(n_episodes=20, relabeller=relabeller, relabel_probability=k)
    relabelled = np.concatenate([buffer.sample(1, meta_batch_size=200).relabelled for _ in range(50)])
    assert abs(relabelled.mean() - k) <= 0.02 * (k == 0.3)


@both_relabellers
def test_relabelling_leaves_the_other_rows_alone_bit_for_bit(relabeller: str) -> None:
    """K = 0 is plain PEARL: rows that are not relabelled are the same whatever K is, and whatever relabels."""
    plain = filled(relabel_probability=0.0)
    mixed = filled(relabel_probability=0.5, relabeller=relabeller)
    for _ in range(5):
        a, b = plain.sample(8, meta_batch_size=32), mixed.sample(8, meta_batch_size=32)
        same = ~b.relabelled
        assert same.any() and not same.all()
        assert (a.task_ids == b.task_ids).all()
        columns = ("observations", "actions", "next_observations", "rewards", "dones")
        for names, x, y in ((columns, a, b), (columns[:2] + columns[3:4], a.context, b.context)):
            for name in names:
                split = (by_task(getattr(data, name), data.lengths) for data in (x, y))
                assert all(np.array_equal(p, q) for p, q, kept in zip(*split, same, strict=True) if kept), name


@both_relabellers
def test_no_transition_is_drawn_twice(relabeller: str) -> None:
    settings = {"elsewhere": 0.0} if relabeller == "SingleEpisodeRelabelling" else {}
    buffer = filled(n_episodes=12, relabel_probability=1.0, relabeller={"name": relabeller, **settings})
    data = buffer.sample(16, meta_batch_size=32, context_size=20)
    for drawn in (data, data.context):
        rows = th.cat([drawn.observations, drawn.actions], dim=1)
        assert all(len({tuple(row) for row in task}) == len(task) for task in by_task(rows, drawn.lengths))


@both_relabellers
def test_what_is_drawn_has_the_types_and_shapes_of_the_docstring(relabeller: str) -> None:
    data = filled(relabeller=relabeller).sample(4, meta_batch_size=6, context_size=7)
    for drawn, size in ((data, 4), (data.context, 7)):
        tensors = {name: value for name, value in drawn._asdict().items() if th.is_tensor(value)}
        assert all(value.dtype == (th.int64 if name == "lengths" else th.float32) for name, value in tensors.items())
        assert drawn.lengths.tolist() == [size] * 6 and drawn.observations.shape == drawn.actions.shape == (6 * size, 2)
        assert drawn.rewards.shape == (6 * size,)
    assert data.task_ids.shape == data.relabelled.shape == data.unrewarded.shape == (6,)
    assert data.next_observations.shape == (24, 2) and data.dones.shape == (24,)


@both_relabellers
def test_contexts_tell_where_their_steps_led(relabeller: str) -> None:
    context = filled(n_episodes=12, relabel_probability=0.5, relabeller=relabeller).sample(4, meta_batch_size=32).context
    np.testing.assert_allclose(context.next_observations, context.observations + 0.1 * context.actions, atol=1e-6)


def test_a_cost_that_no_task_has_a_part_in_hides_no_missing_reward() -> None:
    buffer = filled(relabel_probability=0.5)
    columns = buffer.transitions
    buffer.episodes.rows[:, [columns.reward, columns.task_free_reward]] -= 0.25
    costly = buffer.sample(16, meta_batch_size=200)
    assert 0.2 < costly.unrewarded.mean() < 0.7
    rewards = by_task(costly.rewards, costly.lengths)
    assert all((rewards[i] == -0.25).all() for i in np.flatnonzero(costly.unrewarded))


def test_dense_proxy_is_only_in_the_rl_batch() -> None:
    sparse, dense = (filled(relabel_probability=0.0, rl_reward_type=t) for t in ("sparse", "dense"))
    a, b = sparse.sample(8), dense.sample(8)
    assert all((x == y).all() for x, y in zip(a.context, b.context, strict=True))
    goals = FAMILY.train_tasks[b.task_ids].repeat(b.lengths.numpy(), axis=0)
    distance = np.linalg.norm(b.next_observations.numpy() - goals, axis=-1)
    np.testing.assert_allclose(b.rewards, -distance, rtol=1e-5)


# --- state


@both_relabellers
def test_pickles_and_states_keep_episodes_and_random_stream(relabeller: str) -> None:
    buffer = filled(relabeller=relabeller)
    restored = make_buffer(relabeller=relabeller, seed=5)
    restored.load_state_dict(buffer.state_dict())
    pickled = pickle.loads(pickle.dumps(buffer))
    for _ in range(3):
        sample = buffer.sample(4)
        assert_same(sample, restored.sample(4))
        assert_same(sample, pickled.sample(4))


def test_actions_reach_the_reward_hook_in_the_bounds_of_the_env() -> None:
    bounds = spaces.Box(np.array([0.0, -3.0]), np.array([2.0, 5.0]), dtype=np.float64)
    transitions = Transitions(spaces.Box(-1, 1, (2,)), bounds)
    rows = np.zeros((3, transitions.width), dtype=np.float32)
    rows[:, transitions.action] = [[-1, -1], [0, 0], [1, 1]]
    np.testing.assert_allclose(transitions.trajectory(rows).actions, [[0, -3], [1, 1], [2, 5]])


# --- objects are settings


@pytest.mark.parametrize("relabeller", [EpisodeClustering(cell_size=0.2), SingleEpisodeRelabelling("final")])
def test_relabellers_given_to_two_models_are_not_shared(tiny_pearl: MakePEARL, relabeller: Any) -> None:
    before = dict(vars(relabeller))
    models = [tiny_pearl(seed=seed, replay_buffer_kwargs={"relabeller": relabeller}) for seed in (1, 2)]
    buffers = [model.replay_buffer for model in models]
    assert buffers[0] is not None and buffers[1] is not None
    ours, theirs = buffers[0].relabeller, buffers[1].relabeller
    assert ours is not theirs is not relabeller is not ours
    models[0].learn(480)
    assert vars(relabeller) == before, "it holds settings, and is as it was"
    assert ours.buffer is buffers[0] and theirs.buffer is buffers[1] and ours.policy is models[0].policy
    if isinstance(ours, EpisodeClustering) and isinstance(theirs, EpisodeClustering):
        assert ours.n_hindsight_buffers > 0 == theirs.n_hindsight_buffers
        assert ours.cell_size == relabeller.cell_size == theirs.cell_size
    alone = tiny_pearl(seed=2).replay_buffer
    assert alone is not None and buffers[1].size() == alone.size() == 0


class Remembers(SingleEpisodeRelabelling):
    """What it remembers is made with it."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def on_episode(self, task: int, episode: np.ndarray) -> None:
        self.seen.append(task)


def test_what_a_relabeller_of_ones_own_remembers_is_of_one_model(tiny_pearl: MakePEARL) -> None:
    kwargs = {"relabeller": Remembers()}
    first, second = (tiny_pearl(replay_buffer_kwargs=kwargs).replay_buffer for _ in range(2))
    assert first is not None and second is not None
    first.relabeller.on_episode(3, np.zeros((1, 1)))
    assert [vars(buffer.relabeller)["seen"] for buffer in (first, second)] == [[3], []]


# --- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"relabel_probability": 1.5}, "relabel_probability is 1.5, expected a number from 0 to 1"),
        ({"relabel_probability": float("nan")}, "relabel_probability is nan"),
        ({"rl_reward_type": "x"}, "rl_reward_type is 'x'"),
        ({"context_episodes": 0}, "context_episodes is 0"),
        ({"buffer_size": 100}, "too small for one episode"),
        ({"relabeller": "Nobody"}, r"relabeller is 'Nobody', expected one of \['EpisodeClustering', 'Hindsight"),
        ({"relabeller": {"cell_size": 0.1}}, "relabeller is {'cell_size': 0.1}, expected one of"),
        ({"relabeller": None}, "relabeller is None, expected one of"),
    ],
)
def test_bad_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(**kwargs)


@both_relabellers
def test_no_argument_is_ignored(relabeller: str) -> None:
    """Not by the buffer, and not by what it hands arguments on to."""
    with pytest.raises(TypeError, match="cell_size"):
        make_buffer(relabeller=relabeller, cell_size=0.1)
    other = {"SingleEpisodeRelabelling": "exploratory_fraction", "EpisodeClustering": "rl_batch_source"}[relabeller]
    with pytest.raises(ValueError, match=f"relabeller '{relabeller}' has no setting '{other}': "):
        make_buffer(relabeller={"name": relabeller, other: 0.5})
    with pytest.raises(ValueError, match="did you mean hindsight_task_strategy"):
        make_buffer(relabeller={"name": relabeller, "hindsight_task_strateg": "even"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task_id": 80}, "task_id'. is 80, expected a training task from 0 to 79"),
        ({"task_id": -1}, "only training tasks may enter the replay buffer"),
        ({"reward": np.nan}, "The reward of task 7 .* is nan"),
        ({"next_obs": np.inf}, "The next_observation of task 7"),
        ({"obs": np.nan}, "The observation of task 7"),
    ],
)
def test_bad_steps(change: dict[str, float], message: str) -> None:
    buffer = make_buffer(n_envs=1)
    values = {"obs": 0.0, "next_obs": 0.0, "reward": 0.0, "task_id": 7, **change}
    obs, next_obs = (np.full((1, 2), values[name], dtype=np.float32) for name in ("obs", "next_obs"))
    info = {"task_id": values["task_id"], "task_free_reward": 0.0}
    with pytest.raises(ValueError, match=message):
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.array([values["reward"]]), np.array([False]), [info])


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda rewards: rewards * np.nan, "for a hindsight task, returned NaN or infinity, expected finite rewards"),
        (lambda rewards: rewards.sum(axis=-1), r"returned shape \(\d+,\), expected \(\d+, 1\): one for each step"),
    ],
)
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_a_reward_hook_that_returns_no_rewards_is_refused(spoil: Any, sentence: str, reward_type: str) -> None:
    buffer = filled(relabel_probability=1.0, rl_reward_type=reward_type)

    class Broken(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            return spoil(super().compute_reward(traj, task, reward_type))

    buffer.task_family = Broken()
    with pytest.raises(ValueError, match=f"^compute_reward with reward_type='(sparse|dense)', .*{sentence}"):
        buffer.sample(4)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda rewards: rewards + np.nan, "NaN or infinity, expected finite rewards"),
        (lambda rewards: rewards + np.inf, "NaN or infinity, expected finite rewards"),
        (lambda rewards: rewards[:1], r"shape \(1, 10\), expected \(16, 10\): one for each step"),
    ],
)
def test_the_reward_model_is_taught_no_rewards_that_are_none(spoil: Any, sentence: str) -> None:
    """Where nothing is relabelled, it alone is told what other tasks pay."""
    buffer = filled(relabel_probability=0.0)

    class Broken(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            return spoil(super().compute_reward(traj, task, reward_type))

    buffer.task_family = Broken()
    with pytest.raises(ValueError, match=f"^compute_reward under all tasks of a meta-batch returned {sentence}"):
        buffer.sample(4, n_labelled=10)


class Apart(Relabeller):
    """Has a store of its own, of episodes that are marked, and wants half of the RL batch from the replay."""

    def draw(self, tasks: np.ndarray) -> HindsightDraw:
        own = EpisodeStore(1, 1, 20, self.buffer.transitions.width)
        own.add(0, np.full((20, self.buffer.transitions.width), 7.0, dtype=np.float32))
        all_of_it = np.tile([0, 20], (len(tasks), 1))
        return HindsightDraw(own, all_of_it, all_of_it, np.zeros((len(tasks), 2), np.float32), False, elsewhere=0.5)


def test_elsewhere_is_the_replay_whatever_the_store_of_a_relabeller() -> None:
    data = filled(n_episodes=12, relabel_probability=1.0, relabeller=Apart()).sample(20, meta_batch_size=30, context_size=20)
    marked = (data.observations == 7).all(dim=1)
    assert 0.4 < marked.float().mean() < 0.6 and (data.context.observations == 7).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"context": np.zeros((30, 2))}, "context of a HindsightDraw has shape .* and dtype float64, expected whole numbers"),
        ({"batch": np.tile([5, 5], (30, 1))}, "batch of a HindsightDraw has a range that is empty or not within the 20 rows"),
        ({"batch": np.tile([0, 21], (30, 1))}, "batch of a HindsightDraw has a range that is empty or not within the 20 rows"),
        ({"tasks": np.zeros(30)}, r"tasks of a HindsightDraw are array(.|\n)*, expected finite numbers of shape \(30, 2\)"),
        ({"tasks": np.full((30, 2), np.nan)}, r"tasks of a HindsightDraw are array(.|\n)*nan(.|\n)*, expected finite numbers"),
        ({"elsewhere": 2.0}, "elsewhere of a HindsightDraw is 2.0, expected a share from 0 to 1"),
    ],
)
def test_draws_of_a_relabeller_that_cannot_be(wrong: dict[str, Any], message: str) -> None:
    class Wrong(Apart):
        def draw(self, tasks: np.ndarray) -> HindsightDraw:
            return super().draw(tasks)._replace(**wrong)

    with pytest.raises(ValueError, match=message):
        filled(relabel_probability=1.0, relabeller=Wrong()).sample(20, meta_batch_size=30, context_size=20)


def test_hindsight_tasks_are_not_rounded_where_training_tasks_are_integers() -> None:
    """As those of a family of one's own may be."""
    buffer = filled(relabel_probability=1.0, relabeller=SingleEpisodeRelabelling(elsewhere=0.0))
    buffer.task_family = copy.copy(buffer.task_family)
    buffer.task_family.train_tasks = np.round(buffer.task_family.train_tasks).astype(int)
    assert not buffer.sample(20, meta_batch_size=50, context_size=20).unrewarded.any()


@given(seed=st.integers(0, 2**20), k=st.sampled_from([0.0, 0.5, 1.0]), size=st.integers(1, 30))
def test_contexts_are_in_the_order_of_time(seed: int, k: float, size: int) -> None:
    """For encoders that read them so, as at meta-test."""
    buffer = filled(n_episodes=8, relabel_probability=k, seed=seed)
    order = {row.tobytes(): i for i, row in enumerate(buffer.episodes.take(np.arange(buffer.size()))[:, :4])}
    context = buffer.sample(4, meta_batch_size=8, context_size=size).context
    rows = np.column_stack([context.observations, context.actions]).astype(np.float32)
    for one in by_task(rows, context.lengths):
        places = [order[row.tobytes()] for row in one]
        assert places == sorted(places)


@pytest.mark.parametrize("n_steps", [1, 3, 10])
def test_what_is_unrewarded_is_what_the_rewards_of_the_batch_say(n_steps: int) -> None:
    buffer = filled(n_episodes=20, relabel_probability=0.5, seed=1)
    data = buffer.sample(3, meta_batch_size=200, n_steps=n_steps)
    without = [not rewards.any() for rewards in by_task(data.rewards.numpy(), data.lengths)]
    assert 0 < np.mean(without) < 1
    np.testing.assert_array_equal(data.unrewarded, without)


@pytest.mark.parametrize("k", [0.0, 1.0])
def test_contexts_are_of_the_latest_episodes_and_rl_batches_of_all(k: float) -> None:
    """Of the task, or of the hindsight buffer, which is the only one here."""
    one = {"name": "EpisodeClustering", "cell_size": 100.0, "exploratory_fraction": 0.0}
    settings: dict[str, Any] = {"relabel_probability": k, "relabeller": one, "context_episodes": 2}
    buffer, rng = make_buffer(n_envs=1, buffer_size=16_000, **settings), np.random.default_rng(0)
    for _ in range(6):
        add_episode(buffer, [0], 20, rng)
    assert isinstance(buffer.relabeller, EpisodeClustering)
    store = buffer.relabeller.episodes if k else buffer.episodes
    store.rows[store.index().rows, buffer.transitions.reward] = np.repeat(np.arange(6), 20)
    data = buffer.sample(120, meta_batch_size=4, context_size=120)
    assert set(data.context.rewards.tolist()) == {4, 5} and set(data.rewards.tolist()) == {0, 1, 2, 3, 4, 5}


def test_labels_are_the_rewards_of_the_labelled_rows_under_the_tasks_of_the_meta_batch() -> None:
    """Hindsight tasks, where rows are relabelled: at the place that a context has a reward of 1 for."""
    relabeller = {"name": "SingleEpisodeRelabelling", "elsewhere": 0.0}
    data = filled(n_episodes=12, relabel_probability=1.0, relabeller=relabeller).sample(8, meta_batch_size=16, n_labelled=50)
    labels, context = data.labels, data.context
    assert labels is not None and labels.inferred.all()
    places = (context.observations + 0.1 * context.actions)[context.rewards == 1]
    assert len(places) == 16
    distance = (labels.next_observations[:, None] - places).norm(dim=-1)
    expected, rim = (1 - distance) * (distance < FAMILY.goal_radius), (distance - FAMILY.goal_radius).abs() < 1e-4
    th.testing.assert_close(labels.reward[~rim], expected[~rim], atol=1e-4, rtol=0)
    assert th.equal(labels.next_observations, data.next_observations[labels.rows])
