"""How well an agent adapts where sensors, motors and measured rewards are not those of its simulation:
``python -m examples.imperfect_robot [ENV [agent.zip]]``.

By the explorer of the agent, of the package by default, on the 20 validation tasks with three seeds each. What counts as
solved is the truth, not what the sensors say.
"""

import sys
from collections import deque
from dataclasses import dataclass

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation.evaluation import first_success
from sb3_htr.common.normalizer import ObservationNormalizer
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.zoo.run.agents import agent_for

SEEDS = range(3)


@dataclass
class Imperfection:
    """
    What is wrong with a robot.

    :param observation_noise: standard deviation of what is added to observations, in those that they had in training
    :param action_noise: standard deviation of what is added to actions, from -1 to 1
    :param gain: part of an action that the motors do
    :param delay: steps by which actions come late
    :param missed: share of the steps on the goal that pay nothing for it
    :param false: share of the other steps that pay for a success
    :param false_reward: that much
    :param reward_noise: standard deviation of what is added to the reward of each step
    """

    observation_noise: float = 0.0
    action_noise: float = 0.0
    gain: float = 1.0
    delay: int = 0
    missed: float = 0.0
    false: float = 0.0
    false_reward: float = 0.8
    reward_noise: float = 0.0


IMPERFECTIONS = {
    "none": Imperfection(),
    "observations: noise of .05": Imperfection(observation_noise=0.05),
    "observations: noise of .2": Imperfection(observation_noise=0.2),
    "actions: noise of .3": Imperfection(action_noise=0.3),
    "motors: .8 of an action": Imperfection(gain=0.8),
    "motors: .6 of an action": Imperfection(gain=0.6),
    "motors: 1 step late": Imperfection(delay=1),
    "motors: 3 steps late": Imperfection(delay=3),
    "rewards: half of them missed": Imperfection(missed=0.5),
    "rewards: .8 of them missed": Imperfection(missed=0.8),
    "rewards: false in one step of 1,000": Imperfection(false=0.001),
    "rewards: false in one step of 100": Imperfection(false=0.01),
    "rewards: noise of .05": Imperfection(reward_noise=0.05),
    "rewards: noise of .1": Imperfection(reward_noise=0.1),
    "rewards: noise of .2": Imperfection(reward_noise=0.2),
}


class ImperfectRobot(VecEnvWrapper):
    """
    :param venv: of a task family
    :param imperfection: of each of its robots
    :param scale: (obs_dim,), standard deviations of observations in training
    :param seed: of all noise
    """

    def __init__(self, venv: VecEnv, imperfection: Imperfection, scale: np.ndarray, seed: int) -> None:
        super().__init__(venv)
        self.imperfection, self.scale, self.rng = imperfection, scale, np.random.default_rng(seed)
        self.late: deque[np.ndarray] = deque()

    def reset(self) -> VecEnvObs:
        self.late.clear()
        return self._seen(np.asarray(self.venv.reset()))

    def step_async(self, actions: np.ndarray) -> None:
        low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
        noise = self.imperfection.action_noise * (high - low) / 2 * self.rng.normal(size=actions.shape)
        self.late.extend([np.zeros_like(actions)] * (self.imperfection.delay - len(self.late)))  # at the beginning
        self.late.append(np.clip(self.imperfection.gain * actions + noise, low, high).astype(np.float32))
        self.venv.step_async(self.late.popleft())

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        wrong, task_free = self.imperfection, np.array([info["task_free_reward"] for info in infos])
        on_goal, chance = np.array([info["is_success"] for info in infos]), self.rng.random(self.num_envs)
        measured = np.where(on_goal & (chance < wrong.missed), task_free, rewards)
        measured = np.where(~on_goal & (chance < wrong.false), task_free + wrong.false_reward, measured)
        measured = measured + wrong.reward_noise * self.rng.normal(size=self.num_envs)
        for env in np.flatnonzero(dones):
            infos[env]["terminal_observation"] = self._seen(infos[env]["terminal_observation"])
        return self._seen(np.asarray(obs)), measured.astype(np.float32), dones, infos

    def _seen(self, obs: np.ndarray) -> np.ndarray:
        noise = self.imperfection.observation_noise * self.scale * self.rng.normal(size=obs.shape)
        return (obs + noise).astype(np.float32)


def main(env_id: str = "SparsePointRobot-v0", agent: str = "") -> None:
    """A line for each imperfection."""
    model = PEARL.load(agent) if agent else agent_for(env_id).load()
    normalizer = model.policy.normalizer
    assert isinstance(normalizer, ObservationNormalizer), "a PEARL with normalize_observations knows how much they vary"
    scale = normalizer.variance.sqrt().cpu().numpy()
    print("| env | imperfection | episodes to the first success | solved in episode 5 | in episode 20 |")
    print("| --- | --- | --- | --- | --- |")
    for name, imperfection in IMPERFECTIONS.items():
        runs = []
        for seed in SEEDS:
            robots = ImperfectRobot(make_task_vec_env(env_id, 20, seed), imperfection, scale, seed)
            runs.append(evaluate_adaptation(model, robots, "validation", seed=seed)[1])
        solved = np.concatenate(runs)
        first, *shares = first_success(solved).mean(), *(solved[:, episode].mean() for episode in (4, -1))
        print(f"| {env_id} | {name} | {first:.1f} | {' | '.join(f'{share:.2f}' for share in shares)} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
