"""Task families with sparse rewards for meta-reinforcement learning. Importing the package registers the environments."""

from gymnasium.envs.registration import register

from htr_envs.check_task_env import check_task_env
from htr_envs.dynamics import Dynamics, DynamicsEnv, DynamicsVectorEnv
from htr_envs.point_robot import PointRobotEnv, PointRobotFamily, PointRobotVectorEnv
from htr_envs.semicircle_goals import LocomotionFamily, SemicircleGoalFamily
from htr_envs.target_speed import TargetSpeedEnv, TargetSpeedFamily, TargetSpeedVectorEnv
from htr_envs.task_env import TaskEnv, TaskFamily, Trajectory, at_step, check_reward_type
from htr_envs.task_vector_env import TaskVectorEnv

__all__ = [
    "Dynamics",
    "DynamicsEnv",
    "DynamicsVectorEnv",
    "LocomotionFamily",
    "PointRobotEnv",
    "PointRobotFamily",
    "PointRobotVectorEnv",
    "SemicircleGoalFamily",
    "TargetSpeedEnv",
    "TargetSpeedFamily",
    "TargetSpeedVectorEnv",
    "TaskEnv",
    "TaskFamily",
    "TaskVectorEnv",
    "Trajectory",
    "at_step",
    "check_reward_type",
    "check_task_env",
]

register(
    id="SparsePointRobot-v0",
    entry_point="htr_envs.point_robot:PointRobotEnv",
    vector_entry_point="htr_envs.point_robot:PointRobotVectorEnv",
    max_episode_steps=20,
)
register(
    id="SparseTargetSpeed-v0",
    entry_point="htr_envs.target_speed:TargetSpeedEnv",
    vector_entry_point="htr_envs.target_speed:TargetSpeedVectorEnv",
    max_episode_steps=40,
)
# These two need MuJoCo, and are imported only when they are made.
register(
    id="SparseWheeled-v0",
    entry_point="htr_envs.wheeled:WheeledEnv",
    vector_entry_point="htr_envs.wheeled:WheeledVectorEnv",
    max_episode_steps=200,
)
register(
    id="SparseAnt-v0",
    entry_point="htr_envs.ant:AntEnv",
    vector_entry_point="htr_envs.ant:AntVectorEnv",
    max_episode_steps=200,
)
