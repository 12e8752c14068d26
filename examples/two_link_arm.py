"""A task family of one's own in one file: the tip of a two-link arm must find a goal, anywhere in a ring around its shoulder.

    python examples/two_link_arm.py                                                     # meta-train and adapt, some minutes
    sb3-htr train --env TwoLinkArm-v0 --gym-packages examples.two_link_arm -n 200000    # the same from the command line

A random arm touches a given goal in one of 200 episodes, and goals lie in all directions and at several distances: nothing
that can be listed.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from htr_envs import Trajectory
from htr_envs.dynamics import Dynamics, DynamicsEnv, DynamicsVectorEnv
from htr_envs.task_env import BoolArray, FloatArray, TaskFamily, at_step, check_reward_type, l2_distance

LINK = 0.5
# Of the joints in a step, in rad
MAX_TURN = np.float32(0.15)
# Folded, the tip near the shoulder
START = np.array([0.0, 3.1], dtype=np.float32)
# Where the tip stands in an observation
TIP = slice(4, 6)


class TwoLinkArmFamily(TaskFamily):
    """
    Goals drawn uniformly by angle and by distance from the shoulder; worth 1 minus the distance where the tip is in reach.

    :param nearest: smallest distance of a goal from the shoulder
    :param farthest: largest distance
    :param goal_radius: a goal is reached where the tip is nearer than this
    :param n_train_tasks: number of training tasks
    :param n_validation_tasks: number of validation tasks
    :param n_test_tasks: number of test tasks
    :param task_seed: seed of the three sets
    """

    def __init__(
        self,
        nearest: float = 0.5,
        farthest: float = 0.95,
        goal_radius: float = 0.12,
        n_train_tasks: int = 70,
        n_validation_tasks: int = 20,
        n_test_tasks: int = 100,
        task_seed: int = 1337,
    ) -> None:
        self.nearest, self.farthest, self.goal_radius = nearest, farthest, goal_radius
        sets = (
            self.sample_tasks(n, np.random.default_rng([task_seed, purpose]))
            for purpose, n in enumerate((n_train_tasks, n_validation_tasks, n_test_tasks))
        )
        super().__init__(spaces.Box(-1.01, 1.01, (2,), np.float32), *sets)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        angle, distance = rng.uniform(0, 2 * np.pi, n), rng.uniform(self.nearest, self.farthest, n)
        return (distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).astype(np.float32)

    def compute_reward(self, traj: Trajectory, task: ArrayLike, reward_type: str = "sparse") -> FloatArray:
        check_reward_type(reward_type)
        distance = self._distance(traj, task)
        sparse = np.where(distance < self.goal_radius, 1 - distance, 0)
        return ((-distance if reward_type == "dense" else sparse) + traj.task_free_reward).astype(np.float32)

    def is_success(self, traj: Trajectory, task: ArrayLike) -> BoolArray:
        return np.asarray(self._distance(traj, task) < self.goal_radius)

    def hindsight_task(self, traj: Trajectory, index: ArrayLike) -> FloatArray:
        return at_step(traj.next_observations[..., TIP], index)

    @staticmethod
    def _distance(traj: Trajectory, task: ArrayLike) -> FloatArray:
        return l2_distance(traj.next_observations[..., TIP], np.asarray(task, dtype=np.float32)[..., None, :])


class TwoLinkArmDynamics(Dynamics[TwoLinkArmFamily]):
    """
    Two joints that turn as they are told.

    An action is what both turn by, in units of 0.15 rad, clipped to [-1, 1]. An observation is cosine and sine of both angles,
    and x and y of the tip.

    :param num_envs: how many arms
    """

    def __init__(self, num_envs: int) -> None:
        bound = np.array([1, 1, 1, 1, 1.01, 1.01], dtype=np.float32)
        super().__init__(num_envs, spaces.Box(-bound, bound), spaces.Box(-1, 1, (2,)))
        self.states = np.tile(START, (num_envs, 1))

    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        self.states[indices] = START
        return self._observe()[indices]

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        self.states = self.states + MAX_TURN * np.clip(actions, -1, 1)
        return self._observe(), np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, bool)

    def _observe(self) -> FloatArray:
        first, second = self.states[:, 0], self.states[:, 1]
        tip = [LINK * f(first) + LINK * f(first + second) for f in (np.cos, np.sin)]
        return np.stack([np.cos(first), np.sin(first), np.cos(second), np.sin(second), *tip], axis=-1)


class TwoLinkArmEnv(DynamicsEnv):
    """One arm."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", **family_kwargs: Any) -> None:
        super().__init__(TwoLinkArmFamily(**family_kwargs), TwoLinkArmDynamics(1), reward_type)


class TwoLinkArmVectorEnv(DynamicsVectorEnv):
    """Many arms that move together: only faster."""

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int = 40, reward_type: str = "sparse", **family_kwargs: Any
    ) -> None:
        super().__init__(TwoLinkArmFamily(**family_kwargs), TwoLinkArmDynamics(num_envs), max_episode_steps, reward_type)


gym.register("TwoLinkArm-v0", entry_point=TwoLinkArmEnv, vector_entry_point=TwoLinkArmVectorEnv, max_episode_steps=40)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env

    model = PEARL("MlpPolicy", make_task_vec_env("TwoLinkArm-v0", n_envs=20, seed=0), seed=0, verbose=1).learn(200_000)
    env = make_task_vec_env("TwoLinkArm-v0", n_envs=100)
    returns, successes = evaluate_adaptation(model, env, TwoLinkArmFamily().test_tasks)
    for episode in (0, 4, 19):
        print(f"episode {episode + 1}: return {returns[:, episode].mean():.1f}, solved {successes[:, episode].mean():.0%}")
