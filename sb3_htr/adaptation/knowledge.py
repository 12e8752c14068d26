"""What meta-training knows about tasks before one of them gave any reward."""

from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_htr.adaptation.policy import ContextualPolicy
from sb3_htr.adaptation.reward_watch import RewardWatch
from sb3_htr.adaptation.task_bank import MAX_HINDSIGHT_TASKS, MAX_TRAIN_TASKS, TaskBank
from sb3_htr.common.linear import left_to_torch
from sb3_htr.common.segments import segment_sum

# Shares of unrewarded and rewarded steps that the threshold between the two may miss, the smallest that will do: the model
# that says what is task-free errs where that is rare and large, as a penalty for a fall is. Our choice
MISSED = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.5)
# Steps that are looked at under all tasks at once, to bound memory
CHUNK = 2**14
# Before anything is known, above 0 and below what a success is worth where it is worth 1
INITIAL_THRESHOLD = 0.5


class Particles(NamedTuple):
    """
    n tasks that meta-training has solved, as points in the space of z: what an unknown task may be like.

    :param z: (n, latent_dim), posterior mean given the best episode known for the task
    :param gain: (n, n), ``gain[i, j]``: mean reward of a rewarded step of episode i if task j is the true one, by the reward
        model
    :param returns: (n, n), return of the whole of episode i if task j is the true one, likewise
    :param log_prior: (n,), logarithm of the probability that an unknown task is like this one
    :param is_train: (n,) bool, training tasks; the others are hindsight tasks
    """

    z: th.Tensor
    gain: th.Tensor
    returns: th.Tensor
    log_prior: th.Tensor
    is_train: th.Tensor


