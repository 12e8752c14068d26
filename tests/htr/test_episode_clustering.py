"""EC: relabelling when the data comes in, in hindsight buffers of a discretised task space."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers import MakePEARL
from helpers.experience import FAMILY, add_episode, assert_same, make_buffer
from sb3_htr.htr import EpisodeClustering, MultiTaskReplayBuffer


def filled(
    n_episodes: int = 30, relabel_probability: float = 0.8, **settings: Any
) -> tuple[MultiTaskReplayBuffer, EpisodeClustering]:
    relabeller = {"name": "EpisodeClustering", **settings}
    buffer = make_buffer(buffer_size=16_000, relabel_probability=relabel_probability, relabeller=relabeller)
    rng = np.random.default_rng(0)
    for i in range(n_episodes):
        add_episode(buffer, [i % 5, 5 + i % 7], 20, rng)
    assert isinstance(buffer.relabeller, EpisodeClustering)
    return buffer, buffer.relabeller


def test_a_width_that_is_no_float_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cell_size is \[1000.*0\], expected positive widths"):
        EpisodeClustering([10**400])


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=1), st.floats(0.01, 2))
def test_grid_maps_tasks_to_the_middle_of_their_cell(tasks: list[tuple[float, float]], cell_size: float) -> None:
    points = np.array(tasks, dtype=np.float32)
    middles = EpisodeClustering(cell_size).cells(points)
    assert middles.dtype == np.float32 and (np.abs(middles - points) <= cell_size / 2 + 1e-3).all()
    np.testing.assert_allclose(EpisodeClustering(cell_size).cells(middles), middles, atol=1e-4)


def test_store_and_buffer_know_nothing_of_its_hindsight_tasks() -> None:
    """The buffer is as it would be without, in memory and in files; copies are no new experience."""
    buffer, clustering = filled()
    plain = make_buffer(buffer_size=16_000)
    heard: list[int] = []
    plain.episode_listeners.append(lambda task, episode: heard.append(task))
    rng = np.random.default_rng(0)
    for i in range(30):
        add_episode(plain, [i % 5, 5 + i % 7], 20, rng)
    assert clustering.episodes is not buffer.episodes and clustering.n_hindsight_buffers == clustering.episodes.n_tasks > 10
    assert buffer.episodes.n_tasks == buffer.n_tasks == 80 and buffer.size() == 60 * 20
    assert len(heard) == buffer.n_episodes.sum() == 60
    ours, theirs = (b.episodes.state_dict() for b in (buffer, plain))
    assert all((ours[name] == theirs[name]).all() for name in theirs)
    stats = buffer.stats()
    assert stats["replay/transitions"] == 60 * 20 and stats["replay/megabytes"] == plain.stats()["replay/megabytes"]
    assert stats["replay/n_hindsight_buffers"] == clustering.n_hindsight_buffers


def test_a_hindsight_task_that_knows_one_step_alone_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Elsewhere it is asked for one step at a time."""
    monkeypatch.setattr(type(FAMILY), "hindsight_task", lambda family, traj, index: traj.next_observations[..., -1, :2].copy())
    with pytest.raises(ValueError, match=r"hindsight_task returned shape \(2,\) for \d+ steps, expected \(\d+, 2\)"):
        filled()


