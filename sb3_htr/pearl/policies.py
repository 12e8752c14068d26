"""Networks of PEARL: SAC's actor and critics conditioned on the task variable z, and the context encoder."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn

from sb3_htr.common.latent_policy import LatentPolicy
from sb3_htr.common.linear import Linear, Stack, with_fast_layers
from sb3_htr.common.normalizer import ObservationNormalizer
from sb3_htr.common.settings import check_class, check_flags, check_layers, check_mappings, check_numbers
from sb3_htr.common.type_aliases import Context
from sb3_htr.pearl.encoder import ContextEncoder, to_encoder_class
from sb3_htr.pearl.reward_model import RewardModel


class LatentCritic(BaseModel):
    """
    Ensemble of Q(o, a, z) networks with layer normalization, which keeps the bootstrapped targets of unseen z bounded.

    One network after the other: a batched product of all of them is no faster than its parts, and keeps out of oneDNN.

    :param observation_space: space of (o, z)
    :param action_space: Box
    :param net_arch: hidden units per layer
    :param activation_fn: activation between layers
    :param n_critics: number of networks
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        n_critics: int,
    ) -> None:
        super().__init__(observation_space, action_space)
        units = [observation_space.shape[0] + action_space.shape[0], *net_arch]

        def network() -> Stack:
            hidden = [(Linear(i, o), nn.LayerNorm(o), activation_fn()) for i, o in pairwise(units)]
            return Stack(*(module for layer in hidden for module in layer), Linear(units[-1], 1))

        self.networks = nn.ModuleList(network() for _ in range(n_critics))

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param obs: (n, obs_dim + latent_dim)
        :param actions: (n, action_dim), scaled to [-1, 1]
        :return: (n_critics, n)
        """
        x = th.cat([obs, actions], dim=1)
        return th.cat([network(x).T for network in self.networks])


def _checked_arch(net_arch: Any) -> list[int] | dict[str, list[int]]:
    """For both actor and critics, or for each; SB3 takes lists alone."""
    if not isinstance(net_arch, dict):
        check_layers(net_arch=net_arch)
        return [*net_arch]
    if net_arch.keys() != {"pi", "qf"}:
        raise ValueError(f"net_arch is {net_arch}, expected layers for 'pi' and 'qf', or a list for both.")
    check_layers(**net_arch)
    return {name: [*units] for name, units in net_arch.items()}


class PEARLPolicy(LatentPolicy, SACPolicy):
    """
    Actor, critics and context encoder of PEARL, and a model of rewards.

    :param observation_space: Box, without the task variable
    :param action_space: Box
    :param lr_schedule: learning rate
    :param net_arch: hidden units of actor and critics, or ``{"pi": ..., "qf": ...}``; ``[128, 128]`` by default (our choice;
        paper A.2: ``[300, 300, 300]``)
    :param encoder_arch: hidden units of the context encoder, ``[128, 128]`` by default (our choice; paper A.2:
        ``[200, 200, 200]``)
    :param encoder_class: what infers z, see :class:`ContextEncoder`; or the name of one of :mod:`sb3_htr.pearl.encoder`
    :param latent_dim: dimension of z (paper A.2: 5)
    :param use_next_obs_in_context: a row of the context is (o, a, r, o'), for tasks that differ in their dynamics (as in
        PEARL's reference, which has it for such families alone)
    :param normalize_observations: all networks see observations less their running mean in training, divided by the standard
        deviation, and clipped to [-10, 10]. By measurement (one seed each), the Wheeled robot learns in half the steps with
        it, and the Point Robot as well as without it
    :param activation_fn: activation of all networks
    :param n_critics: number of critics
    :param optimizer_class: optimizer of all networks
    :param optimizer_kwargs: its arguments, without the learning rate; Adam is fused unless told otherwise
    :raises ValueError: for a setting that is none
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        encoder_arch: list[int] | None = None,
        encoder_class: type[ContextEncoder] | str = ContextEncoder,
        latent_dim: int = 5,
        use_next_obs_in_context: bool = False,
        normalize_observations: bool = True,
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 2,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        check_numbers(latent_dim=(latent_dim, 1), n_critics=(n_critics, 1))
        check_flags(normalize_observations=normalize_observations, use_next_obs_in_context=use_next_obs_in_context)
        check_mappings(optimizer_kwargs=optimizer_kwargs)
        encoder_arch = [128, 128] if encoder_arch is None else encoder_arch
        check_layers(encoder_arch=encoder_arch)
        check_class("activation_fn", activation_fn, nn.Module)
        check_class("optimizer_class", optimizer_class, th.optim.Optimizer)
        if optimizer_class is th.optim.Adam and not {"foreach", "differentiable"} & {*(optimizer_kwargs or ())}:
            optimizer_kwargs = {"fused": True, **(optimizer_kwargs or {})}
        self.latent_dim = latent_dim
        self.encoder_arch = encoder_arch
        self.encoder_class = to_encoder_class(encoder_class)
        self.use_next_obs_in_context = use_next_obs_in_context
        self.normalize_observations = normalize_observations
        obs_dim, action_dim = (int(np.prod(space.shape)) for space in (observation_space, action_space))
        self.obs_dim, self.action_dim = obs_dim, action_dim
        # SB3's networks are built for the observation (o, z)
        super().__init__(
            spaces.Box(-np.inf, np.inf, (obs_dim + latent_dim,), np.float32),
            action_space,
            lr_schedule,
            net_arch=_checked_arch([128, 128] if net_arch is None else net_arch),
            activation_fn=activation_fn,
            n_critics=n_critics,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )
        self.observation_space = observation_space

    @property
    def device(self) -> th.device:
        """Where the networks are. SB3 looks for it among all parameters, which takes longer than to act."""
        return next(self.actor.parameters()).device if hasattr(self, "actor") else th.get_default_device()

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self._check_actor()
        self._actor_is_plain = type(self.actor) is Actor and type(self.actor.features_extractor) is FlattenExtractor
        self.normalizer = ObservationNormalizer(self.obs_dim) if self.normalize_observations else None
        context_dim = self.obs_dim * (1 + self.use_next_obs_in_context) + self.action_dim + 1
        self.encoder = self.encoder_class(context_dim, self.latent_dim, self.encoder_arch, self.activation_fn)
        self.reward_model = RewardModel(self.obs_dim, self.action_dim, self.latent_dim)
        for network in (self.encoder, self.reward_model):
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )
        self.critic_target.requires_grad_(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        with_fast_layers(actor)
        return actor

    def _check_actor(self) -> None:
        """What a subclass makes is asked for its distributions alone."""
        if not isinstance(self.actor, Actor):
            raise ValueError(f"The actor is {type(self.actor).__name__}, expected a class derived from SB3's Actor.")
        for name in ("forward", "_predict", "action_log_prob"):
            if getattr(type(self.actor), name) is not getattr(Actor, name):
                raise ValueError(
                    f"The actor {type(self.actor).__name__} overrides {name}, which nothing calls: override "
                    "get_action_dist_params, which is all that it is asked for."
                )

    def make_critic(self, features_extractor: nn.Module | None = None) -> LatentCritic:  # type: ignore[override]
        kwargs: dict[str, Any] = self.critic_kwargs
        return LatentCritic(
            kwargs["observation_space"],
            kwargs["action_space"],
            kwargs["net_arch"],
            kwargs["activation_fn"],
            kwargs["n_critics"],
        ).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        keys = ("lr_schedule", "net_arch", "activation_fn", "n_critics", "optimizer_class", "optimizer_kwargs")
        return dict(
            observation_space=self.observation_space,
            action_space=self.action_space,
            encoder_arch=self.encoder_arch,
            encoder_class=self.encoder_class,
            latent_dim=self.latent_dim,
            use_next_obs_in_context=self.use_next_obs_in_context,
            normalize_observations=self.normalize_observations,
            **{key: data[key] for key in keys},
        )

    def act(self, obs: np.ndarray, z: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """
        What :meth:`predict` does, without its checks and conversions, which take longer: for every step of a rollout and of an
        adaptation, so that a ``predict`` of a subclass has no say in them.

        :param obs: (n, obs_dim)
        :param z: (n, latent_dim) float32
        :param deterministic: mean actions instead of samples
        :return: (n, action_dim), scaled to [-1, 1]
        """
        with th.no_grad():
            normal = self.normalize(th.as_tensor(obs, dtype=th.float32, device=self.device))
            obs_z = th.cat([normal, th.as_tensor(z, device=self.device)], dim=1)
            return np.asarray(self._act(obs_z, deterministic).cpu().numpy())

    def update_normalizer(self, obs: np.ndarray) -> None:
        """
        :param obs: (n, obs_dim), newly observed in training: what observations are normalized by follows them
        """
        if self.normalizer is not None:
            self.normalizer.update(obs)

    def extend_posterior(self, state: th.Tensor, context: Context) -> th.Tensor:
        """
        :param state: (n_tasks, ...), what the encoder has taken in of each task before
        :param context: transitions as they were collected
        :return: (n_tasks, ...), with these taken in
        """
        columns = [self.normalize(context.observations), context.actions, context.rewards[:, None]]
        if self.use_next_obs_in_context:
            columns.append(self.normalize(context.next_observations))
        return self.encoder.extend(state, th.cat(columns, dim=1), context.lengths)

    def infer(self, context: Context) -> tuple[th.Tensor, th.Tensor]:
        """
        :param context: transitions as they were collected
        :return: mean and variance (n_tasks, latent_dim) of the posteriors over z
        """
        return self.encoder.posterior(self.extend_posterior(self.encoder.empty(len(context.lengths)), context))

    def values(self, obs: np.ndarray, z: th.Tensor) -> th.Tensor:
        """
        :param obs: (n, obs_dim)
        :param z: (n, k, latent_dim)
        :return: (n, k), the smaller critic's value of acting with each z
        """
        n, k, _ = z.shape
        normal = self.normalize(th.as_tensor(obs, dtype=th.float32, device=self.device))
        obs_z = th.cat([normal.repeat_interleave(k, dim=0), z.reshape(n * k, -1)], dim=1)
        return self.critic(obs_z, self._act(obs_z, deterministic=True)).amin(dim=0).reshape(n, k)

    def _act(self, obs_z: th.Tensor, deterministic: bool) -> th.Tensor:
        mean, log_std = self._gaussian(obs_z)
        return th.tanh(mean if deterministic else mean + log_std.exp() * th.randn_like(mean))

    def sample_actions(self, obs_z: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        The actor's ``action_log_prob`` without torch's distributions, whose checks take longer than the sampling.

        :param obs_z: (n, obs_dim + latent_dim)
        :return: actions (n, action_dim) in (-1, 1), and the logarithm of their density (n,), both differentiable
        """
        mean, log_std = self._gaussian(obs_z)
        noise = th.randn_like(mean)
        actions = th.tanh(mean + log_std.exp() * noise)
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # The density of tanh(x); SB3's epsilon
        return actions, (log_prob - th.log(1.0 - actions.square() + 1e-6)).sum(dim=1)

    def _gaussian(self, obs_z: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation of the actions before tanh."""
        if not self._actor_is_plain:
            mean, log_std, _ = self.actor.get_action_dist_params(obs_z)
            return mean, log_std
        # The same, without SB3's preprocessing, which takes longer than the products
        hidden = self.actor.latent_pi(obs_z)
        log_std = self.actor.log_std(hidden).clamp(LOG_STD_MIN, LOG_STD_MAX)  # type: ignore[operator]
        return self.actor.mu(hidden), log_std

    def set_training_mode(self, mode: bool) -> None:
        # predict() asks for it at every step, and telling all modules takes longer than the actor does
        if any(module.training != mode for module in (self, self.actor, self.critic, self.encoder)):
            self.train(mode)  # the model of rewards, too, which SB3 knows nothing of
            self.critic_target.eval()


MlpPolicy = PEARLPolicy
