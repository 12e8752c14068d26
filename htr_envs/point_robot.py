"""Sparse Point Robot: find an unseen goal on a semicircle."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from htr_envs.rendering import draw_point_robot
from htr_envs.semicircle_goals import SemicircleGoalFamily
from htr_envs.task_env import BoolArray, FloatArray, TaskEnv
from htr_envs.task_vector_env import TaskVectorEnv

ARENA = 10.0
STEP_SIZE = np.float32(0.1)
RENDER_MODES = ("rgb_array",)


def _move(positions: FloatArray, actions: FloatArray) -> FloatArray:
    # the walls are out of reach in 20 steps; they keep the observation's bounds true for any time limit
    moved: FloatArray = np.clip(positions + STEP_SIZE * np.clip(actions, -1.0, 1.0), -ARENA, ARENA)
    return moved


def _observation_space() -> spaces.Box:
    return spaces.Box(-ARENA, ARENA, (2,), np.float32)


def _action_space() -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (2,), np.float32)


class PointRobotFamily(SemicircleGoalFamily):
    """Goals on a semicircle, worth 1 minus the distance within the goal radius and 0 outside.

    With the default arguments the goals and their split are those of PEARL's reference implementation.

    :param goal_distance: distance of the goals from the start, at most 10.
    :param goal_radius: a goal is reached where the distance to it is smaller than this, at most 1.
    :param task_sets: sizes and seed of the task sets, see :class:`SemicircleGoalFamily`.
    :raises ValueError: if a number is out of range.
    """

    def __init__(self, goal_distance: float = 1.0, goal_radius: float = 0.2, **task_sets: int) -> None:
        super().__init__(ARENA, goal_distance, goal_radius, **task_sets)


class PointRobotEnv(TaskEnv):
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

    A task is a goal position `(x, y)` at `goal_distance` from the start, at an angle between 0 and pi. The train and test
    tasks take evenly spaced angles, shuffled by `task_seed`: the first 80 are train tasks, the next 20 test tasks. The 20
    validation tasks take uniformly drawn angles. `task_space` is the whole arena, because a hindsight task is any position
    that the robot reached.

    The paper gives the two rewards and the radius 0.2. It does not give the goal distance, the number of tasks, their split,
    the episode length and the step size: those are PEARL's values, taken from its reference implementation. The validation
    tasks and the walls at +-10 are our choice.

    A uniformly random policy reaches the goal in 0.05 % of its episodes (501 of 1,000,000 measured), and more distant goals
    more rarely still.

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
    | `n_test_tasks`       | `20`       | number of test tasks                                              |
    | `n_validation_tasks` | `20`       | number of validation tasks                                        |
    | `task_seed`          | `1337`     | seed of the task sets, apart from the run's seed                  |
    | `reward_type`        | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`                         |
    | `render_mode`        | `None`     | `"rgb_array"` for pictures                                        |

    `reset(options={"task_id": i})` or `reset(options={"task": [x, y]})` gives the env a task, which stays until it is changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # type: ignore[misc]

    def __init__(self, reward_type: str = "sparse", render_mode: str | None = None, **family_kwargs: Any) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}, but only 'rgb_array' exists: pass it or None.")
        super().__init__(PointRobotFamily(**family_kwargs), reward_type)
        self.observation_space = _observation_space()
        self.action_space = _action_space()
        self.render_mode = render_mode
        self._path: list[FloatArray] = []

    def _reset_state(self) -> FloatArray:
        self._path = [np.zeros(2, dtype=np.float32)]
        return self._path[0]

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        self._path.append(_move(self._path[-1], action))
        return self._path[-1], 0.0, False

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the arena, the goal of the current episode and the path so far.

        :return: picture (400, 400, 3), uint8; None without a render mode.
        """
        if self.render_mode is None:
            return None
        assert isinstance(self.task_family, PointRobotFamily)
        return draw_point_robot(np.stack(self._path), self.task, self.task_family.goal_distance, self.task_family.goal_radius)


class PointRobotVectorEnv(TaskVectorEnv):
    """Many point robots that step together; see :class:`PointRobotEnv` for what they do.

    :param num_envs: how many robots.
    :param max_episode_steps: steps after which an episode is truncated, None for never.
    :param reward_type: reward of ``step``, ``"sparse"`` or ``"dense"``.
    :param family_kwargs: arguments of :class:`PointRobotFamily`.
    """

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = 20, reward_type: str = "sparse", **family_kwargs: Any
    ) -> None:
        family = PointRobotFamily(**family_kwargs)
        super().__init__(family, num_envs, _observation_space(), _action_space(), max_episode_steps, reward_type)
        self._positions = np.zeros((num_envs, 2), dtype=np.float32)

    def _reset_state(self, indices: NDArray[np.int64]) -> FloatArray:
        self._positions[indices] = 0.0
        return self._positions[indices]

    def _step_state(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        self._positions = _move(self._positions, actions)
        return self._positions, np.zeros(self.num_envs, dtype=np.float32), np.zeros(self.num_envs, dtype=np.bool_)
