"""What off-policy meta-algorithms share in meta-training: rollouts that adapt, and a replay that is ordered by task."""

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, TrainFreq
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.sac import SAC

from sb3_htr.adaptation.adaptation import Adaptation, Step
from sb3_htr.adaptation.explorers import Explorer, to_explorer
from sb3_htr.adaptation.explorers.prior import FixedExploration
from sb3_htr.adaptation.knowledge import LatentKnowledge
from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.adaptation.task_bank import TaskBank
from sb3_htr.common import checks
from sb3_htr.common.callback import followed_by
from sb3_htr.common.family_facts import check_same_family, family_facts
from sb3_htr.common.progress import MetaProgressBarCallback
from sb3_htr.common.random_state import (
    checked_seed,
    get_generator_state,
    set_generator_state,
    stream,
)
from sb3_htr.common.saving import CheckedFiles
from sb3_htr.common.settings import check_class, check_keywords, check_mappings, check_numbers, plain
from sb3_htr.common.training_state import Resumable
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.common.vec_wrappers import in_float32, seed_envs
from sb3_htr.common.warn_once import WarnOnce
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.htr.reward_hook import check_reward_hook
from sb3_htr.pearl.horizon import BY_HORIZON, STEPS_PER_UPDATE, complete, timesteps_for
from sb3_htr.pearl.meta_test import MetaTest
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.pearl.replay_files import ReplayFiles

# Arguments of the policy, and of the replay buffer, that are the model's
GIVEN_TO_POLICY = ("observation_space", "action_space", "lr_schedule")
GIVEN_BY_MODEL = (
    "buffer_size",
    "observation_space",
    "action_space",
    "device",
    "n_envs",
    "seed",
    "task_family",
    "max_episode_steps",
)
# Env steps for each update that are warned of if they are more: SAC's gradient_steps are 1, but for each env step
MAX_STEPS_PER_UPDATE = 1000

SelfMetaAlgorithm = TypeVar("SelfMetaAlgorithm", bound="OffPolicyMetaAlgorithm")


