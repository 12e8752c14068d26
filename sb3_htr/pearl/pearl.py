"""PEARL: encoder, critics and actor, and how they learn."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_htr.adaptation.explorers import Explorer
from sb3_htr.common.divergence import check_not_diverged
from sb3_htr.common.segments import repeat_segments
from sb3_htr.common.settings import check_entropy, check_flags, check_numbers
from sb3_htr.common.type_aliases import MultiTaskSamples
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.pearl.divergence import check_posterior
from sb3_htr.pearl.encoder import ContextEncoder, kl_to_prior
from sb3_htr.pearl.graphed_update import FixedUpdate, GraphedUpdate, Outcome, can_be_captured
from sb3_htr.pearl.matmul import PRECISIONS, matmul_precision
from sb3_htr.pearl.off_policy_meta_algorithm import OffPolicyMetaAlgorithm
from sb3_htr.pearl.padding import padded
from sb3_htr.pearl.policies import LatentCritic, MlpPolicy, PEARLPolicy

# By measurement on validation tasks of the Point Robot
LEARNING_RATE = LinearSchedule(start=1e-3, end=0.0, end_fraction=1.0)
# Transitions of a meta-batch that the reward model learns from, each under all its tasks
N_LABELLED = 256
# What is logged as train/ besides the values of a gradient step
LOGGED_BESIDE = ("relabelled_fraction", "rl_zero_reward_fraction", "kl_coef", "learning_rate", "n_updates")


class PEARL(OffPolicyMetaAlgorithm):
    """
    Probabilistic Embeddings for Actor-critic RL (PEARL), with Hindsight Task Relabelling (HTR) in its replay buffer.

    PEARL paper: https://arxiv.org/abs/1903.08254, HTR paper: https://arxiv.org/abs/2112.00901.
    Subclass of SB3's SAC, for its entropy coefficient and actor. As SAC after 2018, and unlike the paper, it has two target
    critics instead of a value network.

    One rollout collects whole episodes on ``n_tasks_per_rollout`` training tasks, as many at once as there are envs; then
    follow ``gradient_steps`` updates. The defaults are the fast profile for two CPU cores, found by measurement; seven of them
    follow from the time limit of the env (:func:`sb3_htr.pearl.horizon.settings_for`). The papers' values are in
    ``hyperparams/pearl_paper.yml`` and given here where they differ, those of PEARL's reference for its sparse point robot.

    :param policy: ``"MlpPolicy"`` or a subclass of PEARLPolicy
    :param env: env of a task family (see ``htr_envs.TaskEnv``), VecEnv of such envs, or registered id
    :param learning_rate: of all networks, may be a function of the remaining progress; falls from 1e-3 to 0 by default, for a
        stable end (paper: 3e-4)
    :param buffer_size: capacity in transitions, shared equally by the training tasks
    :param learning_starts: env steps with random actions before learning starts; by default as many as a rollout has whose
        episodes last to the time limit
    :param batch_size: transitions per task for actor and critics, fewer where fewer are at hand, an episode or 24 by default
        (PEARL's reference: 256)
    :param tau: soft update of the target critics, in (0, 1] (PEARL's reference: 0.005)
    :param gamma: discount in [0, 1], 1 - 2 / T for T steps of an episode by default, within 0.5 and 0.98, 0 for T of 1
        (PEARL's reference: 0.9, which it is there)
    :param n_steps: steps whose rewards a return counts before the critics' value is asked for. Values reach further back with
        each update, but what was done in these steps counts, whatever the task that it was done for: by measurement, 3 is
        better than 5 on the ant. By default one for every 60 steps of an episode, from 1 to 10 (PEARL's reference: 1)
    :param gradient_steps: updates after each rollout; by default one for 20 env steps of a rollout whose episodes last to the
        time limit, and so more where they end early (PEARL's reference: 1000)
    :param replay_buffer_class: a MultiTaskReplayBuffer
    :param replay_buffer_kwargs: its arguments, among them ``relabel_probability`` (K of HTR; at 0 nothing is relabelled)
    :param ent_coef: entropy coefficient, ``"auto"`` learns it (0.01 is the reward scale 100 of PEARL's reference)
    :param target_update_interval: updates between soft updates of the target critics
    :param target_entropy: for ``ent_coef="auto"``
    :param meta_batch_size: tasks per update (paper: 16)
    :param context_size: transitions per task for the context, fewer where fewer are at hand: under relabelling, at most an
        episode; an episode or 24 by default (PEARL's reference: 1024)
    :param kl_coef: 0 or more, weight of the KL divergence of the posterior from N(0, I), summed over z's dimensions and
        averaged over tasks, beside the critics' squared errors averaged over transitions (PEARL's reference, in these units:
        0.0016)
    :param final_kl_coef: above 0, to which this weight grows, or falls, by the end of training, by the same factor in equal
        times; it stays what it is by default (PEARL's reference)
    :param reward_coef: 0 or more, weight in z of the losses of the reward model, by which z learns to tell tasks apart; at 0,
        the model learns and leaves z alone. By measurement, on a two-link arm (one seed): .91 of the tasks are solved at 0,
        .99 and more at .5 and 2. It learns in each update: in one of four, at four times the weight, the Wheeled robot solves
        .90 of the validation tasks in place of all (one seed)
    :param n_tasks_per_rollout: training tasks per rollout, rounded up to a multiple of the envs, which all play
        (PEARL's reference: 10)
    :param n_episodes_per_task: episodes on each of them; by default as many as make up 400 steps, from 2 to 10
    :param explorer: chooses z at meta-test: an :class:`sb3_htr.adaptation.Explorer`, its name, or its name and settings,
        ``{"name": "prior", "n_exploration_episodes": 9}``
    :param train_explorer: the same for rollouts
    :param matmul_precision: of matrix products in updates, as for ``torch.set_float32_matmul_precision``. ``"medium"`` rounds
        their factors to bfloat16, which is faster where the processor has such products (docs/performance.md)
    :param cuda_graph: an update is one CUDA graph, for meta-batches that one task more, without a weight, fills up to as many
        rows as there can be: 5 to 6 times as fast on an H100 (docs/performance.md). By default on a GPU, where the optimizer
        can be captured, as Adam can. True on a CPU fills them up alike, and captures nothing
    :param stats_window_size: episodes over which logged returns are averaged
    :param tensorboard_log: folder for TensorBoard, none by default
    :param policy_kwargs: arguments of the policy: ``latent_dim``, ``net_arch``, ``encoder_arch`` (paper: 5, 3x300, 3x200),
        ``normalize_observations``, and all that :class:`PEARLPolicy` has
    :param verbose: 0 nothing, 1 info, 2 debug
    :param seed: seed of all random generators, from 0 to 2**32 - 1
    :param device: torch device
    :param _init_setup_model: build networks at once
    :raises ValueError: for a setting that is unknown or out of its range, an env without a task family or a time limit, and
        whatever else could not be trained on, each with what to do
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    policy: PEARLPolicy
    critic: LatentCritic  # type: ignore[assignment]
    critic_target: LatentCritic  # type: ignore[assignment]
    encoder: ContextEncoder

    def __init__(
        self,
        policy: str | type[PEARLPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = LEARNING_RATE,
        buffer_size: int = 1_000_000,
        learning_starts: int | None = None,
        batch_size: int | None = None,
        tau: float = 0.01,
        gamma: float | None = None,
        *,
        n_steps: int | None = None,
        gradient_steps: int | None = None,
        replay_buffer_class: type[MultiTaskReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        ent_coef: str | float = 0.01,
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        meta_batch_size: int = 64,
        context_size: int | None = None,
        kl_coef: float = 0.001,
        final_kl_coef: float | None = None,
        reward_coef: float = 2.0,
        n_tasks_per_rollout: int = 20,
        n_episodes_per_task: int | None = None,
        explorer: Explorer | dict[str, Any] | str = "belief",
        train_explorer: Explorer | dict[str, Any] | str = "aggregate",
        matmul_precision: str = "highest",
        cuda_graph: bool | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | np.integer[Any] | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy=policy,
            env=env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            gradient_steps=gradient_steps,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            context_size=context_size,
            n_tasks_per_rollout=n_tasks_per_rollout,
            n_episodes_per_task=n_episodes_per_task,
            explorer=explorer,
            train_explorer=train_explorer,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.meta_batch_size = meta_batch_size
        self.kl_coef = kl_coef
        self.final_kl_coef = final_kl_coef
        self.reward_coef = reward_coef
        self.matmul_precision = matmul_precision
        self.cuda_graph = cuda_graph
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_numbers(
            meta_batch_size=(self.meta_batch_size, 1),
            target_update_interval=(self.target_update_interval, 1),
            kl_coef=(self.kl_coef, 0.0),
            final_kl_coef=(self.kl_coef if self.final_kl_coef is None else self.final_kl_coef, 0.0),
            reward_coef=(self.reward_coef, 0.0),
            tau=(self.tau, 0.0, 1.0),
        )
        check_entropy(self.ent_coef, self.target_entropy)
        if self.tau == 0:
            raise ValueError("tau is 0, with which the target critics would never learn: expected a number above 0, up to 1.")
        if self.final_kl_coef is not None and 0 in (self.kl_coef, self.final_kl_coef):
            raise ValueError("kl_coef and final_kl_coef are a factor apart, so neither may be 0: expected numbers above 0.")
        if self.cuda_graph is not None:
            check_flags(cuda_graph=self.cuda_graph)
        if not callable(self.learning_rate):
            check_numbers(learning_rate=(self.learning_rate, 0.0))
        if self.matmul_precision not in PRECISIONS:
            raise ValueError(f"matmul_precision is {self.matmul_precision!r}, expected one of {list(PRECISIONS)}.")
        super()._setup_model()

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.encoder = self.policy.encoder
        self.reward_model = self.policy.reward_model

    def train(self, gradient_steps: int, batch_size: int = 16) -> None:
        """
        Update encoder, critics and actor, then what explorers know about z.

        :param gradient_steps: number of updates
        :param batch_size: transitions per task for actor and critics
        """
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        optimizers = [network.optimizer for network in (self.actor, self.critic, self.encoder, self.reward_model)]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        fixed = self._fixed_update(optimizers)
        # Meta-batches are filled up on the CPU, from where one copy brings all of it
        self.replay_buffer.device = self.device if fixed is None else th.device("cpu")
        with matmul_precision(self.matmul_precision):
            means, logs = zip(*(self._update(batch_size, fixed) for _ in range(gradient_steps)), strict=True)
        log_means = {key: th.stack([log[key] for log in logs]).mean().item() for key in logs[0]}
        check_not_diverged(self.policy, log_means, self._n_updates, self.num_timesteps)
        check_posterior(log_means["kl_divergence"], self._warn_once)
        for key, value in log_means.items():
            self.logger.record(f"train/{key}", value)
        for key, value in self.replay_buffer.stats().items():
            self.logger.record(key, value)
        self.logger.record("train/kl_coef", self._current_kl_coef())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        assert self.task_bank is not None
        self.policy.set_training_mode(False)
        self.knowledge.learn(self.policy, th.cat(means[-20:]), self.task_bank, self.gamma)

    def _current_kl_coef(self) -> float:
        if self.final_kl_coef is None:
            return self.kl_coef
        return float(self.kl_coef * (self.final_kl_coef / self.kl_coef) ** (1.0 - self._current_progress_remaining))

    def _fixed_update(self, optimizers: list[th.optim.Optimizer]) -> FixedUpdate | None:
        on_gpu = self.device.type == "cuda"
        is_fixed = on_gpu and can_be_captured(optimizers) if self.cuda_graph is None else self.cuda_graph
        if not is_fixed:
            return None
        if on_gpu:
            return GraphedUpdate(self._gradient_step, self.device, optimizers)
        return FixedUpdate(self._gradient_step, self.device)

    def _update(self, batch_size: int, fixed: FixedUpdate | None = None) -> Outcome:
        """
        One update of all networks.

        :param batch_size: transitions per task for actor and critics
        :param fixed: makes it, of a meta-batch that is filled up
        :return: posterior means (M, latent_dim), and what to log
        """
        assert self.replay_buffer is not None
        data = self.replay_buffer.sample(
            batch_size,
            meta_batch_size=self.meta_batch_size,
            context_size=self.context_size,
            n_labelled=N_LABELLED,
            n_steps=self.n_steps,
            gamma=self.gamma,
        )
        self._n_updates += 1
        update_target = self._n_updates % self.target_update_interval == 0
        if fixed is None:
            mean, log = self._gradient_step(data, update_target)
        else:
            n = self.meta_batch_size
            sizes = n * self.context_size + 1, n * batch_size + 1, min(N_LABELLED, n * batch_size)
            mean, log = fixed(padded(data, *sizes), update_target)
        log["relabelled_fraction"] = th.tensor(data.relabelled.mean())
        log["rl_zero_reward_fraction"] = th.tensor(data.unrewarded.mean())
        for listener in self.update_listeners:
            listener()
        return mean[: self.meta_batch_size], log

    def _gradient_step(self, data: MultiTaskSamples, update_target: bool) -> Outcome:
        """The part of an update that a GPU does, and that can be captured: it waits for no value."""
        # Each task has the same weight in a mean over transitions
        weight = repeat_segments(data.task_weights / data.lengths, data.lengths, len(data.rewards))
        # One backward pass through the encoder: it learns from the critics' errors, the KL term and the reward model's errors
        mean, variance = self.policy.infer(data.context)
        z = mean + variance.sqrt() * th.randn_like(mean)
        kl = (kl_to_prior(mean, variance) * data.task_weights).sum()
        z_rows = repeat_segments(z, data.lengths, len(data.rewards))
        obs, next_obs = self.policy.normalize(data.observations), self.policy.normalize(data.next_observations)
        obs_z = th.cat([obs, z_rows], dim=1)
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()
        with th.no_grad():
            next_obs_z = th.cat([next_obs, z_rows], dim=1)
            next_actions, next_log_prob = self.policy.sample_actions(next_obs_z)
            next_q = self.critic_target(next_obs_z, next_actions).amin(dim=0) - ent_coef * next_log_prob
            target_q = data.rewards + (1 - data.dones) * data.discounts * next_q
        q = self.critic(obs_z, data.actions)
        critic_loss = ((q - target_q).square() * weight).sum()
        learning = [self.critic.optimizer, self.encoder.optimizer]
        if data.labels is not None:
            learning.append(self.reward_model.optimizer)
        auxiliary_losses = self.auxiliary_losses(data, obs, z, mean, variance)
        loss = critic_loss + self._current_kl_coef() * kl + sum(auxiliary_losses.values())
        for optimizer in learning:
            optimizer.zero_grad()
        loss.backward()
        for optimizer in learning:
            optimizer.step()

        # The actor sees z, but does not shape it; the critics judge, and do not learn
        obs_z = obs_z.detach()
        actions_pi, log_prob = self.policy.sample_actions(obs_z)
        self.critic.requires_grad_(False)
        actor_loss = ((ent_coef * log_prob - self.critic(obs_z, actions_pi).amin(dim=0)) * weight).sum()
        self.critic.requires_grad_(True)
        self.actor.optimizer.zero_grad()
        actor_loss.backward()
        self.actor.optimizer.step()

        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            ent_coef_loss = -(self.log_ent_coef * ((log_prob.detach() * weight).sum() + float(self.target_entropy))).mean()
            self.ent_coef_optimizer.zero_grad()
            ent_coef_loss.backward()
            self.ent_coef_optimizer.step()
        if update_target:
            with th.no_grad():
                th._foreach_lerp_(list(self.critic_target.parameters()), list(self.critic.parameters()), self.tau)
        log = {
            "critic_loss": critic_loss.detach(),
            "actor_loss": actor_loss.detach(),
            "kl_divergence": kl.detach(),
            "ent_coef": ent_coef.detach().mean(),
            "posterior_std": (variance.detach().sqrt().mean(dim=1) * data.task_weights).sum(),
            "q_value": (q.detach().mean(dim=0) * weight).sum(),
            "rl_reward_mean": (data.rewards * weight).sum(),
        }
        if taken := sorted({*log, *LOGGED_BESIDE} & auxiliary_losses.keys()):
            raise ValueError(f"auxiliary_losses has a loss named {taken[0]}, which is logged already: choose another name.")
        log |= {name: value.detach() for name, value in auxiliary_losses.items()}
        return mean.detach(), log

    def auxiliary_losses(
        self, data: MultiTaskSamples, obs: th.Tensor, z: th.Tensor, mean: th.Tensor, variance: th.Tensor
    ) -> dict[str, th.Tensor]:
        """
        What is learnt beside the critics' errors and the KL term: here by the reward model, of success, of the reward of a
        success, and of the task-free part.

        A hook for a loss of one's own on z: override it, and add to what this returns. Networks that such a loss needs belong
        into the encoder, with which they learn and are saved. Where ``cuda_graph`` is on, no value may be waited for.

        :param data: meta-batch of M tasks; in a mean over them each has its ``data.task_weights``, which sum to 1
        :param obs: (N, obs_dim), its observations as networks see them, normalized
        :param z: (M, latent_dim), drawn from the posteriors, with gradients to the encoder
        :param mean: (M, latent_dim) of the posteriors
        :param variance: (M, latent_dim) of the posteriors
        :return: scalars, which are added to the loss of encoder and critics, and logged as ``train/`` and their name, which no
            other value has
        """
        labels = data.labels
        if labels is None:
            return {}
        obs, actions, next_obs = obs[labels.rows], data.actions[labels.rows], self.policy.normalize(labels.next_observations)
        # The values of z, of which the gradient is weighted
        success_loss, reward_loss = self.reward_model.losses(next_obs, th.lerp(z.detach(), z, self.reward_coef), labels)
        task_free_error = self.reward_model.task_free(obs, actions, next_obs) - labels.task_free
        return {
            "success_loss": success_loss,
            "reward_loss": reward_loss,
            "task_free_loss": (task_free_error.square() * labels.weights).sum(),
        }

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "encoder", "reward_model"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "encoder.optimizer", "reward_model.optimizer"], variables
