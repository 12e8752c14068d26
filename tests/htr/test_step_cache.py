"""What is remembered of stored steps."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.step_cache import StepCache


@example([("add", 0, 1), ("look", 0, 1), ("load", 0, 1), ("look", 0, 1)])  # a smaller store in place of a larger one
@given(
    st.lists(st.tuples(st.sampled_from(("add", "look", "load", "reset")), st.integers(0, 2), st.integers(1, 4)), max_size=40)
)
def test_a_cache_says_what_asking_anew_would_say(done: list[tuple[str, int, int]]) -> None:
    """However episodes are overwritten, loaded from a file or forgotten between the looks."""

    def make_store() -> EpisodeStore:
        return EpisodeStore(3, episodes_per_task=2, episode_length=4, row_dim=1)

    def ask(rows: np.ndarray) -> np.ndarray:
        asked.extend(rows)
        return np.asarray(store.rows[rows, 0] % 128)

    store, other = make_store(), make_store()
    asked: list[int] = []
    cache = StepCache(ask)
    for number, (what, task, length) in enumerate([*done, ("look", 0, 1), ("look", 0, 1)]):
        if what == "add":
            store.add(task, np.full((length, 1), number, dtype=np.float32))
            if task > 0:
                other.add(task, np.full((length, 1), number + 50, dtype=np.float32))
        elif what == "load":
            store.load_state_dict(other.state_dict())
        elif what == "reset":
            store = make_store()
        else:
            rows = store.index().rows[:, None]
            np.testing.assert_array_equal(cache.look_up(store, rows), store.rows[rows, 0] % 128)
            asked.clear()
            cache.look_up(store, rows[:, 0])
            assert not asked, "nothing is asked twice"