def test_real_rows_keep_their_rewards_and_hindsight_rows_have_those_of_one_cell() -> None:
    buffer, clustering = filled()
    data = buffer.sample(8, meta_batch_size=200, context_size=20)
    row = np.repeat(np.arange(200), data.lengths.numpy())
    place, reward = data.next_observations.numpy(), data.rewards.numpy()

    def expected(tasks: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(place - tasks, axis=-1)
        return np.where(distance < 0.2, 1 - distance, 0)

    real = ~data.relabelled[row]
    np.testing.assert_allclose(reward[real], expected(FAMILY.train_tasks[data.task_ids[row]])[real], atol=1e-5)
    cells = [np.abs(expected(task) - reward) < 1e-5 for task in clustering._tasks]
    for i in np.flatnonzero(data.relabelled):
        assert any(right[row == i].all() for right in cells)


def test_a_hindsight_buffer_holds_the_rewards_of_its_task() -> None:
    buffer, clustering = filled(exploratory_fraction=0.0)
    index, columns = clustering.episodes.index(), buffer.transitions
    assert clustering.n_hindsight_buffers > 10
    for number, task in enumerate(clustering._tasks):
        rows = clustering.episodes.rows[index.rows[index.task_row[number] : index.task_row[number + 1]]]
        expected = buffer.task_family.compute_reward(columns.trajectory(rows), task)
        np.testing.assert_array_equal(rows[:, columns.reward], expected)
        # Without exploratory episodes, each one has solved the task
        assert (expected.reshape(-1, 20) > 0).any(axis=1).all()
    stats = clustering.stats()
    assert stats["replay/rewarded_fraction_hindsight"] == 1.0 > stats["replay/rewarded_fraction_real"]


def test_even_strategy_prefers_hindsight_buffers_with_few_episodes() -> None:
    even, random = (filled(200, hindsight_task_strategy=name, exploratory_fraction=0.0)[1] for name in ("even", "random"))
    assert even.n_hindsight_buffers > 1.1 * random.n_hindsight_buffers


def test_a_hindsight_buffer_holds_each_episode_once(tiny_pearl: MakePEARL) -> None:
    """In cells as large as the robot's world, an episode solves and explores the same task."""
    relabeller = {"name": "EpisodeClustering", "cell_size": 1.0}
    buffer: Any = tiny_pearl(replay_buffer_kwargs={"relabeller": relabeller}).learn(5 * 240).replay_buffer
    episodes = buffer.relabeller.episodes
    index, n_episodes = episodes.index(), 0
    for first, last in pairwise(index.task_row):
        rows = episodes.rows[index.rows[first:last]].reshape(-1, 20 * episodes.rows.shape[1])
        n_episodes += len(rows)
        assert len(np.unique(rows, axis=0)) == len(rows)
    assert n_episodes > 50


def test_memory_grows_with_the_number_of_hindsight_buffers() -> None:
    coarse, fine = (filled(cell_size=size, exploratory_fraction=0.0)[1] for size in (0.5, 0.05))
    assert fine.n_hindsight_buffers > coarse.n_hindsight_buffers
    assert fine.stats()["replay/hindsight_megabytes"] > coarse.stats()["replay/hindsight_megabytes"]


def test_hindsight_buffers_of_another_grid_are_refused() -> None:
    saved = filled(cell_size=0.1)[0].state_dict()
    buffer, relabeller = filled(0, cell_size=0.15)
    with pytest.raises(ValueError, match=r"of another grid than that of cell_size 0\.15.*make the model with"):
        buffer.load_state_dict(saved)
    assert relabeller.n_hindsight_buffers == 0 == buffer.size()
    buffer, relabeller = filled(0, cell_size=0.1)
    buffer.load_state_dict(saved)
    assert relabeller.n_hindsight_buffers > 1


class Sectors(EpisodeClustering):
    """Cells of one's own: 36 directions at distance 1, of whose middles some round to others."""

    def cells(self, tasks: np.ndarray) -> np.ndarray:
        angle = np.floor(np.arctan2(tasks[:, 1], tasks[:, 0]) / (np.pi / 18)) * (np.pi / 18)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def test_cells_of_ones_own_are_loaded_as_they_were() -> None:
    buffer, other = (make_buffer(buffer_size=16_000, relabeller=Sectors()) for _ in range(2))
    rng = np.random.default_rng(0)
    for i in range(30):
        add_episode(buffer, [i % 5, 5 + i % 7], 20, rng)
    other.load_state_dict(buffer.state_dict())
    assert isinstance(buffer.relabeller, Sectors) and isinstance(other.relabeller, Sectors)
    assert other.relabeller.n_hindsight_buffers == buffer.relabeller.n_hindsight_buffers > 1


def test_pearl_trains_with_it(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(replay_buffer_kwargs={"relabeller": {"name": "EpisodeClustering", "cell_size": 0.1}}).learn(480)
    assert model.replay_buffer is not None
    clustering = model.replay_buffer.relabeller
    assert isinstance(clustering, EpisodeClustering) and clustering.n_hindsight_buffers > 0
    model.replay_buffer.reset()
    assert clustering.n_hindsight_buffers == 0 == model.replay_buffer.size()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cell_size": 0.0}, "cell_size is 0.0, expected positive"),
        ({"cell_size": "wide"}, "cell_size is 'wide', expected positive widths"),
        ({"cell_size": [0.1, 0.1, 0.1]}, "cell_size has 3 widths, expected one, or 2, one for each dimension of a task"),
        ({"exploratory_fraction": 1.0}, "exploratory_fraction is 1.0, expected a number from 0 to below 1"),
        ({"exploratory_fraction": False}, "exploratory_fraction is False, expected a number from 0 to below 1"),
    ],
)
def test_bad_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        filled(0, **settings)


