"""What is left of a policy when all that it has to do is to act."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_htr.common.latent_policy import LatentPolicy
from sb3_htr.common.linear import with_fast_layers
from sb3_htr.common.normalizer import ObservationNormalizer

ACTIVATIONS: dict[str, type[nn.Module]] = {
    kind.__name__: kind for kind in (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU)
}


class ActorAlone(LatentPolicy):
    """
    Actor and normalization of observations, without critics and encoder.

    :param observation_space: Box, without the task variable
    :param action_space: Box
    :param net_arch: hidden units
    :param latent_dim: dimension of z
    :param activation_fn: between layers
    :param normalized: whether observations are normalized
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        net_arch: list[int],
        latent_dim: int,
        activation_fn: type[nn.Module],
        normalized: bool,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=True)
        self.activation_fn = activation_fn
        self.latent_dim = latent_dim
        (obs_dim,) = observation_space.shape
        of_actor = spaces.Box(-np.inf, np.inf, (obs_dim + latent_dim,), np.float32)
        extractor = FlattenExtractor(of_actor)
        self.actor = Actor(of_actor, action_space, net_arch, extractor, extractor.features_dim, activation_fn)
        with_fast_layers(self.actor)
        self.normalizer = ObservationNormalizer(obs_dim) if normalized else None

    def _act(self, obs_z: th.Tensor, deterministic: bool) -> th.Tensor:
        actions: th.Tensor = self.actor(obs_z, deterministic)
        return actions


def acting_state(policy: Any) -> dict[str, Any]:
    """
    :param policy: a PEARLPolicy, or an :class:`ActorAlone`
    :return: tensors, numbers and text, for :func:`make_actor_alone`
    :raises ValueError: if it has an actor of its own, or acts in another way than its actor says
    """
    activation = policy.activation_fn.__name__
    if type(policy.actor) is not Actor or ACTIVATIONS.get(activation) is not policy.activation_fn:
        raise ValueError(
            f"Only SB3's Actor with one of the activations {', '.join(ACTIVATIONS)} can be saved alone: save the model."
        )
    state = {
        "observation_space": _box_state(policy.observation_space),
        "action_space": _box_state(policy.action_space),
        "activation": activation,
        "actor": policy.actor.state_dict(),
        "normalizer": None if policy.normalizer is None else policy.normalizer.state_dict(),
    }
    rng = np.random.default_rng(0)
    obs = rng.uniform(-1, 1, (16, *policy.observation_space.shape)).astype(np.float32)
    z = rng.standard_normal((16, policy.latent_dim)).astype(np.float32)
    alone = make_actor_alone(state, policy.latent_dim)
    actions, expected = (actor.predict(obs, (z,), deterministic=True)[0] for actor in (alone, policy))
    # However small the actions of an env are
    if not (np.abs(actions - expected) <= 1e-3 * (policy.action_space.high - policy.action_space.low)).all():
        raise ValueError("The policy is a class of its own that acts in a way of its own: save the model.")
    return state


def make_actor_alone(state: dict[str, Any], latent_dim: int) -> ActorAlone:
    """
    :param state: of :func:`acting_state`
    :param latent_dim: dimension of z
    :return: a policy that acts as that one
    :raises Exception: of many kinds, if the state is something else; before there is memory for more than it has
    """
    hidden = [name for name in state["actor"] if name.startswith("latent_pi.") and name.endswith(".weight")]
    with th.device("meta"):
        policy = ActorAlone(
            _box(state["observation_space"]),
            _box(state["action_space"]),
            net_arch=[len(state["actor"][name]) for name in sorted(hidden, key=lambda name: int(name.split(".")[1]))],
            latent_dim=latent_dim,
            activation_fn=ACTIVATIONS[state["activation"]],
            normalized=state["normalizer"] is not None,
        )
    policy.actor.load_state_dict({name: weight.float() for name, weight in state["actor"].items()}, assign=True)
    if policy.normalizer is not None:
        policy.normalizer.load_state_dict(state["normalizer"], assign=True)
    policy.set_training_mode(False)
    return policy


def _box_state(box: spaces.Box) -> dict[str, th.Tensor]:
    return {"low": th.from_numpy(box.low.copy()), "high": th.from_numpy(box.high.copy())}


def _box(state: dict[str, th.Tensor]) -> spaces.Box:
    low, high = state["low"].numpy(), state["high"].numpy()
    return spaces.Box(low, high, dtype=low.dtype.type)
