"""What of an episode the encoder sees."""

import numpy as np
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_htr.adaptation.context import context_dim, context_rows, evenly_spread
from sb3_htr.common.type_aliases import Context


@given(st.lists(st.integers(1, 300), min_size=1, max_size=6), st.integers(1, 40))
def test_contexts_are_spread_over_their_episodes(lengths: list[int], size: int) -> None:
    steps, taken = evenly_spread(np.array(lengths), size)
    assert taken.tolist() == [min(length, size) for length in lengths]
    for episode, length in zip(np.split(steps, np.cumsum(taken)[:-1]), lengths, strict=True):
        # As far from each other as from the ends, up to rounding
        gaps = np.diff(np.concatenate([[-1 - episode[0]], episode, [2 * length - 1 - episode[-1]]]))
        assert episode.min() >= 0 and episode.max() < length and np.ptp(gaps) <= 2
        assert length > size or (episode == np.arange(length)).all()


def test_a_row_is_observation_action_reward_and_observations_alone_are_normalized() -> None:
    context = Context(th.tensor([[1.0, 2]]), th.tensor([[3.0, 4, 5]]), th.tensor([6.0]), th.tensor([1]))
    rows = context_rows(context, lambda obs: 10 * obs)
    assert rows.tolist() == [[10, 20, 3, 4, 5, 6]] and rows.shape[1] == context_dim(2, 3)
