"""Shows the task to an agent, in the observation that SB3's HER wants."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_htr.common.checks import check_finite, check_has_hooks, check_spaces, get_task_family
from sb3_htr.common.type_aliases import TaskFamily, Trajectory
from sb3_htr.common.vec_wrappers import CopiedWrapper


class ShownTask:
    """
    The observation of an agent that is told its task, as SB3's HER has it: ``observation``, ``achieved_goal``, the task that
    the state solves, and ``desired_goal``, the task to solve.

    :param family: whose tasks are functions of a state
    :param action_space: Box
    :raises ValueError: if the family does not tell which task a step solves
    """

    def __init__(self, family: TaskFamily, action_space: spaces.Box) -> None:
        check_has_hooks(family)
        self.family = family
        self._action_dim = action_space.shape[0]

    def space(self, observation_space: spaces.Box) -> spaces.Dict:
        """
        :param observation_space: of the env
        :return: of the agent
        """
        goal = spaces.Box(-np.inf, np.inf, self.family.train_tasks.shape[1:], np.float32)
        return spaces.Dict({"observation": observation_space, "achieved_goal": goal, "desired_goal": goal})

    def achieved(self, obs: np.ndarray) -> np.ndarray:
        """
        :param obs: (n, obs_dim)
        :return: (n, task_dim), the tasks that these states solve
        """
        obs, nothing = obs[:, None], np.zeros((len(obs), 1, self._action_dim), dtype=np.float32)
        return self.family.hindsight_task(Trajectory(obs, nothing, obs, nothing[..., 0]), 0)

    def __call__(self, obs: np.ndarray, tasks: np.ndarray) -> dict[str, np.ndarray]:
        """
        :param obs: (n, obs_dim)
        :param tasks: (n, task_dim)
        :return: what the agent sees
        """
        return {"observation": obs, "achieved_goal": self.achieved(obs), "desired_goal": tasks}


class ShownTaskVecEnv(CopiedWrapper):
    """
    Shows the task, which the env draws for each episode.

    :param venv: env of a task family
    :raises ValueError: if the env has no tasks
    """

    def __init__(self, venv: VecEnv) -> None:
        check_spaces(venv)
        assert isinstance(venv.observation_space, spaces.Box) and isinstance(venv.action_space, spaces.Box)
        self.shown = ShownTask(get_task_family(venv), venv.action_space)
        super().__init__(venv, observation_space=self.shown.space(venv.observation_space))

    def _tasks(self) -> np.ndarray:
        return np.stack(self.venv.get_attr("task"))

    def reset(self) -> VecEnvObs:
        """Begin an episode in each env."""
        obs = self.venv.reset()
        assert isinstance(obs, np.ndarray)
        self._now = self._tasks()
        return self.shown(obs, self._now)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(obs, np.ndarray)
        check_finite("observation", obs)  # before a task is read in it
        before, ended = self._now, np.flatnonzero(dones)
        self._check(obs, dones, infos)
        if len(ended):
            self._now = self._tasks()
            final = self.shown(np.stack([infos[env]["terminal_observation"] for env in ended]), before[ended])
            for i, env in enumerate(ended):
                infos[env]["terminal_observation"] = {key: values[i] for key, values in final.items()}
        return self.shown(obs, self._now), rewards, dones, infos

    def _check(self, obs: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        going_on = [env for env in np.flatnonzero(~dones) if "achieved_task" in infos[env]]
        told = np.array([infos[env]["achieved_task"] for env in going_on], dtype=np.float32)
        if len(told) and not np.allclose(told, self.shown.achieved(obs[going_on]), rtol=1e-4, atol=1e-5):
            raise ValueError(
                f"The tasks of {type(self.shown.family).__name__} are no functions of a state: the task that a step achieves "
                "cannot be read in the observation after it, so there is no achieved_goal for HER."
            )
