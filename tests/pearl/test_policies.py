"""What the policy says of its own networks."""

from typing import Any

import numpy as np
import torch as th

from helpers import MakePEARL


def test_values_are_those_of_the_smaller_critic(tiny_pearl: MakePEARL) -> None:
    policy = tiny_pearl().policy
    with th.no_grad():
        networks: Any = policy.critic.networks
        for value, network in zip((7.0, 3.0), networks, strict=True):
            network[-1].weight.zero_()
            network[-1].bias.fill_(value)
        values = policy.values(np.zeros((2, 2), dtype=np.float32), th.randn(2, 4, policy.latent_dim))
    assert values.tolist() == [[3.0] * 4] * 2
