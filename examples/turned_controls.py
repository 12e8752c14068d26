"""A family whose tasks change the dynamics: a point that sees its goal, and whose controls are turned by a hidden angle.

    python examples/turned_controls.py      # floor and ceiling; meta-train by plain PEARL, whose contexts have o', and adapt
    sb3-htr experiment turned_controls --gym-packages examples.experiments

As a robot whose camera or compass was mounted askew. The reward is the same function of a step in all tasks, and old
experience says nothing of another angle: there is nothing to relabel. One whole step (o, a, o') tells the angle, (o, a, r)
does not.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from htr_envs import MetaEnv, TaskDistribution
from htr_envs.task_env import FloatArray, check_reward_type

# How far a step leads along each axis, from where on the goal is reached, and where in the plane starts and goals are
STEP, RADIUS, HALF = 0.1, 0.2, 0.5


class AngleDistribution(TaskDistribution):
    """
    Angles in radians, from the whole circle.

    :param task_seed: seed of the 80 training, 20 validation and 20 test tasks
    """

    def __init__(self, task_seed: int = 1337) -> None:
        tasks = self.sample_tasks(120, np.random.default_rng(task_seed))
        super().__init__(spaces.Box(-np.pi, np.pi, (1,), np.float32), tasks[:80], tasks[80:100], tasks[100:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        return rng.uniform(-3.14, 3.14, (n, 1)).astype(np.float32)


class TurnedControlsEnv(MetaEnv):
    """
    A point in the plane that is to stay within 0.2 of a goal, which it sees. Start and goal are drawn for each episode.

    Observations are where it is and where the goal is (4,), actions its step, in tenths, before it is turned (2,). As one
    episode in ten begins at its goal, to have been there is no success: the return says how long it stayed.

    :param reward_type: ``"dense"``, minus the distance to the goal, or ``"sparse"``, 1 where it is reached, else 0
    :param family_kwargs: of :class:`AngleDistribution`
    """

    def __init__(self, reward_type: str = "dense", **family_kwargs: Any) -> None:
        check_reward_type(reward_type)
        super().__init__(AngleDistribution(**family_kwargs))
        self.reward_type = reward_type
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _reset_state(self) -> FloatArray:
        (angle,) = self.task
        self.turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.position, self.goal = self.np_random.uniform(-HALF, HALF, (2, 2))
        return self._observation()

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        self.position = self.position + STEP * self.turn @ np.clip(action, -1, 1)
        distance = float(np.linalg.norm(self.position - self.goal))
        return self._observation(), -distance if self.reward_type == "dense" else float(distance <= RADIUS), False

    def _observation(self) -> FloatArray:
        return np.concatenate([self.position, self.goal]).astype(np.float32)


def turn_back(observations: np.ndarray, tasks: np.ndarray) -> np.ndarray:
    """
    :param observations: (n, 4)
    :param tasks: (n, 1) angles
    :return: (n, 2) actions of one that is told them: straight to the goals, as fast as it goes
    """
    x, y = ((observations[:, 2:] - observations[:, :2]) / STEP).T
    cos, sin = np.cos(tasks[:, 0]), np.sin(tasks[:, 0])
    steps = np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)
    return steps / np.maximum(np.abs(steps).max(axis=1, keepdims=True), 1)


gym.register("TurnedControls-v0", entry_point=TurnedControlsEnv, max_episode_steps=20)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation
    from sb3_htr.rivals.scripted import ScriptedAgent

    print("| rewards | actions | return of an episode |\n| --- | --- | --- |")
    for reward_type in ("sparse", "dense"):
        env = gym.make("TurnedControls-v0", reward_type=reward_type)
        for name, script in (("random actions", None), ("turn_back", turn_back)):
            returns, _ = evaluate_adaptation(ScriptedAgent(env.action_space, script), env, n_episodes=250)
            print(f"| {reward_type} | {name} | {returns.mean():.2f} |")
    # One episode with a z of the prior, then of the posterior
    prior = {"name": "prior", "n_exploration_episodes": 1}
    plain: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}, "explorer": prior, "train_explorer": prior}
    policy = {"use_next_obs_in_context": True}
    model = PEARL("MlpPolicy", "TurnedControls-v0", **plain, policy_kwargs=policy, seed=0, verbose=1)
    returns, _ = evaluate_adaptation(model.learn(100_000), "TurnedControls-v0", n_episodes=3)
    print(f"return of episodes 1 to 3: {returns.mean(axis=0).round(1)}")