class LatentKnowledge(nn.Module):
    """
    What explorers start from; saved with the model, not trained by gradients.

    Kept are the *aggregate*, mean and covariance of the posterior means of recent meta-batches, which are far from N(0, I)
    while the KL term is weak; :class:`Particles`; the *threshold* above which a reward, less what is task-free of it, is a
    success; and the *task-free value*, the discounted return of steps that never succeed.

    :param latent_dim: dimension of z
    """

    mean: th.Tensor
    cholesky: th.Tensor
    threshold: th.Tensor
    task_free_value: th.Tensor
    n_particles: th.Tensor
    z: th.Tensor
    gain: th.Tensor
    returns: th.Tensor
    log_prior: th.Tensor
    is_train: th.Tensor

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        n = MAX_TRAIN_TASKS + MAX_HINDSIGHT_TASKS
        self.register_buffer("mean", th.zeros(latent_dim))
        self.register_buffer("cholesky", th.eye(latent_dim))
        # Above it, what a step returned beside the task-free part is a reward of the task
        self.register_buffer("threshold", th.tensor(INITIAL_THRESHOLD))
        # Discounted sum of what unrewarded steps return, forever
        self.register_buffer("task_free_value", th.zeros(()))
        self.register_buffer("n_particles", th.zeros((), dtype=th.int64))
        for name, shape in (("z", (n, latent_dim)), ("gain", (n, n)), ("returns", (n, n)), ("log_prior", (n,))):
            self.register_buffer(name, th.zeros(shape))
        self.register_buffer("is_train", th.zeros(n, dtype=th.bool))

    @property
    def tells_rewards(self) -> bool:
        """Whether rewards tell a success. Those of a family without reward hooks do not: the threshold is infinite."""
        return bool(self.threshold < float("inf"))

    def reward_watch(self, n_envs: int) -> RewardWatch | None:
        """
        :param n_envs: number of envs of an adaptation
        :return: what notices rewards unlike those of meta-training; None if no task was solved there by which one could
        """
        n, threshold = int(self.n_particles), self.threshold.item()
        if not self.tells_rewards or n == 0:
            return None
        # The threshold is in the middle, and is known before the model of rewards has learned what a success is worth
        return RewardWatch(n_envs, threshold, max(2 * threshold, self.gain[:n, :n].max().item()))

    def set_tells_rewards(self, tells_rewards: bool) -> None:
        """
        :param tells_rewards: whether the task family tells rewards and successes
        """
        if tells_rewards != self.tells_rewards:
            self.threshold.fill_(INITIAL_THRESHOLD if tells_rewards else float("inf"))

    def learn(self, policy: ContextualPolicy, means: th.Tensor, bank: TaskBank, gamma: float) -> None:
        """
        :param policy: networks as they are now
        :param means: (n, latent_dim), posterior means of recent meta-batches
        :param bank: tasks that were solved; it is told how likely they are
        :param gamma: discount
        """
        self.set_aggregate(means)
        # A loaded model's particles are kept until this training knows as many tasks, or as many training tasks
        n_known = int(self.is_train[: int(self.n_particles)].sum())
        knows_enough = bank.n_train_solved >= min(n_known, bank.n_train) or bank.n_solved >= int(self.n_particles)
        if bank.n_solved > 0 and knows_enough:
            # Each time, the solved tasks have another number of steps
            with th.no_grad(), left_to_torch():
                particles = self._solved(policy, bank, gamma)
            self.set_particles(particles)
            bank.rank(particles.log_prior.cpu().numpy())

    def set_aggregate(self, means: th.Tensor) -> None:
        """
        :param means: (n, latent_dim), posterior means of recent meta-batches
        """
        self.mean.copy_(means.mean(dim=0))
        centred = (means - self.mean).double()
        covariance = centred.T @ centred / len(means)
        # However large the means are, and if they are all the same
        jitter = (1e-6 + 1e-9 * covariance.trace()) * th.eye(self.latent_dim, dtype=th.float64, device=means.device)
        self.cholesky.copy_(th.linalg.cholesky(covariance + jitter))

    def sample_aggregate(self, n: int, scale: float, generator: th.Generator | None = None) -> np.ndarray:
        """
        :param n: number of draws
        :param scale: standard deviations of the aggregate are multiplied by this
        :param generator: source of randomness
        :return: (n, latent_dim)
        """
        noise = th.randn(n, self.latent_dim, generator=generator).to(self.mean.device)
        return np.asarray((self.mean + scale * noise @ self.cholesky.T).cpu().numpy())

    def _solved(self, policy: ContextualPolicy, bank: TaskBank, gamma: float) -> Particles:
        """A particle for each solved task; sets beside them what tells rewards from what is task-free."""
        solved, columns, model = bank.solved(), bank.transitions, policy.reward_model
        data = th.as_tensor(solved.rows, device=policy.device)
        lengths = th.as_tensor(solved.lengths, device=policy.device)
        action, reward = data[:, columns.action], data[:, columns.reward]
        z, _ = policy.infer(columns.context(solved.rows, solved.lengths, policy.device))
        obs, next_obs = (policy.normalize(data[:, column]) for column in (columns.observation, columns.next_observation))
        # Of the steps that are rewarded: chance of a reward, and reward to be expected, under each task
        success = th.as_tensor(solved.success, device=policy.device)
        episode = th.repeat_interleave(th.arange(len(z), device=z.device), lengths)
        tasks = model.task_tower(z)
        overlap, earned = (th.zeros(len(z), len(z), device=z.device) for _ in range(2))
        for of_chunk in th.arange(len(data), device=z.device).split(CHUNK):
            states = model.state_tower(next_obs[of_chunk])
            chance = model.success_logits(states, tasks).sigmoid() * success[of_chunk, None]
            of_episode = th.bincount(episode[of_chunk], minlength=len(z))
            overlap += segment_sum(chance, of_episode)
            earned += segment_sum(chance * model.success_rewards(states, tasks).clamp(min=0), of_episode)
        n_rewarded = th.zeros_like(z[:, 0]).index_add(0, episode, success.to(z.dtype)).clamp(min=1)[:, None]
        overlap /= n_rewarded
        share = (earned / earned.diag().clamp(min=1e-6)[:, None]).clamp(0, 1.2).fill_diagonal_(1)
        is_train, returns = (th.as_tensor(x, device=z.device) for x in (solved.is_train, solved.returns))
        task_free = model.task_free(obs, action, next_obs)
        self.task_free_value.copy_(task_free.mean() / max(1 - gamma, 1e-3))
        beside = reward - task_free
        # Of long episodes, the steps that the bank keeps may miss all that were rewarded
        if success.any():
            self.threshold.copy_(_between(beside[~success], beside[success]))
        return Particles(z, earned / n_rewarded, share * returns[:, None], _log_prior(z, overlap, is_train), is_train)

    def set_particles(self, particles: Particles) -> None:
        """
        :param particles: in place of those that were there
        """
        n = len(particles.z)
        self.z[:n], self.gain[:n, :n], self.returns[:n, :n], self.log_prior[:n], self.is_train[:n] = particles
        self.n_particles.fill_(n)

    def particles(self) -> Particles:
        """
        :return: what an unknown task may be like; none before meta-training has solved a task
        """
        n = int(self.n_particles)
        return Particles(self.z[:n], self.gain[:n, :n], self.returns[:n, :n], self.log_prior[:n], self.is_train[:n])


def _between(unrewarded: th.Tensor, rewarded: th.Tensor) -> th.Tensor:
    """The middle between what most unrewarded steps and most rewarded ones return, which is () for (n,) and (m,)."""
    missed, kept = (th.tensor(shares, device=rewarded.device) for shares in (MISSED, [1 - share for share in MISSED]))
    low = unrewarded.quantile(kept) if len(unrewarded) else th.zeros_like(missed)
    high = rewarded.quantile(missed)
    # The last one where nothing tells them apart
    is_between = (low < high) | (missed == missed[-1])
    return ((low + high) / 2)[is_between][0]


def _log_prior(z: th.Tensor, overlap: th.Tensor, is_train: th.Tensor) -> th.Tensor:
    """
    Heavy tails around the training tasks, evenly over tasks: proportional to 1 / (1 + d^2) and inverse to the number of
    particles that are alike. d is the distance in z to the nearest training task, in units of the distance at which two tasks
    are half alike. (n,)
    """
    distance = th.cdist(z, z)
    half_alike = distance[(overlap > 0.3) & (overlap < 0.7)]
    unit = (half_alike if len(half_alike) else distance).median().clamp(min=1e-6)
    # Before a training task is solved, all hindsight tasks are as likely
    nearest = distance[:, is_train].amin(dim=1) / unit if is_train.any() else th.zeros_like(z[:, 0])
    weight = 1 / ((1 + nearest.square()) * overlap.sum(dim=0).clamp(min=1))
    return (weight / weight.sum()).clamp(min=1e-12).log()
