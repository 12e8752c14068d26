"""RL2: a recurrent policy whose memory is its adaptation, trained by sb3-contrib's RecurrentPPO."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.adaptation import Step
from sb3_htr.adaptation.loop import Adapting
from sb3_htr.common.checks import get_max_episode_steps
from sb3_htr.common.settings import check_numbers
from sb3_htr.rivals.adaptation import RivalAdaptation
from sb3_htr.rivals.on_policy import OnPolicyRival
from sb3_htr.rivals.trial_policy import TrialFeatures, TrialLstmPolicy
from sb3_htr.rivals.trials import LastStep, TrialVecEnv

N_EPISODES_PER_TRIAL = 5
N_TRIALS_PER_BATCH = 4


class TrialAdaptation(RivalAdaptation):
    """
    A trial in several envs. Episodes beyond a trial's length repeat its last one: the memory is each time what it was when the
    last one began, because training has shown it no more.

    :param policy: recurrent policy
    :param n_envs: number of tasks
    :param n_episodes_per_trial: episodes of a trial in training
    """

    def __init__(self, policy: RecurrentActorCriticPolicy, n_envs: int, n_episodes_per_trial: int) -> None:
        super().__init__(n_envs)
        self.policy = policy
        self.n_episodes_per_trial = n_episodes_per_trial
        self._last = LastStep(n_envs, policy.action_space.shape[0])  # type: ignore[index]
        self._n_episodes = np.zeros(n_envs, dtype=np.int64)
        lstm = policy.lstm_actor
        # Hidden and cell state; and what they and the last step were when the last episode of a trial began
        self._memory = np.zeros((2, lstm.num_layers, n_envs, lstm.hidden_size), dtype=np.float32)
        self._kept_memory, self._kept_last = self._memory.copy(), self._last.columns.copy()

    def act(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        self._check_observations(obs)
        begins = np.zeros(self.n_envs, dtype=bool)
        actions, memory = self.policy.predict(
            self._last.beside(obs), (self._memory[0], self._memory[1]), begins, deterministic
        )
        assert memory is not None
        self._memory = np.stack(memory)
        return self.policy.scale_action(actions)

    def observe(self, step: Step) -> None:
        super().observe(step)
        self._last.take_in(step.actions, step.rewards, step.dones)
        ended = np.flatnonzero(step.dones)
        self._n_episodes[ended] += 1
        last = ended[self._n_episodes[ended] == self.n_episodes_per_trial - 1]
        self._kept_memory[:, :, last], self._kept_last[last] = self._memory[:, :, last], self._last.columns[last]
        beyond = ended[self._n_episodes[ended] >= self.n_episodes_per_trial]
        self._memory[:, :, beyond], self._last.columns[beyond] = self._kept_memory[:, :, beyond], self._kept_last[beyond]


class RL2(OnPolicyRival, RecurrentPPO):
    """
    RL2: a recurrent policy that is trained to do well over a whole trial, several episodes on one task, so that it learns to
    find out in the first ones what the last ones need. Its observation has its last action, the last reward and whether an
    episode begins in it, see :class:`sb3_htr.rivals.trials.TrialVecEnv`; its memory lives as long as a trial.

    Papers: https://arxiv.org/abs/1611.02779, https://arxiv.org/abs/1611.05763. The recurrent PPO is sb3-contrib's. A rollout
    is whole trials. At meta-test, episodes beyond a trial's length repeat its last one, see :class:`TrialAdaptation`.

    :param policy: ``"MlpLstmPolicy"`` or a class
    :param env: env of a task family, VecEnv of such envs, or registered id
    :param n_episodes_per_trial: episodes on each task. By RL2's objective all of them count, and the critic looks beyond their
        ends. The default is our choice: RL2's papers have 2 to 500, by the task
    :param n_trials_per_rollout: trials of each env between two updates. The default is our choice: 80 of 20 envs
    :param seed: seed of all random generators
    :param kwargs: arguments of ``RecurrentPPO`` but those in :attr:`FOLLOWS`. ``batch_size`` None, the default, is four
        trials, and ``gamma`` None reaches over a trial: 1 - 1 / steps of a trial, the library's 0.99 on the Point Robot. In
        ``load`` they do not follow trials of another length: they are settings of the file
    :raises ValueError: for a setting that is unknown or out of its range, an env without tasks or time limit, or a
        ``batch_size`` that leaves a minibatch of one step
    """

    DEFAULT_POLICY: ClassVar[str] = "MlpLstmPolicy"
    WRAPPERS: ClassVar[tuple[type[VecEnv], ...]] = (TrialVecEnv,)
    ACTS_BY: ClassVar[tuple[str, ...]] = ("n_episodes_per_trial",)
    POLICY_SIZES: ClassVar[dict[str, int]] = {"normalize_observations": 1}
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpLstmPolicy": TrialLstmPolicy}
    FOLLOWS: ClassVar[dict[str, str]] = {
        **OnPolicyRival.FOLLOWS,
        "n_steps": "it follows from n_trials_per_rollout, as a rollout is whole trials",
    }
    policy: RecurrentActorCriticPolicy
    env: TrialVecEnv | None

    def __init__(
        self,
        policy: str | type[RecurrentActorCriticPolicy],
        env: GymEnv | str | None,
        n_episodes_per_trial: int = N_EPISODES_PER_TRIAL,
        n_trials_per_rollout: int = 4,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        self.n_episodes_per_trial = n_episodes_per_trial
        self.n_trials_per_rollout = n_trials_per_rollout
        # Two that follow from the length of a trial
        super().__init__(policy, env, seed, **{"batch_size": None, "gamma": None, **kwargs})

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, TrialVecEnv):
            return env
        return TrialVecEnv(OnPolicyRival._wrap_env(env, verbose, monitor_wrapper), N_EPISODES_PER_TRIAL)

    @staticmethod
    def _in_trials(env: VecEnv, n_episodes: int) -> TrialVecEnv:
        """Of its own, as other models may have the same env, and trials of another length."""
        assert isinstance(env, TrialVecEnv)
        return TrialVecEnv(env.venv, n_episodes)

    def _setup_model(self) -> None:
        # Not in the constructor, as they can be given to load, too
        check_numbers(n_episodes_per_trial=(self.n_episodes_per_trial, 1), n_trials_per_rollout=(self.n_trials_per_rollout, 1))
        if self.env is not None:
            self.n_steps = self._n_steps_in(self.env)
        n_trial_steps = max(self.n_steps // self.n_trials_per_rollout, 1)
        # Gradients go through a minibatch, in the order of its steps, and no further
        self.batch_size = N_TRIALS_PER_BATCH * n_trial_steps if self.batch_size is None else self.batch_size
        # What the first episodes find out is worth what the last ones return
        self.gamma = 1 - 1 / n_trial_steps if self.gamma is None else self.gamma
        super()._setup_model()
        self._check_minibatches()
        self._set_trials()

    def _check_minibatches(self) -> None:
        # The library's PPO minds it, and its recurrent one does not
        n_steps = self.n_steps * self.n_envs
        batch_size = self.batch_size or n_steps
        if self.normalize_advantage and 1 in (batch_size, n_steps % batch_size):
            raise ValueError(
                f"batch_size is {batch_size}, and a rollout has {n_steps} steps, so that a minibatch would have one, whose "
                "advantage cannot be normalized: give a divisor of the steps above 1."
            )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: env of the same spaces, number of copies and time limit
        :param force_reset: reset before training goes on
        :raises ValueError: for another time limit
        """
        vec_env = self._wrap_env(env)
        self._check_time_limit(vec_env)
        super().set_env(vec_env, force_reset)
        self._set_trials()

    def _set_trials(self) -> None:
        if self.env is not None:
            self.env = self._in_trials(self.env, self.n_episodes_per_trial)

    def _n_steps_in(self, env: VecEnv) -> int:
        return self.n_trials_per_rollout * self.n_episodes_per_trial * get_max_episode_steps(env)

    def _check_time_limit(self, env: VecEnv) -> None:
        if (n_steps := self._n_steps_in(env)) != self.n_steps:
            raise ValueError(
                f"Whole trials in this env are rollouts of {n_steps} steps, but those of the model have {self.n_steps}: give "
                "an env of the same time limit, or pass this one to load."
            )

    def train(self) -> None:
        """Learn from a rollout, then go by its observations, too: those of a rollout are all on one scale."""
        super().train()
        for part in self.policy.modules():
            if isinstance(part, TrialFeatures):
                part.update(self.rollout_buffer.observations)

    def _adaptation(self, n_envs: int, generator: th.Generator | None) -> Adapting:
        return TrialAdaptation(self.policy, n_envs, self.n_episodes_per_trial)
