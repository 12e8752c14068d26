"""What of an episode the encoder sees."""

import torch as th

from sb3_htr.adaptation.context import context_dim, context_rows
from sb3_htr.common.type_aliases import Context


def test_a_row_is_observation_action_reward_and_observations_alone_are_normalized() -> None:
    context = Context(th.tensor([[1.0, 2]]), th.tensor([[3.0, 4, 5]]), th.tensor([6.0]), th.tensor([1]))
    rows = context_rows(context, lambda obs: 10 * obs)
    assert rows.tolist() == [[10, 20, 3, 4, 5, 6]] and rows.shape[1] == context_dim(2, 3)