@pytest.mark.parametrize("settings", [{"exploratory_fraction": np.float32(0.25)}, {"prefer_unsolved": np.True_}])
def test_numbers_and_flags_of_numpy_are_those_of_python(settings: dict[str, Any]) -> None:
    theirs, ours = (filled(**some)[0] for some in (settings, {name: value.item() for name, value in settings.items()}))
    assert_same(theirs.sample(8, context_size=20), ours.sample(8, context_size=20))


def test_tasks_may_have_one_width_or_one_for_each_dimension() -> None:
    cells = [filled(cell_size=size)[1]._tasks for size in (0.1, [0.1], [0.1, 0.1])]
    np.testing.assert_array_equal(cells[0], cells[1])
    np.testing.assert_array_equal(cells[0], cells[2])


def test_cells_that_the_start_does_not_solve_are_preferred() -> None:
    """Episodes stand still for 14 of 20 steps, each in another place, then leave it."""
    unsolved = {}
    for prefer in (False, True):
        relabeller = {"name": "EpisodeClustering", "exploratory_fraction": 0.0, "prefer_unsolved": prefer}
        buffer = make_buffer(n_envs=1, buffer_size=16_000, relabeller=relabeller)
        assert isinstance(buffer.relabeller, EpisodeClustering)
        rng = np.random.default_rng(0)
        n_away = 0
        for _ in range(40):
            start = obs = rng.uniform(-5, 5, (1, 2)).astype(np.float32)
            n_before = buffer.relabeller.episodes.n_added.copy()
            for step in range(20):
                action = np.full((1, 2), step >= 14, dtype=np.float32)
                next_obs = (obs + 0.1 * action).astype(np.float32)
                buffer.add(obs, next_obs, action, np.zeros(1), np.array([step == 19]), [{"task_id": 0}])
                obs = next_obs
            added = buffer.relabeller.episodes.n_added
            (cell,) = np.flatnonzero(added != np.pad(n_before, (0, len(added) - len(n_before))))
            n_away += bool(np.linalg.norm(buffer.relabeller._tasks[cell] - start[0]) >= FAMILY.goal_radius)
        unsolved[prefer] = n_away / 40
    # One of eight steps is among the last five with probability .9
    assert unsolved[False] < 0.5 and unsolved[True] > 0.75


@pytest.mark.parametrize("fraction", [0.3, 0.7])
def test_so_many_episodes_of_hindsight_buffers_are_exploratory(fraction: float) -> None:
    _, clustering = filled(200, exploratory_fraction=fraction)
    # Each of 400 episodes is in there once because it has solved the task
    assert 1 - 400 / clustering.episodes.n_added.sum() == pytest.approx(fraction, abs=0.03)
    # The others may be rewarded by chance
    assert 1 - fraction - 0.05 <= clustering.stats()["replay/rewarded_fraction_hindsight"] < 1


def test_rows_are_drawn_from_each_hindsight_buffer() -> None:
    buffer, rng = make_buffer(buffer_size=16_000, relabeller="EpisodeClustering"), np.random.default_rng(0)
    for i in range(10):
        add_episode(buffer, [i % 5, 5 + i % 5], 20, rng)
    assert isinstance(buffer.relabeller, EpisodeClustering)
    _, counts = np.unique(buffer.relabeller.draw(np.zeros(20_000, dtype=int)).tasks, axis=0, return_counts=True)
    assert len(counts) == buffer.relabeller.n_hindsight_buffers and counts.min() > 0.8 * counts.mean()
