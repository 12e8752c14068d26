"""A sparse family of the literature: gymnasium's half-cheetah is rewarded only near a speed that it is not told.

    python examples/sparse_half_cheetah_velocity.py                                # meta-train and adapt
    sb3-htr train --env SparseHalfCheetahVelocity-v0 --gym-packages examples.sparse_half_cheetah_velocity -n 1000000

Tasks, reward and time limit are those on which HFR (Wan, Peng and Gangwani, 2022) was tested, in a million env steps. It
differs in gymnasium's observation, to which the speed is added: a reward must follow from what is observed.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from numpy.typing import ArrayLike

from htr_envs import TaskEnv, TaskFamily, Trajectory, at_step, check_reward_type
from htr_envs.headless import open_no_window
from htr_envs.task_env import BoolArray, FloatArray

# What a step within the band is worth, less the difference to the speed
WORTH = np.float32(2)
# Beyond what a cheetah does, in metres per second, forwards and backwards
TOP_SPEED = 20.0


class SpeedFamily(TaskFamily):
    """
    Speeds, in metres per second; worth 2 less the difference within the band.

    :param fastest: of all tasks, the slowest is 0
    :param band: a speed is held where the difference to it is smaller than this
    :param task_seed: seed of the 100 training, 20 validation and 30 test tasks
    """

    def __init__(self, fastest: float = 3.0, band: float = 0.3, task_seed: int = 1337) -> None:
        self.fastest, self.band = fastest, band
        tasks = self.sample_tasks(150, np.random.default_rng(task_seed))
        super().__init__(spaces.Box(-TOP_SPEED, TOP_SPEED, (1,), np.float32), tasks[:100], tasks[100:120], tasks[120:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        return rng.uniform(0, self.fastest, (n, 1)).astype(np.float32)

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        check_reward_type(reward_type)
        error = self._error(traj, task)
        sparse = np.where(error < self.band, WORTH - error, np.float32(0))
        return np.asarray((-error if reward_type == "dense" else sparse) + traj.task_free_reward, dtype=np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        return np.asarray(self._error(traj, task) < self.band)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        return at_step(traj.next_observations[..., -1:], index)

    @staticmethod
    def _error(traj: Trajectory, task: ArrayLike) -> FloatArray:
        error: FloatArray = np.abs(traj.next_observations[..., -1] - np.asarray(task, dtype=np.float32)[..., None, 0])
        return error


class SparseHalfCheetahVelocityEnv(TaskEnv):
    """
    HalfCheetah-v5, whose observation ends with its mean forward speed in the last step. Actions are its own.

    :param reward_type: ``"sparse"`` or ``"dense"``
    :param render_mode: ``"rgb_array"`` or None
    :param family_kwargs: of :class:`SpeedFamily`
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(SpeedFamily(**family_kwargs), reward_type)
        self.render_mode = render_mode
        if render_mode is not None:
            open_no_window(render_mode)
        self.cheetah = HalfCheetahEnv(render_mode=render_mode, ctrl_cost_weight=0.05)
        self.observation_space = spaces.Box(-np.inf, np.inf, (18,), np.float32)
        self.action_space = spaces.Box(-1, 1, (6,), np.float32)

    def _reset_state(self) -> FloatArray:
        obs, _ = self.cheetah.reset(seed=int(self.np_random.integers(2**31)))
        return np.append(obs, 0).astype(np.float32)

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        obs, _, _, _, info = self.cheetah.step(np.clip(action, -1, 1))
        speed = np.clip(info["x_velocity"], -TOP_SPEED, TOP_SPEED)
        return np.append(obs, speed).astype(np.float32), info["reward_ctrl"], False

    def render(self) -> Any:
        """Picture (480, 480, 3), uint8; None without a render mode."""
        return self.cheetah.render() if self.render_mode else None

    def close(self) -> None:
        """Release what draws the pictures."""
        self.cheetah.close()


gym.register("SparseHalfCheetahVelocity-v0", entry_point=SparseHalfCheetahVelocityEnv, max_episode_steps=200)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env

    model = PEARL("MlpPolicy", make_task_vec_env("SparseHalfCheetahVelocity-v0", n_envs=20, seed=0), seed=0, verbose=1)
    returns, successes = evaluate_adaptation(model.learn(1_000_000), "SparseHalfCheetahVelocity-v0", n_episodes=3)
    for episode in range(3):
        print(f"episode {episode + 1}: return {returns[:, episode].mean():.0f}, solved {successes[:, episode].mean():.0%}")
