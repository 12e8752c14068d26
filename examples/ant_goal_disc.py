"""A sparse family of the literature: the ant must find a goal anywhere in a disc around its start.

    python examples/ant_goal_disc.py                                       # meta-train and adapt
    sb3-htr train --env AntGoalDisc-v0 --gym-packages examples.ant_goal_disc -n 600000 -params ent_coef:0.05

Disc, goal radius, time limit and the six episodes of an adaptation are those of the sparse ant goal of HyperX (Zintgraf et
al., 2021), which trains on it for 400 million env steps. The ant is that of SparseAnt-v0, with weak legs; theirs is
gymnasium's.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from htr_envs import DynamicsEnv, PositionGoalFamily
from htr_envs.ant import AntDynamics, AntVectorEnv
from htr_envs.mujoco_dynamics import MujocoVectorEnv
from htr_envs.semicircle_goals import LOCOMOTION_ARENA
from htr_envs.task_env import FloatArray


class DiscGoalFamily(PositionGoalFamily):
    """
    Goals drawn uniformly from a disc around the start.

    :param farthest: radius of the disc
    :param goal_radius: a goal is reached where the ant is nearer than this
    :param task_seed: seed of the 100 training, 20 validation and 100 test tasks
    """

    def __init__(self, farthest: float = 3.0, goal_radius: float = 0.75, task_seed: int = 1337) -> None:
        # An episode ends at a fall, which a dense reward must not pay for
        self.farthest = self.dense_level = farthest
        tasks = self.sample_tasks(220, np.random.default_rng(task_seed))
        super().__init__(LOCOMOTION_ARENA, goal_radius, tasks[:100], tasks[100:120], tasks[120:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        angle, distance = rng.uniform(0, 2 * np.pi, n), self.farthest * np.sqrt(rng.uniform(0, 1, n))
        return (distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).astype(np.float32)


def make(num_envs: int, n_threads: int | None, /, **family_kwargs: Any) -> tuple[DiscGoalFamily, AntDynamics]:
    """
    :param num_envs: how many ants
    :param n_threads: how many threads step them
    :param family_kwargs: of :class:`DiscGoalFamily`
    :return: tasks, and the ants of SparseAnt-v0
    """
    _, ants = AntVectorEnv.make(num_envs, n_threads)
    return DiscGoalFamily(**family_kwargs), ants


class AntGoalDiscEnv(DynamicsEnv):
    """One ant."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(*make(1, 1, **family_kwargs), reward_type, render_mode)


class AntGoalDiscVectorEnv(MujocoVectorEnv):
    """Many ants that move together: only faster."""

    make = staticmethod(make)


gym.register("AntGoalDisc-v0", entry_point=AntGoalDiscEnv, vector_entry_point=AntGoalDiscVectorEnv, max_episode_steps=200)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env

    model = PEARL("MlpPolicy", make_task_vec_env("AntGoalDisc-v0", n_envs=20, seed=0), ent_coef=0.05, seed=0, verbose=1)
    returns, successes = evaluate_adaptation(model.learn(600_000), "AntGoalDisc-v0", n_episodes=6)
    for episode in range(6):
        print(f"episode {episode + 1}: return {returns[:, episode].mean():.0f}, solved {successes[:, episode].mean():.0%}")