class OffPolicyMetaAlgorithm(MetaTest, ReplayFiles, CheckedFiles, SAC):
    """
    SAC whose rollouts are adaptations to training tasks and whose replay is ordered by task. A subclass adds ``train``.

    :param policy: name or class of the policy
    :param env: env of a task family (see ``htr_envs.TaskEnv``), VecEnv of such envs, or registered id
    :param n_tasks_per_rollout: training tasks per rollout
    :param n_episodes_per_task: episodes on each of them
    :param context_size: transitions per task for the context, at most
    :param n_steps: steps of a return before a value is asked for. Which of these three, and of SAC's ``learning_starts``,
        ``gradient_steps``, ``batch_size`` and ``gamma``, are None follow from the time limit:
        :func:`sb3_htr.pearl.horizon.settings_for`
    :param explorer: chooses z at meta-test: an explorer, its name, or its name and settings
    :param train_explorer: the same for rollouts
    :param replay_buffer_class: a MultiTaskReplayBuffer
    :param replay_buffer_kwargs: its arguments
    :param policy_kwargs: arguments of the policy
    :param seed: seed of all random generators, from 0 to 2**32 - 1
    :param kwargs: arguments of SAC
    :raises ValueError: see :class:`sb3_htr.PEARL`
    """

    COUNTERS = (*Resumable.COUNTERS, "_n_rollouts")

    def __init__(
        self,
        policy: str | type[PEARLPolicy],
        env: GymEnv | str | None,
        *,
        n_tasks_per_rollout: int,
        n_episodes_per_task: int | None,
        context_size: int | None,
        n_steps: int | None,
        explorer: Explorer | dict[str, Any] | str,
        train_explorer: Explorer | dict[str, Any] | str,
        replay_buffer_class: type[MultiTaskReplayBuffer] | None,
        replay_buffer_kwargs: dict[str, Any] | None,
        policy_kwargs: dict[str, Any] | None,
        seed: int | np.integer[Any] | None,
        **kwargs: Any,
    ) -> None:
        checks.check_device(kwargs.get("device", "auto"))
        verbose = kwargs.get("verbose", 0)
        check_numbers(
            n_tasks_per_rollout=(n_tasks_per_rollout, 1),
            verbose=(int(verbose) if isinstance(verbose, bool) else verbose, 0),
        )
        check_mappings(replay_buffer_kwargs=replay_buffer_kwargs, policy_kwargs=policy_kwargs)
        if not isinstance(policy, str | type):  # a class of another kind is refused by CheckedFiles
            check_class("policy", policy, PEARLPolicy)
        seed = checked_seed(seed)
        self.explorer, self.train_explorer = to_explorer(explorer), to_explorer(train_explorer, "train_explorer")
        if isinstance(env, str):
            env = make_task_vec_env(env, n_tasks_per_rollout, seed=seed)
        if env is not None:
            env = self._wrap_env(env)
            checks.check_spaces(env)
        policy_class = self.policy_aliases.get(policy) if isinstance(policy, str) else policy
        if policy_class is not None:  # an unknown name is refused by CheckedFiles
            check_keywords("policy_kwargs", policy_kwargs or {}, policy_class, without=GIVEN_TO_POLICY)
        super().__init__(
            policy=policy,
            env=env,  # type: ignore[arg-type]
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs={} if policy_kwargs is None else dict(policy_kwargs),
            seed=seed,
            _init_setup_model=False,
            **kwargs,
        )
        # SAC adds an argument for state-dependent exploration, which is not for us: z explores
        self.policy_kwargs.pop("use_sde")
        self.context_size: int = context_size  # type: ignore[assignment]
        self.n_steps: int = n_steps  # type: ignore[assignment]
        self.n_tasks_per_rollout = n_tasks_per_rollout
        self.n_episodes_per_task: int = n_episodes_per_task  # type: ignore[assignment]
        #: Of training, which settings follow from: time limit and tasks of a rollout, whose envs are all stepped. None if the
        #: model has had no env yet
        self.max_episode_steps: int | None = None
        self.n_rollout_tasks: int | None = None
        #: Called after each update
        self.update_listeners: list[Callable[[], None]] = []
        self._n_rollouts = 0
        self._warn_once = WarnOnce()

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            checks.check_env_is_given(type(self), self.env)
        self._check_policy_class()
        # Not in the constructor: settings can be given to load() too, in place of those of the file
        self._complete_settings()
        self.explorer = to_explorer(self.explorer)
        self.train_explorer = to_explorer(self.train_explorer, "train_explorer")
        if self.env is None:
            # Loaded for prediction only: SB3 wants a buffer, we want no memory of it
            self.replay_buffer = ReplayBuffer(1, self.observation_space, self.action_space)  # type: ignore[assignment]
        else:
            self._take_replay(*self._make_replay(self.env))
        with warnings.catch_warnings():
            # SB3 does not know that this buffer has them
            warnings.filterwarnings("ignore", "`n_steps=")
            super()._setup_model()
        if self.env is None:
            self.replay_buffer = None
        self.knowledge = LatentKnowledge(self.policy.latent_dim).to(self.device)
        self._introduce_policy()

    def _complete_settings(self) -> None:
        settings = ("policy_kwargs", "replay_buffer_kwargs")
        vars(self).update({k: plain(v) for k, v in vars(self).items() if k in settings or isinstance(v, np.generic)})
        # Without an env, which is for files alone, the settings come from there
        max_episode_steps, n_envs = self.max_episode_steps or 1, 1
        check_numbers(n_tasks_per_rollout=(self.n_tasks_per_rollout, 1))
        self.seed = checked_seed(self.seed)
        self.replay_buffer_class = buffer_class = self.replay_buffer_class or MultiTaskReplayBuffer
        if not (isinstance(buffer_class, type) and issubclass(buffer_class, MultiTaskReplayBuffer)):
            given = getattr(buffer_class, "__name__", buffer_class)
            raise ValueError(
                f"replay_buffer_class is {given}, expected MultiTaskReplayBuffer, which relabels by itself, or a subclass of "
                "it: leave it out."
            )
        check_keywords("replay_buffer_kwargs", self.replay_buffer_kwargs, buffer_class, without=GIVEN_BY_MODEL)
        if self.env is not None:
            max_episode_steps, n_envs = checks.get_max_episode_steps(self.env), self.env.num_envs
        # All envs are stepped, as often as it takes
        n_tasks = -(-self.n_tasks_per_rollout // n_envs) * n_envs
        if self.env is None and n_tasks <= (self.n_rollout_tasks or 0) < 2 * n_tasks:
            n_tasks = self.n_rollout_tasks or n_tasks  # of the file, rounded up to its envs
        given = {name: getattr(self, name) for name in BY_HORIZON}
        vars(self).update(complete(given, max_episode_steps, n_tasks))
        if self.env is not None:
            before = self.n_rollout_tasks or n_tasks
            if max(n_tasks, before) > 1.5 * min(n_tasks, before):  # less may be a batch that is rounded up
                warnings.warn(
                    f"A rollout is of {n_tasks} tasks, and what follows from that is still of {before}: to train in "
                    "so many envs, make a new model, or give load what it should have (gradient_steps, learning_starts)."
                )
            self.n_rollout_tasks = n_tasks
            rollout = n_tasks * self.n_episodes_per_task * max_episode_steps
            if rollout > MAX_STEPS_PER_UPDATE * self.gradient_steps:
                warnings.warn(
                    f"gradient_steps is {self.gradient_steps}, the updates after a rollout of {rollout} env steps. Left out, "
                    f"they are one for every {STEPS_PER_UPDATE}."
                )

    def _check_rollouts(self) -> None:
        explorer, n_episodes = self.train_explorer, self.n_episodes_per_task
        if isinstance(explorer, FixedExploration) and n_episodes <= explorer.n_exploration_episodes:
            warnings.warn(
                f"A rollout has {n_episodes} episodes on a task, and {explorer.name!r} explores for "
                f"{explorer.n_exploration_episodes}: none will act by what was inferred. Raise n_episodes_per_task, or give "
                f"train_explorer={{'name': {explorer.name!r}, 'n_exploration_episodes': {n_episodes // 2}}}."
            )

    def _make_replay(self, env: VecEnv) -> tuple[MultiTaskReplayBuffer, TaskBank]:
        checks.check_rewards(env)
        family = checks.get_task_family(env)
        buffer_class = cast(type[MultiTaskReplayBuffer], self.replay_buffer_class)
        replay_buffer = buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            seed=self.seed,
            task_family=family,
            max_episode_steps=checks.get_max_episode_steps(env),
            **self.replay_buffer_kwargs,
        )
        task_bank = TaskBank(family, replay_buffer.transitions, self.context_size, self.seed)
        replay_buffer.episode_listeners.append(task_bank.on_episode)
        for explorer in (self.explorer, self.train_explorer):
            self._check_explorer(explorer, replay_buffer.tells_rewards)
        return replay_buffer, task_bank

    def _take_replay(self, replay_buffer: MultiTaskReplayBuffer, task_bank: TaskBank) -> None:
        if self.max_episode_steps not in (None, replay_buffer.max_episode_steps):
            warnings.warn(
                f"The env's time limit is {replay_buffer.max_episode_steps} steps, and what follows from it is still of "
                f"{self.max_episode_steps}: to train on this env, make a new model, or give load what it should have "
                f"({', '.join(BY_HORIZON)})."
            )
        self.replay_buffer, self.task_bank = replay_buffer, task_bank
        self.max_episode_steps = replay_buffer.max_episode_steps
        # Training tasks in the order of the coming rollouts: every task once, then every task once in another order
        self._task_queue = np.zeros(0, dtype=np.int64)

    def _introduce_policy(self) -> None:
        if self.replay_buffer is not None:
            self.replay_buffer.relabeller.policy = self.policy
            self.knowledge.set_tells_rewards(self.replay_buffer.tells_rewards)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        checks.check_is_env(env)
        return in_float32(SAC._wrap_env(env, verbose, monitor_wrapper))

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: env of the same spaces and number of copies; its task family replaces the old one if nothing was collected
        :param force_reset: reset before training goes on
        :raises ValueError: if there is experience of another task family or of shorter episodes, or something changes rewards
            that the family tells. Where it tells none, rewards that differ from those of the experience are not noticed
        """
        vec_env = self._wrap_env(env)
        checks.check_rewards(vec_env)
        family, n_steps = checks.get_task_family(vec_env), checks.get_max_episode_steps(vec_env)
        if self.replay_buffer is not None and self.replay_buffer.size() > 0:
            known = family_facts(self.replay_buffer.task_family)
            check_same_family(known, family_facts(family), "The env")
            self.replay_buffer.check_rewards_of(family, self.replay_buffer.episodes)
            if n_steps > self.replay_buffer.max_episode_steps:
                raise ValueError(
                    f"The env's time limit is {n_steps} steps, and what was collected has room for episodes of "
                    f"{self.replay_buffer.max_episode_steps}: load the model on this env, without its experience."
                )
            super().set_env(vec_env, force_reset)
            return
        # All that can be refused, before anything is taken
        replay_buffer, task_bank = self._make_replay(vec_env)
        super().set_env(vec_env, force_reset)
        self._take_replay(replay_buffer, task_bank)
        self._introduce_policy()

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        :param seed: seed of python, numpy, torch, envs, rollout tasks, replay buffer and task bank
        :raises ValueError: if some generator does not take it
        """
        seed = checked_seed(seed)
        super().set_random_seed(seed)
        if self.env is not None and seed is not None:
            seed_envs(self.env, seed)
        self._rng = stream(seed, "rollouts")
        if isinstance(self.replay_buffer, MultiTaskReplayBuffer) and seed is not None:
            self.replay_buffer.seed(seed)
        if self.task_bank is not None and seed is not None:
            self.task_bank.seed(seed)

    # Meta-training

    def learn(
        self: SelfMetaAlgorithm,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "PEARL",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMetaAlgorithm:
        """
        Meta-train.

        :param total_timesteps: env steps; the last rollout is finished. By default, what follows from the time limit, see
            :func:`sb3_htr.pearl.horizon.timesteps_for`
        :param callback: called at every step
        :param log_interval: rollouts between two logs, None for no logs
        :param tb_log_name: name of the run for TensorBoard
        :param reset_num_timesteps: count env steps from 0
        :param progress_bar: show one
        :return: self
        :raises ValueError: for a model that was loaded without an env, and numbers out of their ranges
        """
        checks.check_has_env(self.env)
        if total_timesteps is None:
            assert self.replay_buffer is not None
            total_timesteps = timesteps_for(self.replay_buffer.max_episode_steps)
        check_numbers(total_timesteps=(total_timesteps, 0.0))
        if log_interval is not None:
            check_numbers(log_interval=(log_interval, 1))
        n_updates, listeners = self._n_updates, list(self.update_listeners)
        try:
            super().learn(
                total_timesteps=total_timesteps,
                callback=callback,
                log_interval=log_interval,  # type: ignore[arg-type]
                tb_log_name=tb_log_name,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )
        finally:
            # A progress bar of a training that was interrupted is still there
            self.update_listeners[:] = listeners
        if total_timesteps > 0:
            checks.warn_without_updates(self, n_updates)
            self._warn_without_successes()
        return self

    def _warn_without_successes(self) -> None:
        assert self.replay_buffer is not None and self.task_bank is not None
        is_over = self._n_updates > 0 and self.num_timesteps >= self._total_timesteps
        bank = self.task_bank
        sees_all = self.replay_buffer.tells_rewards and bank.n_train == len(bank.task_family.train_tasks)
        if is_over and sees_all and bank.n_train_solved == 0:
            warnings.warn(
                "No episode of this training would have solved one of the training tasks, so they were not learnt: train "
                f"longer than {self.num_timesteps} env steps, or see what is_success asks for.",
                stacklevel=3,
            )

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(followed_by(callback, MetaProgressBarCallback()) if progress_bar else callback)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        assert self.replay_buffer is not None
        if self._n_updates > 0 and self.replay_buffer.size() == 0:
            warnings.warn(
                "The experience that this model was trained on is not there, so it goes on with new episodes alone: "
                "load_replay_buffer brings back what save_replay_buffer has saved.",
                stacklevel=5,
            )
        self._check_rollouts()
        # The weights of a file may be of a family without successes
        self.knowledge.set_tells_rewards(self.replay_buffer.tells_rewards)
        return super()._setup_learn(*args, **kwargs)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last rollout may go beyond the budget, and a schedule must not go below its end
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def collect_rollouts(  # type: ignore[override]
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: MultiTaskReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """
        Adapt to ``n_tasks_per_rollout`` training tasks, one per env at a time, and store all that happens.

        Each env stays on its task until every env has finished ``n_episodes_per_task`` episodes; envs whose episodes are
        shorter go on with more of them. ``train_freq`` and ``action_noise`` are not used: a rollout is whole adaptations, and
        z explores.
        """
        assert self.task_bank is not None
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        first_step, first_episode = self.num_timesteps, self._episode_num
        continue_training = all(
            self._adapt_to_training_tasks(env, callback, replay_buffer, learning_starts)
            for _ in range(-(-self.n_tasks_per_rollout // env.num_envs))
        )
        if continue_training:
            # In each rollout: a sparse reward can go unseen for many, and the env may be another one than before
            if replay_buffer.tells_rewards:
                relabelled = replay_buffer.relabel_probability > 0
                check_reward_hook(replay_buffer.task_family, replay_buffer.transitions, self.task_bank.new, relabelled)
            # Now and not step by step: what a posterior takes in during a rollout stays on one scale
            columns = replay_buffer.transitions
            self.policy.update_normalizer(
                np.concatenate([episode[:, columns.observation] for _, episode in self.task_bank.new])
            )
            self.task_bank.update()
            if replay_buffer.tells_rewards:
                self.logger.record("rollout/train_tasks_reached", self.task_bank.n_train_solved)
            # The updates that follow are those of this rollout: by its end, a schedule of the last one would be at its end too
            self._update_current_progress_remaining(first_step, self._total_timesteps)
            callback.on_rollout_end()
            self._n_rollouts += 1
            if log_interval is not None and self._n_rollouts % log_interval == 0:
                self.dump_logs()
        return RolloutReturn(self.num_timesteps - first_step, self._episode_num - first_episode, continue_training)

    def _adapt_to_training_tasks(
        self, env: VecEnv, callback: BaseCallback, replay_buffer: MultiTaskReplayBuffer, learning_starts: int
    ) -> bool:
        """One task for each env. Whether a callback wants to go on."""
        tasks = self._next_tasks(env.num_envs)
        env.set_options([{"task_id": int(task)} for task in tasks])
        obs = env.reset()
        assert isinstance(obs, np.ndarray)
        checks.check_task_ids(env, tasks)
        replay_buffer.discard_open_episodes()
        adaptation = self.start_adaptation(env.num_envs, self.train_explorer, is_training=True)
        act = partial(self._explore, adaptation, learning_starts)
        steps = adaptation_steps(env, adaptation, self.n_episodes_per_task, self.policy.unscale_action, act, obs)
        while (step := self._next_step(steps, tasks)) is not None:
            # SB3's names, for callbacks
            rewards, dones, infos, new_obs = step.rewards, step.dones, step.infos, step.new_observations
            buffer_actions, actions = step.actions, self.policy.unscale_action(step.actions)
            self.num_timesteps += env.num_envs
            # Give access to local variables
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            replay_buffer.add(step.observations, step.next_observations, step.actions, rewards, dones, infos)
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._episode_num += int(dones.sum())
        return True

    def _next_tasks(self, n: int) -> np.ndarray:
        assert self.task_bank is not None
        n_tasks = len(self.task_bank.task_family.train_tasks)
        while len(self._task_queue) < n:
            self._task_queue = np.append(self._task_queue, self._rng.permutation(n_tasks))
        tasks, self._task_queue = self._task_queue[:n], self._task_queue[n:]
        return tasks

    def _explore(self, adaptation: Adaptation, learning_starts: int, obs: np.ndarray) -> np.ndarray:
        """Actions of a rollout, scaled to [-1, 1]."""
        if self.num_timesteps < learning_starts:
            return self._rng.uniform(-1, 1, (len(obs), *self.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        return adaptation.act(obs, deterministic=False)

    def _next_step(self, steps: Iterator[Step], tasks: np.ndarray) -> Step | None:
        """One more step, None at the end; failures say where."""
        where = f"At env step {self.num_timesteps}, on one of the training tasks {tasks.tolist()}"
        try:
            return next(steps, None)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        except (EOFError, ConnectionError) as error:
            if not isinstance(self.env and self.env.unwrapped, SubprocVecEnv):  # such as a robot's connection
                raise
            raise RuntimeError(
                f"{where}, the process of an env died: its own traceback is printed above. Envs in one process (vec_env "
                "dummy) show it here."
            ) from error

    # Files and state

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "update_listeners", "_rng", "_task_queue"]

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "task_queue": th.from_numpy(self._task_queue.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._task_queue = state["task_queue"].numpy().copy()

    def _get_random_state(self) -> dict[str, Any]:
        return {**super()._get_random_state(), "model": get_generator_state(self._rng)}

    def _set_random_state(self, state: dict[str, Any]) -> None:
        super()._set_random_state(state)
        set_generator_state(self._rng, state["model"])
