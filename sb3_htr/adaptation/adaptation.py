"""Adaptation to tasks, one per env, from nothing but the episodes of this adaptation."""

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_htr.adaptation.explorers import Explorer
from sb3_htr.adaptation.knowledge import LatentKnowledge
from sb3_htr.adaptation.policy import ContextualPolicy
from sb3_htr.common.task_reward import task_reward
from sb3_htr.common.type_aliases import Context
from sb3_htr.htr.groups import evenly_spread, positions

# Of observations, actions and rewards: networks see float32, of which larger ones have no squares
LARGEST = 1e18


class Step(NamedTuple):
    """
    One step of each env.

    :param observations: (n_envs, obs_dim), what the actions were chosen for
    :param actions: (n_envs, action_dim), scaled to [-1, 1]
    :param rewards: (n_envs,)
    :param next_observations: (n_envs, obs_dim), the last one of its episode where one ended
    :param dones: (n_envs,) bool, where an episode ended
    :param infos: one dict per env. A loop of one's own needs none: they are for meta-training, and for those who watch
    :param new_observations: (n_envs, obs_dim), what is acted on next: where an episode ended, the first of the next one. For
        callbacks of a training
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]] = []  # noqa: RUF012 nobody writes to it
    new_observations: np.ndarray | None = None


def check_scaled(actions: np.ndarray) -> None:
    """
    :param actions: (n_envs, action_dim), of a step that an adaptation observes
    :raises ValueError: if they are not in [-1, 1]
    """
    beyond = ~(np.abs(actions) <= 1 + 1e-5).all(axis=1)
    if beyond.any():
        env = int(beyond.argmax())
        raise ValueError(
            f"The actions of env {env} are {actions[env]}, expected numbers from -1 to 1: observe takes what act gave, which "
            "policy.scale_action makes so, and the robot what unscale_action makes of it."
        )


def check_rows(name: str, values: np.ndarray, *expected: int) -> None:
    """
    :param name: of the values
    :param values: of an env each
    :param expected: shape, beginning with the number of envs
    :raises ValueError: for another shape, NaN and infinity
    """
    if np.shape(values) != expected:
        raise ValueError(f"The {name} have shape {np.shape(values)}, expected {expected}, a row for each env.")
    # Which nothing is that is NaN; in a float16, the bound would be infinite
    usual = np.abs(values, dtype=np.float64) <= LARGEST
    if not usual.all():
        env = int((~usual).reshape(len(values), -1).any(axis=1).argmax())
        raise ValueError(
            f"The {name} of env {env} are {values[env]}, expected finite numbers up to {LARGEST:g}: they would be taken "
            "for evidence. Begin a new Adaptation once the env is mended."
        )


def check_step(step: Step, n_envs: int, obs_dim: int, action_dim: int) -> None:
    """
    :param step: of arrays, that an adaptation observes
    :param n_envs: number of tasks that it adapts to
    :param obs_dim: width of an observation
    :param action_dim: width of an action
    :raises ValueError: for arrays of other shapes, NaN and infinity, and actions that are not scaled
    """
    check_rows("observations", step.observations, n_envs, obs_dim)
    check_rows("rewards", step.rewards, n_envs)
    check_rows("next_observations", step.next_observations, n_envs, obs_dim)
    check_rows("actions", step.actions, n_envs, action_dim)
    check_rows("dones", step.dones, n_envs)
    check_scaled(step.actions)


class Adaptation:
    """
    Keeps the episodes of an adaptation and infers the posterior over z from those that the explorer wants in it.

    Act with :meth:`act`, and feed every step to :meth:`observe`: the z that is acted with changes where an episode ends, and
    where the explorer turns elsewhere within one.

    :param policy: networks
    :param knowledge: what meta-training knows about z
    :param explorer: chooses z; not changed, this adaptation has a copy of its own, :attr:`explorer`
    :param n_envs: number of tasks
    :param gamma: discount of the critics' values
    :param context_size: steps of an episode that the posterior is inferred from, evenly spread, at most: as many as in
        meta-training, because each narrows it
    :param generator: source of randomness; torch's global one by default
    :param is_training: whether infos tell which part of a reward depends on no task. In meta-training they may; at meta-test
        nothing is used but observations, actions and rewards
    """

    def __init__(
        self,
        policy: ContextualPolicy,
        knowledge: LatentKnowledge,
        explorer: Explorer,
        n_envs: int,
        *,
        gamma: float,
        context_size: int,
        generator: th.Generator | None = None,
        is_training: bool = False,
    ) -> None:
        self.policy = policy
        self.knowledge = knowledge
        self.n_envs = n_envs
        self.gamma = gamma
        self.context_size = context_size
        self.generator = generator
        self.is_training = is_training
        self.n_episodes = np.zeros(n_envs, dtype=np.int64)
        # Rewards of the task, 0 for steps without: of the latest step, of the running episodes, and the largest sum of those
        # that have ended
        self.task_reward = np.zeros(n_envs, dtype=np.float64)
        self.episode_return = np.zeros(n_envs, dtype=np.float64)
        self.best_return = np.zeros(n_envs, dtype=np.float64)
        #: (n_envs,) what the most rewarded step returned beside what it would without success, taken for one or not
        self.largest_reward = np.zeros(n_envs, dtype=np.float64)
        # Of the running episodes, as a context has them; beside it, rewards of the task
        self._running: list[np.ndarray] = []
        self._n_steps = np.zeros(n_envs, dtype=np.int64)
        self._state = policy.encoder.empty(n_envs)
        self._watch = None if is_training else knowledge.reward_watch(n_envs)
        self.explorer = explorer.begin(self)

    @property
    def z(self) -> np.ndarray:
        """(n_envs, latent_dim) float32, the task variable to act with."""
        z, shape = np.asarray(self.explorer.z, dtype=np.float32), (self.n_envs, self.policy.latent_dim)
        if z.shape != shape:
            raise ValueError(f"The z of the explorer {self.explorer.name!r} has shape {z.shape}, expected {shape}.")
        if not np.isfinite(z).all():
            raise ValueError(f"The z of the explorer {self.explorer.name!r} is {z}, expected finite numbers.")
        return z

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        :param obs: (n_envs, obs_dim)
        :param deterministic: mean actions instead of samples
        :return: (n_envs, action_dim), scaled to [-1, 1]
        :raises ValueError: for an array of another shape, NaN and infinity
        """
        obs = np.asarray(obs)
        if not self.is_training:
            check_rows("observations", obs, self.n_envs, self.policy.obs_dim)
        self.explorer.look(obs)
        return self.policy.act(obs, self.z, deterministic)

    def exploring(self) -> np.ndarray:
        """
        :return: (n_envs,) bool, see :meth:`Explorer.exploring`
        """
        return self.explorer.exploring()

    def deviation(self) -> np.ndarray:
        """
        :return: (n_envs,), standard deviation of what is known about z, mean over its dimensions
        """
        return np.asarray(self.explorer.deviation().mean(axis=1))

    def observe(self, step: Step) -> None:
        """
        :param step: what each env did
        :raises ValueError: for arrays of other shapes, NaN and infinity, and actions that are not scaled
        """
        obs, actions, rewards, next_obs, dones = map(np.asarray, step[:5])
        step = Step(obs, actions, rewards, next_obs, dones, step.infos)
        if not self.is_training:  # what is collected is checked where it is stored
            check_step(step, self.n_envs, self.policy.obs_dim, self.policy.action_dim)
        self.task_reward = self._told(step) if self.is_training else self._learned(step)
        self._remember(step.observations, step.actions, step.rewards, step.next_observations, self.task_reward)
        self.episode_return += self.task_reward
        ended = np.flatnonzero(step.dones)
        self.n_episodes[ended] += 1
        self.best_return[ended] = np.maximum(self.best_return[ended], self.episode_return[ended])
        self.explorer.observe(step)
        self.episode_return[ended] = 0
        self._n_steps[ended] = 0

    @staticmethod
    def _told(step: Step) -> np.ndarray:
        # In the replay's type: what differs by rounding alone is no reward
        task_free = np.array([info.get("task_free_reward", 0.0) for info in step.infos], dtype=np.float32)
        return task_reward(np.asarray(step.rewards, dtype=np.float32), task_free)

    def _learned(self, step: Step) -> np.ndarray:
        policy, device = self.policy, self.policy.device
        with th.no_grad():
            obs, action, next_obs = (
                th.as_tensor(x, dtype=th.float32, device=device)
                for x in (step.observations, step.actions, step.next_observations)
            )
            task_free = policy.reward_model.task_free(policy.normalize(obs), action, policy.normalize(next_obs))
        beside = step.rewards - task_free.cpu().numpy()
        self.largest_reward = np.maximum(self.largest_reward, beside)
        if self._watch is None:
            return np.where(beside > self.knowledge.threshold.item(), beside, 0.0)
        return np.where(self._watch.rewarded(beside, np.asarray(step.dones, dtype=bool)), beside, 0.0)

    def _remember(self, *columns: np.ndarray) -> None:
        if not self._running:
            self._running = [np.zeros((self.n_envs, 64, *column.shape[1:]), dtype=np.float32) for column in columns]
        elif self._n_steps.max() == self._running[0].shape[1]:
            self._running = [np.concatenate([values, np.zeros_like(values)], axis=1) for values in self._running]
        for values, column in zip(self._running, columns, strict=True):
            values[np.arange(self.n_envs), self._n_steps] = column
        self._n_steps += 1

    def infer(self, envs: np.ndarray, keep: bool) -> None:
        """
        Take the running episodes of some envs into their posteriors.

        :param envs: (k,) int; of those whose episode has no step yet there is nothing to take in
        :param keep: what is in their posteriors already; if not, it is forgotten
        """
        if not keep:
            self._state[envs] = self.policy.encoder.empty(len(envs))
        envs = envs[self._n_steps[envs] > 0]
        if len(envs) == 0:
            return
        n_steps = self._n_steps[envs]
        *columns, task_reward = self._running
        steps, lengths = evenly_spread(n_steps, self.context_size, task_reward[np.repeat(envs, n_steps), positions(n_steps)])
        at, device = (np.repeat(envs, lengths), steps), self.policy.device
        context = Context(*(th.as_tensor(array, device=device) for array in (*(column[at] for column in columns), lengths)))
        with th.no_grad():
            self._state[envs] = self.policy.extend_posterior(self._state[envs], context)

    def posterior(self, envs: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """
        :param envs: (k,) int, all by default
        :return: mean and standard deviation (k, latent_dim), those of N(0, I) where no episode was taken in
        """
        state = self._state if envs is None else self._state[envs]
        with th.no_grad():
            mean, variance = self.policy.encoder.posterior(state)
        return mean.cpu().numpy(), np.sqrt(variance.cpu().numpy())

    def sample_posterior(self, envs: np.ndarray, widening: np.ndarray | float = 1.0) -> np.ndarray:
        """
        :param envs: (k,) int
        :param widening: (k, 1), what the posteriors' standard deviations are multiplied by
        :return: (k, latent_dim), a draw from each of their posteriors
        """
        mean, deviation = self.posterior(envs)
        return np.asarray(mean + deviation * np.float32(widening) * self.noise(len(envs)))

    def noise(self, n: int) -> np.ndarray:
        """
        :param n: number of draws
        :return: (n, latent_dim) float32, draws from N(0, I)
        """
        return np.asarray(th.randn(n, self.policy.latent_dim, generator=self.generator).numpy())
