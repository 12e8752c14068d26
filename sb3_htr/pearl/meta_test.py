"""What a meta-trained agent does on a task: adapt to it, then act."""

import warnings

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac import SAC

from sb3_htr.common.checks import get_task_family
from sb3_htr.common.evaluation import run_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.adaptation import Adaptation
from sb3_htr.pearl.adapted_agent import AdaptedAgent
from sb3_htr.pearl.exploration import to_explorer
from sb3_htr.pearl.policies import PEARLPolicy


class AdaptsAtMetaTest(SAC):
    """Adaptation to one task or to several, and prediction with a given z."""

    policy: PEARLPolicy
    explorer: str
    n_exploration_episodes: int
    context_size: int
    _warned_not_adapted: bool

    def start_adaptation(
        self,
        n_envs: int,
        n_exploration_episodes: int | None = None,
        explorer: str | None = None,
        generator: th.Generator | None = None,
    ) -> Adaptation:
        """
        :param n_envs: number of tasks to adapt to side by side
        :param n_exploration_episodes: for the explorer ``"prior"``, the model's own by default
        :param explorer: the model's own by default
        :param generator: source of randomness; torch's global one by default
        :return: draws z and takes in what happens
        """
        if n_exploration_episodes is None:
            n_exploration_episodes = self.n_exploration_episodes
        chosen = to_explorer(explorer or self.explorer)
        return Adaptation(self.policy, n_envs, chosen, n_exploration_episodes, self.context_size, generator)

    def adapt(
        self,
        env: gym.Env | VecEnv | str,
        n_episodes: int = 5,
        task: int | np.ndarray | None = None,
        explorer: str | None = None,
        deterministic: bool = True,
        seed: int = 0,
    ) -> AdaptedAgent:
        """
        Adapt to one task by trying it.

        :param env: env with the task, or an id
        :param n_episodes: episodes to adapt in. The agent then acts with the z of the best one, or with a draw from its
            posterior where none was tried yet (explorer ``"prior"``: with a draw from the posterior over all of them)
        :param task: index of a training task or task vector; by default the task that the env has (if it has none yet, one
            is drawn). The env keeps it.
        :param explorer: how z is drawn before the posterior is used, the model's own by default
        :param deterministic: adapt with mean actions instead of samples
        :param seed: seed of z
        :return: an agent for this task, with the returns of its adaptation episodes
        :raises ValueError: for several envs, an env without tasks or with other spaces, a task that the env does not have
        """
        if n_episodes < 1:
            raise ValueError(f"n_episodes is {n_episodes}, expected at least 1.")
        vec_env = make_task_vec_env(env) if isinstance(env, str) else self._wrap_env(env, monitor_wrapper=False)
        if vec_env.num_envs != 1:
            raise ValueError(f"adapt() adapts to one task, but the VecEnv has {vec_env.num_envs} envs: pass a single env.")
        get_task_family(vec_env)
        check_for_correct_spaces(vec_env, self.observation_space, self.action_space)
        if task is None:
            vec_env.reset()
            task = np.array(vec_env.get_attr("task")[0])
        vec_env.set_options({"task_id": int(task)} if np.ndim(task) == 0 else {"task": np.asarray(task, dtype=np.float32)})
        adaptation = self.start_adaptation(1, None, explorer, th.Generator().manual_seed(seed))
        record = run_adaptation(self.policy, vec_env, adaptation, n_episodes, deterministic)
        if adaptation.best_return[0] <= 0:
            warnings.warn(
                f"No reward was found in {n_episodes} episodes, so the agent is not adapted: allow more, or train longer.",
                stacklevel=2,
            )
        return AdaptedAgent(self.policy, adaptation.frozen_z()[0], record.returns[0], record.successes[0])

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: tuple of one array, z of each observation (n, latent_dim); without it the agent is not adapted to any
            task, which is warned of once
        :param episode_start: ignored: z lives longer than an episode
        :param deterministic: mean action instead of a sample
        :return: actions, and the state for the next call
        """
        if state is None and not self._warned_not_adapted:
            self._warned_not_adapted = True
            warnings.warn(
                "This PEARL is not adapted to any task, so it acts with the prior mean of z. To see what it can do, use "
                "sb3_htr.evaluate_adaptation(model, env), or evaluate_policy(model.adapt(env), env).",
                stacklevel=2,
            )
        return self.policy.predict(observation, state, episode_start, deterministic)
