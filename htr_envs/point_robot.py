"""Sparse Point Robot: find an unseen goal on a semicircle."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from htr_envs.dynamics import Dynamics, DynamicsEnv, DynamicsVectorEnv, refuse_pictures
from htr_envs.semicircle_goals import SemicircleGoalFamily
from htr_envs.task_env import BoolArray, FloatArray

ARENA = 10.0
STEP_SIZE = np.float32(0.1)


class PointRobotFamily(SemicircleGoalFamily):
    """Goals on a semicircle, worth 1 minus the distance within the goal radius and 0 outside.

    With the default arguments the training goals are those of PEARL's reference implementation.

    :param goal_distance: distance of the goals from the start, at most 10.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param task_sets: sizes and seed of the task sets, see :class:`SemicircleGoalFamily`.
    :raises ValueError: if a number is out of range.
    """

    def __init__(self, goal_distance: float = 1.0, goal_radius: float = 0.2, **task_sets: Any) -> None:
        super().__init__(ARENA, goal_distance, goal_radius, **task_sets)


class PointRobotDynamics(Dynamics[PointRobotFamily]):
    """The robots of :class:`PointRobotEnv`; their states are their positions.

    :param num_envs: how many robots.
    """

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, spaces.Box(-ARENA, ARENA, (2,), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32))
        self.states = np.zeros((num_envs, 2), dtype=np.float32)

    def reset(self, indices: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
        self.states[indices] = 0.0
        return self.states[indices]

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        # the walls are out of reach in 20 steps; they keep the observation's bounds true for any time limit
        self.states = np.clip(self.states + STEP_SIZE * np.clip(actions, -1.0, 1.0), -ARENA, ARENA)
        return self.states, np.zeros(self.num_envs, dtype=np.float32), np.zeros(self.num_envs, dtype=np.bool_)

    def render(self, task_family: PointRobotFamily, task: FloatArray, path: FloatArray, render_mode: str) -> NDArray[np.uint8]:
        """Draw the arena, the semicircle of possible goals, the goal, filled strongly while the robot is in it, and the path.

        :return: picture (400, 400, 3), uint8.
        """
        # imported here: who never renders needs no Pillow
        from htr_envs.rendering import BLUE, ORANGE, PALE_ORANGE, Canvas

        distance, radius = task_family.goal_distance, task_family.goal_radius
        # 20 steps lead at most 2 along each axis: a robot of that episode length never leaves the picture
        canvas = Canvas(max(2.2, 1.1 * distance + radius))
        canvas.circle((0.0, 0.0), distance, 3, PALE_ORANGE, upper_half=True)
        canvas.axes()
        reached = bool(np.hypot(*(path[-1] - task)) < radius)
        canvas.disc(task, radius, ORANGE if reached else PALE_ORANGE)
        canvas.circle(task, radius, 2, ORANGE)
        canvas.path(path)
        canvas.legend([("goal, hidden from the agent", ORANGE), ("start", None), ("robot", BLUE)])
        return canvas.image()


class PointRobotEnv(DynamicsEnv):
    """
    ## Description

    A point robot on a plane must find a goal that it cannot see. The goal lies somewhere on a semicircle around the start, the
    reward is zero until the robot is within the goal's radius. It is the sparse 2-D navigation family of PEARL
    (Rakelly et al., 2019), on which Hindsight Task Relabelling (Packer et al., 2021, appendix A.3) is tested too.

    ## Action Space

    The action is clipped to the box and multiplied by 0.1.

    | Num | Action                 | Min | Max | Unit         |
    |-----|------------------------|-----|-----|--------------|
    | 0   | displacement along x   | -1  | 1   | 0.1 lengths  |
    | 1   | displacement along y   | -1  | 1   | 0.1 lengths  |

    ## Observation Space

    | Num | Observation | Min | Max | Unit   |
    |-----|-------------|-----|-----|--------|
    | 0   | position x  | -10 | 10  | length |
    | 1   | position y  | -10 | 10  | length |

    Nothing in it tells the goal.

    ## Rewards

    With `d` the distance between the next state and the goal:

    - `reward_type="sparse"`: `1 - d` if `d < goal_radius`, else `0`.
    - `reward_type="dense"`: `-d`, the proxy reward of the oracle baseline.

    There is no task-free reward: `info["task_free_reward"]` is 0. `info["is_success"]` is `d < goal_radius`.

    ## Task distribution

    A task is a goal position `(x, y)` at `goal_distance` from the start, at an angle between 0 and pi. The 80 training tasks
    are four fifths of 100 angles, evenly spaced from end to end and shuffled by `task_seed`. The 20 validation and the 100
    test tasks are drawn, uniformly and in balance: one from each of as many equal sectors. `task_space` is the whole arena,
    because a hindsight task is any position that the robot reached.

    The paper gives the two rewards and the radius 0.2. It does not give the goal distance, the training tasks, the episode
    length and the step size: those are PEARL's, taken from its reference implementation, which tests on the 20 other angles.
    The validation and test tasks and the walls at +-10 are our choice.

    A uniformly random policy reaches the goal in about 0.05 % of its episodes (0.04 % of 25,000 on the test tasks, by
    `examples/floor_and_ceiling.py`), and more distant goals more rarely still.

    ## Starting State

    The robot starts at (0, 0).

    ## Episode End

    ### Termination

    Never, not even at the goal.

    ### Truncation

    After 20 steps.

    ## Arguments

    | Parameter            | Default    | Description                                                       |
    |----------------------|------------|-------------------------------------------------------------------|
    | `goal_distance`      | `1.0`      | distance of the goals from the start                              |
    | `goal_radius`        | `0.2`      | distance to the goal below which it is reached                    |
    | `n_train_tasks`      | `80`       | number of training tasks                                          |
    | `n_test_tasks`       | `100`      | number of test tasks                                              |
    | `n_validation_tasks` | `20`       | number of validation tasks                                        |
    | `task_seed`          | `1337`     | seed of the task sets, apart from the run's seed                  |
    | `held_out`           | `None`     | degrees (from, to): no training tasks, all others                 |
    | `reward_type`        | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`                         |
    | `render_mode`        | `None`     | `"rgb_array"` for pictures, `"human"` for a window                |

    `reset(options={"task_id": i})` or `reset(options={"task": [x, y]})` gives the env a task, which stays until it is changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        super().__init__(PointRobotFamily(**family_kwargs), PointRobotDynamics(1), reward_type, render_mode)


class PointRobotVectorEnv(DynamicsVectorEnv):
    """Many point robots that step together; see :class:`PointRobotEnv` for what they do.

    :param num_envs: how many robots.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param family_kwargs: arguments of :class:`PointRobotFamily`.
    """

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = 20, reward_type: str = "sparse", **family_kwargs: Any
    ) -> None:
        refuse_pictures(family_kwargs)
        super().__init__(PointRobotFamily(**family_kwargs), PointRobotDynamics(num_envs), max_episode_steps, reward_type)
