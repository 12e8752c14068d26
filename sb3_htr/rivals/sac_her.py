"""SAC with hindsight experience replay, told its task: the ceiling for agents that have to find it out."""

import io
import pathlib
import warnings
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer
from stable_baselines3.her.goal_selection_strategy import KEY_TO_GOAL_STRATEGY, GoalSelectionStrategy
from stable_baselines3.sac import SAC
from stable_baselines3.sac.policies import MultiInputPolicy, SACPolicy

from sb3_htr.adaptation.loop import Adapting
from sb3_htr.common.checks import check_has_env, check_rewards, get_max_episode_steps, get_task_family
from sb3_htr.common.family_facts import check_same_family, family_facts
from sb3_htr.common.settings import check_keywords, check_numbers
from sb3_htr.common.type_aliases import Trajectory
from sb3_htr.htr.reward_hook import check_rewards_told
from sb3_htr.rivals.actions import unscaled
from sb3_htr.rivals.adaptation import ToldAdaptation
from sb3_htr.rivals.off_policy import OffPolicyRival
from sb3_htr.rivals.shown_task import ShownTaskVecEnv

# Arguments of the replay buffer that are the model's; rewards here are not of infos
GIVEN_BY_MODEL = (
    *("buffer_size", "observation_space", "action_space", "env", "device", "n_envs"),
    *("optimize_memory_usage", "handle_timeout_termination", "copy_info_dict"),
)


class TaskHerReplayBuffer(HerReplayBuffer):
    """
    SB3's HER, with the reward hook of the task family, which rewards a whole step and not its achieved goal alone.
    """

    #: Of where a pickled one was filled
    family_facts: dict[str, Any]

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one step of each env; arguments are SB3's.

        :raises ValueError: if the reward hook disagrees with what the env gave, or a step does not solve the task that it
            achieves
        """
        assert isinstance(self.env, ShownTaskVecEnv) and isinstance(self.action_space, spaces.Box)
        task_free = np.array([info.get("task_free_reward", 0.0) for info in infos], dtype=np.float32)
        columns = obs["observation"], unscaled(action, self.action_space), next_obs["observation"], task_free
        step = Trajectory(*(values[:, None] for values in columns))
        family = self.env.shown.family
        check_rewards_told(reward, family.compute_reward(step, obs["desired_goal"])[:, 0], obs["desired_goal"])
        if not family.is_success(step, next_obs["achieved_goal"]).all():
            raise ValueError(
                f"hindsight_task of {type(family).__name__} names a task that its own step does not solve, by is_success: HER "
                "would teach what did not happen. Run htr_envs.check_task_env(env) to find out more."
            )
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        assert isinstance(self.env, ShownTaskVecEnv) and isinstance(self.action_space, spaces.Box)
        at = batch_indices, env_indices
        own, goals = self.next_observations["desired_goal"][at], self._sample_goals(batch_indices, env_indices)
        obs, next_obs = self.observations["observation"][at], self.next_observations["observation"][at]
        actions = unscaled(self.actions[at], self.action_space)
        step = Trajectory(*(x[:, None] for x in (obs, actions, next_obs, np.zeros(len(obs), dtype=np.float32))))
        # What a step earned beside its own task stays
        family = self.env.shown.family
        rewards = self.rewards[at] + (family.compute_reward(step, goals) - family.compute_reward(step, own))[:, 0]
        real, shown = self._get_real_samples(batch_indices, env_indices, env), self.to_torch(goals)
        return real._replace(
            observations={**real.observations, "desired_goal": shown},
            next_observations={**real.next_observations, "desired_goal": shown},
            rewards=self.to_torch(rewards[:, None]),
        )

    def __getstate__(self) -> dict[str, Any]:
        if isinstance(self.env, ShownTaskVecEnv):  # a copy has none before its first rollout
            self.family_facts = family_facts(self.env.shown.family)
        return super().__getstate__()

    def truncate_last_trajectory(self) -> None:
        """End the episodes that are not complete, because all envs are about to be reset."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SB3 takes it for a mistake
            super().truncate_last_trajectory()


