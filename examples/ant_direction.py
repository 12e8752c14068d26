"""A dense family: gymnasium's ant must walk in a direction that it is not told (PEARL's ant-goal-direction, ant-dir).

    python examples/ant_direction.py                                          # meta-train by plain PEARL and adapt

Every step is rewarded by the speed in that direction. PEARL's half-cheetah-dir is the same with two directions; two tasks are
too few for training, validation and test tasks that differ, so it is not here.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.ant_v5 import AntEnv

from htr_envs import MetaEnv, TaskDistribution
from htr_envs.headless import open_no_window
from htr_envs.task_env import FloatArray


class Directions(TaskDistribution):
    """
    Directions in the plane, as unit vectors.

    :param task_seed: seed of the 100 training, 20 validation and 30 test tasks
    """

    def __init__(self, task_seed: int = 1337) -> None:
        tasks = self.sample_tasks(150, np.random.default_rng(task_seed))
        super().__init__(spaces.Box(-1, 1, (2,), np.float32), tasks[:100], tasks[100:120], tasks[120:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        angle = rng.uniform(0, 2 * np.pi, n)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


class AntDirectionEnv(MetaEnv):
    """
    Ant-v5, whose reward for walking forward is one for walking in the task's direction, in metres per second.

    Costs, survival and the end of an episode where the ant falls are gymnasium's. Observations are without contact forces, as
    those of PEARL's ant.

    :param render_mode: ``"rgb_array"`` or None
    :param family_kwargs: of :class:`Directions`
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}  # type: ignore[misc]

    def __init__(self, render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(Directions(**family_kwargs))
        self.render_mode = render_mode
        if render_mode is not None:
            open_no_window(render_mode)
        self.ant = AntEnv(render_mode=render_mode, include_cfrc_ext_in_observation=False)
        self.observation_space = self.ant.observation_space
        self.action_space = self.ant.action_space

    def _reset_state(self) -> FloatArray:
        obs, _ = self.ant.reset(seed=int(self.np_random.integers(2**31)))
        return obs

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        obs, reward, terminated, _, info = self.ant.step(np.clip(action, -1, 1))
        velocity = np.array([info["x_velocity"], info["y_velocity"]])
        return obs, float(reward - info["reward_forward"] + velocity @ self.task), terminated

    def render(self) -> Any:
        """Picture (480, 480, 3), uint8; None without a render mode."""
        return self.ant.render() if self.render_mode else None

    def close(self) -> None:
        """Release what draws the pictures."""
        self.ant.close()


gym.register("AntDirection-v0", entry_point=AntDirectionEnv, max_episode_steps=200)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation

    # Two episodes with a z of the prior, then of the posterior
    prior = {"name": "prior", "n_exploration_episodes": 2}
    plain: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}, "explorer": prior, "train_explorer": prior}
    model = PEARL("MlpPolicy", "AntDirection-v0", **plain, n_episodes_per_task=4, context_size=200, seed=0, verbose=1)
    returns, _ = evaluate_adaptation(model.learn(1_000_000), "AntDirection-v0", n_episodes=3)
    print(f"return of episodes 1 to 3: {returns.mean(axis=0).round(1)}")
