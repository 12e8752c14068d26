"""Where episodes are kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.groups import evenly_spread


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 4)), max_size=40), st.integers(0, 3))
def test_store_keeps_the_latest_episodes_of_each_task_in_order(added: list[tuple[int, int]], n_tasks: int) -> None:
    """Whether its tasks were known at the beginning or were added when they were met."""
    store = EpisodeStore(n_tasks, episodes_per_task=3, episode_length=4, row_dim=1)
    kept: list[list[list[float]]] = [[], [], []]
    for number, (task, length) in enumerate(added):
        while task >= store.n_tasks:
            assert store.add_task() == store.n_tasks - 1
        store.add(task, np.full((length, 1), number, dtype=np.float32))
        kept[task] = [*kept[task], [float(number)] * length][-3:]
    for again in (False, True):
        if again:
            state = store.state_dict()
            store = EpisodeStore(0, episodes_per_task=3, episode_length=4, row_dim=1)
            store.load_state_dict(state)
        index = store.index()
        assert index.tasks.tolist() == [task for task in range(3) if kept[task]]
        for task in range(store.n_tasks):
            rows = store.rows[index.rows[index.task_row[task] : index.task_row[task + 1]], 0]
            assert rows.tolist() == [value for episode in kept[task] for value in episode]
            starts = index.episode_row[index.task_episode[task] : index.task_episode[task + 1]]
            assert len(starts) == len(kept[task])
            np.testing.assert_array_equal(store.take(np.arange(*index.all_episodes(np.array([task]))[0]))[:, 0], rows)


def test_an_empty_store_costs_nothing() -> None:
    store = EpisodeStore(n_tasks=1000, episodes_per_task=1000, episode_length=1000, row_dim=100)
    assert store.nbytes == 0
    store.add(3, np.ones((2, 100), dtype=np.float32))
    assert 0 < store.nbytes <= 16 * 1000 * 100 * 4


def test_episodes_of_another_shape_are_refused() -> None:
    state = EpisodeStore(1, episodes_per_task=3, episode_length=4, row_dim=1).state_dict()
    for shape in ((2, 4, 1), (3, 5, 1), (3, 4, 2)):
        with pytest.raises(ValueError, match="use the settings that they were saved with"):
            EpisodeStore(1, *shape).load_state_dict(state)


@given(st.lists(st.integers(1, 300), min_size=1, max_size=6), st.integers(1, 40))
def test_contexts_are_spread_over_their_episodes(lengths: list[int], size: int) -> None:
    steps, taken = evenly_spread(np.array(lengths), size)
    assert taken.tolist() == [min(length, size) for length in lengths]
    for episode, length in zip(np.split(steps, np.cumsum(taken)[:-1]), lengths, strict=True):
        # Equally far from each other and from the start, up to rounding; the last step may be all that counts
        assert np.ptp(np.diff([-1, *episode])) <= 1 and episode[-1] == length - 1
        assert length > size or (episode == np.arange(length)).all()


@given(st.lists(st.lists(st.sampled_from([0.0, 0.0, 0.0, 1.0, 2.0]), min_size=1, max_size=60), max_size=6), st.integers(1, 12))
def test_a_context_has_a_reward_if_its_episode_has_one(rewards: list[list[float]], size: int) -> None:
    lengths = np.array([len(own) for own in rewards], dtype=int)
    steps, taken = evenly_spread(lengths, size, np.array([reward for own in rewards for reward in own]))
    usual, n_usual = evenly_spread(lengths, size)
    assert taken.tolist() == n_usual.tolist()
    for own, i, usual_i in zip(
        rewards, np.split(steps, np.cumsum(taken)[:-1]), np.split(usual, np.cumsum(taken)[:-1]), strict=False
    ):
        assert max(np.array(own)[i]) > 0 or not any(own)
        assert (np.diff(i) > 0).all() and 0 <= i[0] and i[-1] < len(own)
        # One step at most is another one, and only where it must
        assert (i != usual_i).sum() == (any(own) and not np.array(own)[usual_i].any())