class SACHER(OffPolicyRival, SAC):
    """
    SAC with HER, whose observation has the task in it: how well the family can be solved by an agent that knows its task, of
    the same library and trained on the same sparse rewards. Papers: https://arxiv.org/abs/1812.05905,
    https://arxiv.org/abs/1707.01495.

    It takes every family whose tasks are functions of a state: the task that a step achieves must be the same whatever the
    observation before it and the action are. Others are refused in their first step.

    :param policy: ``"MultiInputPolicy"`` or a class
    :param env: env of a task family, VecEnv of such envs, or registered id
    :param gradient_steps: updates after each rollout, -1 for as many as it had env steps
    :param replay_buffer_kwargs: arguments of SB3's ``HerReplayBuffer``
    :param policy_kwargs: arguments of the policy
    :param seed: seed of all random generators
    :param kwargs: arguments of ``SAC`` but those in :attr:`FOLLOWS`
    :raises ValueError: for a setting that is unknown, an env without tasks or time limit, or with rewards that are not those
        of its tasks
    """

    DEFAULT_POLICY: ClassVar[str] = "MultiInputPolicy"
    KEPT_TO_ACT: ClassVar[tuple[str, ...]] = ("shown",)
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}
    WRAPPERS: ClassVar[tuple[type[VecEnv], ...]] = (ShownTaskVecEnv,)
    FOLLOWS: ClassVar[dict[str, str]] = {
        **OffPolicyRival.FOLLOWS,
        "replay_buffer_class": "replay is HER's",
        "optimize_memory_usage": "HER's replay does without",
        "n_steps": "HER's replay has returns of one step",
    }

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str | None,
        gradient_steps: int = -1,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            seed,
            gradient_steps=gradient_steps,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs or {},
            **kwargs,
        )

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, ShownTaskVecEnv):
            return env
        return ShownTaskVecEnv(OffPolicyRival._wrap_env(env, verbose, monitor_wrapper))

    def _setup_model(self) -> None:
        self._check_policy_class()
        # Before a replay is made of them; not in the constructor, as they can be given to load, too
        self._check_ranges(vars(self))
        check_numbers(gradient_steps=(self.gradient_steps, -1))
        replay = self.replay_buffer_kwargs
        check_keywords("replay_buffer_kwargs", replay, HerReplayBuffer, without=GIVEN_BY_MODEL)
        check_numbers(n_sampled_goal=(replay.get("n_sampled_goal", 4), 0))
        strategy = replay.get("goal_selection_strategy", "future")
        if not isinstance(strategy, GoalSelectionStrategy) and str(strategy).lower() not in KEY_TO_GOAL_STRATEGY:
            raise ValueError(f"goal_selection_strategy is {strategy!r}, expected one of {sorted(KEY_TO_GOAL_STRATEGY)}.")
        if self.env is None:
            # Loaded for prediction only: SB3 wants a buffer, we want no memory of it
            self.replay_buffer = DictReplayBuffer(1, self.observation_space, self.action_space)  # type: ignore[arg-type]
            super()._setup_model()
            self.replay_buffer = None
        else:
            self._setup_replay(self.env)
            super()._setup_model()

    def _setup_replay(self, env: VecEnv) -> None:
        assert isinstance(env, ShownTaskVecEnv)
        check_rewards(env)
        self.shown = env.shown
        if self._has_experience():
            assert isinstance(self.replay_buffer, TaskHerReplayBuffer)
            self.replay_buffer.env = env
            return
        of_env: Any = self.observation_space, self.action_space, env, self.device, self.n_envs
        self.replay_buffer = TaskHerReplayBuffer(self.buffer_size, *of_env, **self.replay_buffer_kwargs)

    def _has_experience(self) -> bool:
        return self.replay_buffer is not None and self.replay_buffer.size() > 0

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        :param env: env of the same spaces and number of copies; its task family replaces the old one if nothing was collected
        :param force_reset: reset before training goes on
        :raises ValueError: if there is experience of another task family
        """
        vec_env = self._wrap_env(env)
        if self._has_experience():
            check_same_family(family_facts(self.shown.family), family_facts(get_task_family(vec_env)), "The env")
        check_rewards(vec_env)  # before anything is taken
        get_max_episode_steps(vec_env)
        super().set_env(vec_env, force_reset)
        self._setup_replay(vec_env)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        :param path: file of ``save_replay_buffer``. It is a pickle, which can run code: take none from strangers
        :param truncate_last_traj: end the episodes that are not complete
        :raises ValueError: if it is of another number of envs, or another task family
        """
        check_has_env(self.env)
        own = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded, self.replay_buffer = self.replay_buffer, own
        assert isinstance(loaded, TaskHerReplayBuffer)
        if loaded.n_envs != self.n_envs:
            raise ValueError(f"{path} is of {loaded.n_envs} envs, and this model has {self.n_envs}: load it on as many.")
        check_same_family(loaded.family_facts, family_facts(self.shown.family), "This model's env")
        self.replay_buffer = loaded

    def begin_rollout(self) -> None:
        super().begin_rollout()
        assert isinstance(self.replay_buffer, TaskHerReplayBuffer)
        self.replay_buffer.env = self.env  # which SB3 leaves out of copies
        self.replay_buffer.truncate_last_trajectory()

    def state_dict(self) -> dict[str, Any]:
        assert isinstance(self.replay_buffer, TaskHerReplayBuffer)
        state = super().state_dict()
        return {**state, "replay": {**state["replay"], "begun": th.tensor(self.replay_buffer._current_ep_start)}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        assert isinstance(self.replay_buffer, TaskHerReplayBuffer)
        self.replay_buffer._current_ep_start = state["replay"]["begun"].cpu().numpy().copy()

    def _adaptation(self, n_envs: int, generator: th.Generator | None) -> Adapting:
        def act(obs: np.ndarray, tasks: np.ndarray, deterministic: bool) -> np.ndarray:
            actions, _ = self.policy.predict(self.shown(obs, tasks), deterministic=deterministic)
            return self.policy.scale_action(actions)

        return ToldAdaptation(n_envs, act)
