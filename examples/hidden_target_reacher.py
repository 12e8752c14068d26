"""An env of somebody else as a task family: gymnasium's Reacher-v5, whose arm is no longer told where its target is.

    python examples/hidden_target_reacher.py                                                          # meta-train and adapt
    sb3-htr train --env HiddenTargetReacher-v0 --gym-packages examples.hidden_target_reacher    # from the command line

What it takes: the target leaves the observation and becomes the task; the reward is 0 until the fingertip is on it. A random
arm is on its target in some step of one of six episodes (500 measured).
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv
from numpy.typing import ArrayLike

from htr_envs import TaskEnv, TaskFamily, Trajectory, at_step, check_reward_type
from htr_envs.headless import open_no_window
from htr_envs.task_env import BoolArray, FloatArray, l2_distance

# As in Reacher-v5: targets are drawn from a disc of this radius, in metres
REACH = 0.2
# What Reacher-v5 observes: cosines and sines of both angles, target (2), angular velocities (2), fingertip less target (2)
ANGLES, VELOCITIES = slice(0, 4), slice(6, 8)
# Here: cosines and sines, angular velocities, and where the fingertip is
FINGERTIP = slice(6, 8)


class HiddenTargetFamily(TaskFamily):
    """
    Targets in reach; worth 1 where the fingertip is on it.

    :param radius: the fingertip is on a target that is nearer than this, in metres
    :param task_seed: seed of the 80 training, 20 validation and 100 test tasks
    """

    def __init__(self, radius: float = 0.02, task_seed: int = 1337) -> None:
        self.radius = radius
        tasks = self.sample_tasks(200, np.random.default_rng(task_seed))
        super().__init__(spaces.Box(-0.3, 0.3, (2,), np.float32), tasks[:80], tasks[80:100], tasks[100:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        angle, distance = rng.uniform(0, 2 * np.pi, n), REACH * np.sqrt(rng.uniform(0, 1, n))
        return (distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).astype(np.float32)

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        check_reward_type(reward_type)
        task_reward = -self._distance(traj, task) if reward_type == "dense" else self.is_success(traj, task)
        return np.asarray(task_reward + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        return np.asarray(self._distance(traj, task) < self.radius)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        return at_step(traj.next_observations[..., FINGERTIP], index)

    @staticmethod
    def _distance(traj: Trajectory, task: ArrayLike) -> FloatArray:
        return l2_distance(traj.next_observations[..., FINGERTIP], np.asarray(task, dtype=np.float32)[..., None, :])


class HiddenTargetReacherEnv(TaskEnv):
    """
    Reacher-v5 without its target. Actions are its own, torques in [-1, 1].

    :param reward_type: ``"sparse"`` or ``"dense"``
    :param render_mode: ``"rgb_array"`` or None; pictures show the target
    :param family_kwargs: of :class:`HiddenTargetFamily`
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(HiddenTargetFamily(**family_kwargs), reward_type)
        self.render_mode = render_mode
        if render_mode is not None:
            open_no_window(render_mode)
        self.reacher = ReacherEnv(render_mode=render_mode)
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _observe(self, obs: np.ndarray) -> FloatArray:
        fingertip = self.reacher.get_body_com("fingertip")[:2]
        return np.concatenate([obs[ANGLES], obs[VELOCITIES], fingertip]).astype(np.float32)

    def _reset_state(self) -> FloatArray:
        obs, _ = self.reacher.reset(seed=int(self.np_random.integers(2**31)))
        # For pictures: nothing touches the target, and nothing that is observed depends on it
        position = self.reacher.data.qpos.copy()
        position[-2:] = self.task
        self.reacher.set_state(position, self.reacher.data.qvel.copy())
        return self._observe(obs)

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        action = np.clip(action, -1, 1)
        obs, *_ = self.reacher.step(action)
        return self._observe(obs), -0.01 * float(np.square(action).sum()), False

    def render(self) -> Any:
        """Picture (480, 480, 3), uint8, with the target of the episode; None without a render mode."""
        return self.reacher.render() if self.render_mode else None

    def close(self) -> None:
        """Release what draws the pictures."""
        self.reacher.close()


gym.register("HiddenTargetReacher-v0", entry_point=HiddenTargetReacherEnv, max_episode_steps=50)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env

    env = make_task_vec_env("HiddenTargetReacher-v0", n_envs=20, seed=0)
    model = PEARL("MlpPolicy", env, seed=0, verbose=1).learn(150_000)
    returns, successes = evaluate_adaptation(model, env)
    for episode in (0, 4, 19):
        print(f"episode {episode + 1}: return {returns[:, episode].mean():.1f}, solved {successes[:, episode].mean():.0%}")
