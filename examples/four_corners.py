"""A sparse family of the literature: a point robot must find out which of four corners has the goal.

    python examples/four_corners.py                                       # meta-train and adapt
    sb3-htr train --env FourCorners-v0 --gym-packages examples.four_corners -n 150000

Corners, goal radius and time limit are those of HFR's four corners (Wan et al., 2022), where four goals are all tasks there
are. Here a goal lies up to 0.1 away from its corner, so that training, validation and test tasks can be different ones. Theirs
also has a region between the start and each goal that costs more than all else, and its episodes end at the goal; here nothing
is told apart before the goal is reached.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from htr_envs import DynamicsEnv, PositionGoalFamily
from htr_envs.dynamics import DynamicsVectorEnv
from htr_envs.point_robot import ARENA, PointRobotDynamics
from htr_envs.task_env import FloatArray

CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


class FourCornersFamily(PositionGoalFamily):
    """
    Goals in four places, as many in each.

    :param scatter: a goal is up to so far from its corner
    :param goal_radius: a goal is reached where the robot is nearer than this
    :param task_seed: seed of the 80 training, 20 validation and 100 test tasks
    """

    def __init__(self, scatter: float = 0.1, goal_radius: float = 0.2, task_seed: int = 1337) -> None:
        self.scatter = scatter
        tasks = self._around(np.resize(np.arange(4), 200), np.random.default_rng(task_seed))
        super().__init__(ARENA, goal_radius, tasks[:80], tasks[80:100], tasks[100:])

    def _around(self, corners: np.ndarray, rng: np.random.Generator) -> FloatArray:
        angle, distance = rng.uniform(0, 2 * np.pi, len(corners)), self.scatter * np.sqrt(rng.uniform(0, 1, len(corners)))
        offset = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return (CORNERS[corners] + offset).astype(np.float32)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        return self._around(rng.integers(4, size=n), rng)


class FourCornersEnv(DynamicsEnv):
    """One robot."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(FourCornersFamily(**family_kwargs), PointRobotDynamics(1), reward_type, render_mode)


class FourCornersVectorEnv(DynamicsVectorEnv):
    """Many robots that move together: only faster."""

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = 20, reward_type: str = "sparse", **family_kwargs: Any
    ) -> None:
        super().__init__(FourCornersFamily(**family_kwargs), PointRobotDynamics(num_envs), max_episode_steps, reward_type)


gym.register("FourCorners-v0", entry_point=FourCornersEnv, vector_entry_point=FourCornersVectorEnv, max_episode_steps=20)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env

    model = PEARL("MlpPolicy", make_task_vec_env("FourCorners-v0", n_envs=20, seed=0), seed=0, verbose=1).learn(150_000)
    returns, successes = evaluate_adaptation(model, "FourCorners-v0", n_episodes=6)
    for episode in range(6):
        print(f"episode {episode + 1}: return {returns[:, episode].mean():.1f}, solved {successes[:, episode].mean():.0%}")
