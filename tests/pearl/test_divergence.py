"""A training that goes wrong says so."""

import warnings
from functools import partial
from typing import Any

import pytest
import torch as th

from helpers import ROLLOUT, MakePEARL, with_policy
from sb3_htr.common.divergence import DivergedError
from sb3_htr.common.warn_once import WarnOnce
from sb3_htr.pearl.divergence import check_posterior


def test_a_diverging_loss_stops_training_with_step_and_tensor(tiny_pearl: MakePEARL) -> None:
    message = r"(critic_loss is (nan|inf)|not finite) at env step \d+, update \d+.*lower learning_rate"
    with pytest.raises(DivergedError, match=message):
        tiny_pearl(learning_rate=1e20, gradient_steps=30).learn(10 * ROLLOUT)


@pytest.mark.parametrize("network", ["encoder", "critic", "actor"])
def test_a_weight_that_is_not_finite_is_named(tiny_pearl: MakePEARL, network: str) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    name, weight = next(iter(getattr(model.policy, network).named_parameters()))
    with th.no_grad():
        weight.view(-1)[0] = float("nan")
    # What is not finite spreads within an update
    with pytest.raises(DivergedError, match=rf"{network}.{name} are not finite|weights \(\w+\.[\w.]+ first\)"):
        model.train(1, 4)


def test_the_posterior_is_watched() -> None:
    check = partial(check_posterior, warn_once=WarnOnce())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(10.0)
    with pytest.warns(UserWarning, match="collapsed: z says nothing about the task"):
        check(1e-4)
    with pytest.warns(UserWarning, match="exploded"):
        check(1e6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(1e-4)  # once is enough


def test_a_collapsed_posterior_is_warned_of_in_training(tiny_pearl: MakePEARL) -> None:
    """By an encoder whose rows say nothing, and which stays as it is."""
    model = tiny_pearl(learning_rate=0.0, policy_kwargs=with_policy(encoder_class="PriorFactorEncoder"))
    factors: Any = model.encoder.factors
    *_, last = factors.children()
    with th.no_grad():
        last.weight.zero_()
        last.bias.copy_(th.tensor([0.0] * 3 + [-20.0] * 3))
    with pytest.warns(UserWarning, match="collapsed"):
        model.learn(ROLLOUT)
