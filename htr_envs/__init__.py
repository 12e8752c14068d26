"""Task families with sparse rewards for meta-reinforcement learning. Importing the package registers the environments."""

from gymnasium.envs.registration import register

from htr_envs.check_task_env import check_task_env
from htr_envs.dynamics import Dynamics, DynamicsEnv, DynamicsVectorEnv
from htr_envs.goal_env import HiddenGoalEnv, HiddenGoalFamily, hide_goal
from htr_envs.hidden_goal_wrapper import HiddenGoalWrapper
from htr_envs.meta_env import MetaEnv, TaskDistribution
from htr_envs.point_robot import PointRobotEnv, PointRobotFamily, PointRobotVectorEnv
from htr_envs.position_goals import PositionGoalFamily
from htr_envs.semicircle_goals import AntGoalFamily, LocomotionFamily, SemicircleGoalFamily
from htr_envs.target_speed import TargetSpeedEnv, TargetSpeedFamily, TargetSpeedVectorEnv
from htr_envs.task_env import TaskEnv, TaskFamily, Trajectory, at_step, check_reward_type
from htr_envs.task_vector_env import TaskVectorEnv

__all__ = [
    "AntGoalFamily",
    "Dynamics",
    "DynamicsEnv",
    "DynamicsVectorEnv",
    "HiddenGoalEnv",
    "HiddenGoalFamily",
    "HiddenGoalWrapper",
    "LocomotionFamily",
    "MetaEnv",
    "PointRobotEnv",
    "PointRobotFamily",
    "PointRobotVectorEnv",
    "PositionGoalFamily",
    "SemicircleGoalFamily",
    "TargetSpeedEnv",
    "TargetSpeedFamily",
    "TargetSpeedVectorEnv",
    "TaskDistribution",
    "TaskEnv",
    "TaskFamily",
    "TaskVectorEnv",
    "Trajectory",
    "at_step",
    "check_reward_type",
    "check_task_env",
    "hide_goal",
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
# GoalEnvs of other packages, which are imported only when they are made: name, id, time limit.
for _name, _goal_env_id, _max_episode_steps in (
    ("FetchReach", "gymnasium_robotics:FetchReach-v4", 50),
    ("FetchPush", "gymnasium_robotics:FetchPush-v4", 50),
    ("FetchSlide", "gymnasium_robotics:FetchSlide-v4", 50),
    ("FetchPickAndPlace", "gymnasium_robotics:FetchPickAndPlace-v4", 50),
    ("PointMazeUMaze", "gymnasium_robotics:PointMaze_UMaze-v3", 300),
    ("PointMazeMedium", "gymnasium_robotics:PointMaze_Medium-v3", 600),
    ("AntMazeUMaze", "gymnasium_robotics:AntMaze_UMaze-v5", 700),
    ("PandaReach", "panda_gym:PandaReach-v3", 50),
    ("MetaWorldReach", "MetaWorldReach-v0", 500),
    ("MetaWorldPush", "MetaWorldPush-v0", 500),
):
    register(
        id=f"Hidden{_name}-v0",
        entry_point="htr_envs.goal_env:HiddenGoalEnv",
        max_episode_steps=_max_episode_steps,
        kwargs={"env_id": _goal_env_id},
    )
for _task in ("Reach", "Push"):
    register(
        id=f"MetaWorld{_task}-v0",
        entry_point="htr_envs.meta_world:MetaWorldGoalEnv",
        max_episode_steps=500,
        kwargs={"task": _task.lower()},
    )
