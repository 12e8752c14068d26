"""What a trained model does on new tasks: adapt to one, or to several side by side, and act."""

import warnings
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac import SAC

from sb3_htr.adaptation.adaptation import Adaptation
from sb3_htr.adaptation.agent import AdaptedAgent
from sb3_htr.adaptation.explorers import Explorer, to_explorer
from sb3_htr.adaptation.knowledge import LatentKnowledge
from sb3_htr.adaptation.loop import adaptation_steps, first_observations
from sb3_htr.common import checks
from sb3_htr.common.latent_policy import Obs, State
from sb3_htr.common.random_state import MAX_SEED, seeded_actions
from sb3_htr.common.settings import check_numbers
from sb3_htr.common.warn_once import WarnOnce
from sb3_htr.pearl.policies import PEARLPolicy


class MetaTest(SAC):
    """SAC whose policy acts by a latent task variable z, which an explorer chooses."""

    policy: PEARLPolicy
    context_size: int
    explorer: Explorer
    knowledge: LatentKnowledge
    #: Of training; None if the model has had no env yet
    max_episode_steps: int | None
    _warn_once: WarnOnce

    def check_env(self, env: VecEnv) -> None:
        """
        :param env: to adapt in
        :raises ValueError: if its spaces do not fit those of training, or it normalizes
        """
        checks.check_is_not_normalized(env)
        checks.check_fits(self._wrap_env(env), self.observation_space, self.action_space)

    def start_adaptation(
        self,
        n_envs: int,
        explorer: Explorer | dict[str, Any] | str | None = None,
        generator: th.Generator | None = None,
        is_training: bool = False,
    ) -> Adaptation:
        """
        :param n_envs: number of tasks to adapt to side by side
        :param explorer: an explorer, its name, or its name and settings; by default, and where the name alone is that of the
            model's own, the model's own
        :param generator: source of randomness; torch's global one by default
        :param is_training: whether infos tell which part of a reward depends on no task
        :return: chooses z and takes in what happens
        :raises ValueError: if the explorer goes by successes, and the model was trained on a family without
        """
        own = to_explorer(self.explorer)
        chosen = own if explorer in (None, own.name) else to_explorer(explorer)
        self._check_explorer(chosen, self.knowledge.tells_rewards)
        check_numbers(n_envs=(n_envs, 1))
        self.policy.set_training_mode(False)
        return Adaptation(
            self.policy,
            self.knowledge,
            chosen,
            n_envs,
            gamma=self.gamma,
            context_size=self.context_size,
            generator=generator,
            is_training=is_training,
        )

    def adapt(
        self,
        env: gym.Env | VecEnv | str,
        n_episodes: int = 5,
        task: ArrayLike | None = None,
        explorer: Explorer | dict[str, Any] | str | None = None,
        deterministic: bool = True,
        seed: int = 0,
    ) -> AdaptedAgent:
        """
        Adapt to one task by trying it, from observations, actions and rewards.

        :param env: env with the task, or an id. It need not be of the task family that the model knows, or of any: an env of
            the same spaces, such as the real robot, is enough, if its episodes are all of one task
        :param n_episodes: episodes to adapt in. The agent then acts with the ``final_z`` of the explorer: of ``"belief"``, z
            of the best one that had a single z, or the one that promises most, where that found little of what there is; of
            ``"prior"``, a draw from the posterior over all of them
        :param task: index of a training task or task vector; by default the task that the env was given, or one that it draws.
            The env keeps it. An env without task family takes none, and with an id one is needed
        :param explorer: an explorer, its name, or its name and settings; the model's own by default
        :param deterministic: adapt with mean actions instead of samples
        :param seed: seed of z, and of the actions if they are samples
        :return: an agent for this task, with the returns of its adaptation episodes, and whether each was a success: if the
            env does not say so (``info["is_success"]``), whether a reward was told from what is task-free
        :raises ValueError: for several envs, an env with other spaces, a task that the env does not have, episodes without end
        """
        check_numbers(n_episodes=(n_episodes, 1), seed=(seed, 0, MAX_SEED))
        if isinstance(env, str):
            with closing(gym.make(env)) as made:
                if task is None and made.has_wrapper_attr("task_family"):
                    raise ValueError(
                        f"Which task of {env} the agent is for, nobody would know: pass task, or an env that has one."
                    )
                return self.adapt(made, n_episodes, task, explorer, deterministic, seed)
        vec_env = self._wrap_env(env, monitor_wrapper=False)
        if vec_env.num_envs != 1:
            raise ValueError(f"adapt() adapts to one task, but the VecEnv has {vec_env.num_envs} envs: pass a single env.")
        self.check_env(vec_env)
        # What has no task family may have no time limit that could be read, as a robot
        longest = checks.get_max_episode_steps(vec_env) if vec_env.has_attr("task_family") else self.max_episode_steps
        task = self._give_task(vec_env, task)
        seed = int(seed)  # torch takes no numbers of numpy
        adaptation = self.start_adaptation(1, explorer, th.Generator().manual_seed(seed))
        returns, successes = np.zeros(n_episodes), np.zeros(n_episodes, dtype=bool)
        act = partial(adaptation.act, deterministic=deterministic)
        obs = first_observations(vec_env)
        if task is not None and task.ndim > 0:
            checks.check_tasks(vec_env, task[None])
        elif task is not None:
            checks.check_task_ids(vec_env, task[None])
        with seeded_actions(seed, deterministic):
            for step in adaptation_steps(vec_env, adaptation, n_episodes, self.policy.unscale_action, act, obs, longest):
                episode = adaptation.n_episodes[0] - step.dones[0]
                returns[episode] += step.rewards[0]
                # Some envs give a number
                successes[episode] |= bool(step.infos[0].get("is_success", adaptation.task_reward[0] > 0))
        if adaptation.best_return[0] <= 0 and self.knowledge.tells_rewards:
            warnings.warn(
                f"No reward was found in {n_episodes} episodes, so the agent is not adapted: allow more, or train longer. If "
                "there was a success, its reward is on another scale than in meta-training: the most rewarded step returned "
                f"{adaptation.largest_reward[0]:.2g} more than steps without success do, and at least "
                f"{self.knowledge.threshold.item():.2g} would be one.",
                stacklevel=2,
            )
        return AdaptedAgent(self.policy, adaptation.explorer.final_z()[0], returns, successes)

    @staticmethod
    def _give_task(env: VecEnv, task: ArrayLike | None) -> np.ndarray | None:
        """
        Have an env begin its next episode on a task.

        :return: index () int, or vector (task_dim,) float32: without a task, the env's own. None of an env without task family
        """
        if not env.has_attr("task_family"):
            if task is not None:
                raise ValueError("The env has no task family, so it takes no task: leave task out, and set its task yourself.")
            return None
        if task is None:
            env.reset()
            # Of an env that names its task by the index alone, that
            task = env.get_attr("task")[0] if env.has_attr("task") else env.unwrapped.reset_infos[0]["task_id"]
        given = np.asarray(task)
        # Before the env has it: after a reset that failed, an env without a first observation would be stepped
        family = checks.get_task_family(env)
        if given.ndim > 0:
            if hasattr(family, "task_vectors"):
                family.task_vectors(task, family.train_tasks.shape[1:])
            vector = given.astype(np.float32)
            env.set_options({"task": vector})
            return vector
        if not np.issubdtype(given.dtype, np.integer):
            raise ValueError(f"task is {task!r}: pass the index of a training task, or a task as a vector, [{task!r}].")
        if hasattr(family, "task_indices"):
            family.task_indices(task, ())
        env.set_options({"task_id": int(given)})
        return given

    @staticmethod
    def _check_explorer(explorer: Explorer, tells_rewards: bool) -> None:
        if explorer.needs_success and not tells_rewards:
            raise ValueError(
                f"The explorer {explorer.name!r} goes by successes, of which the env's task_family tells nothing: pass "
                "explorer='prior' (and in a training train_explorer='prior', on the command line --method pearl-sparse-prior)."
            )

    def predict(
        self, observation: Obs, state: State = None, episode_start: np.ndarray | None = None, deterministic: bool = False
    ) -> tuple[np.ndarray, State]:
        """
        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: tuple of one array, z of each observation (n, latent_dim); without it the agent is not adapted to any
            task, which is warned of once
        :param episode_start: ignored: z lives longer than an episode
        :param deterministic: mean action instead of a sample
        :return: actions, and the state for the next call
        """
        if state is None:
            self._warn_once(
                "not adapted",
                "This PEARL is not adapted to any task, so it acts with the prior mean of z. To see what it can do, use "
                "sb3_htr.evaluate_adaptation(model, env), or evaluate_policy(model.adapt(env), env).",
                stacklevel=2,
            )
        return self.policy.predict(observation, state, episode_start, deterministic)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "knowledge", "_warn_once"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "knowledge"], variables
