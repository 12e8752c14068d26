"""Sparse Wheeled: drive a robot with two wheels to an unseen goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from htr_envs.arguments import finite_float
from htr_envs.dynamics import DynamicsEnv
from htr_envs.mujoco_dynamics import (  # says so where MuJoCo is missing
    DoubleArray,
    MujocoDynamics,
    MujocoVectorEnv,
    mujoco,
)
from htr_envs.semicircle_goals import LOCOMOTION_ARENA, LocomotionFamily
from htr_envs.task_env import BoolArray, FloatArray

MODEL = Path(__file__).parent / "assets" / "wheeled.xml"
WHEEL_RADIUS = 0.1
TOP_SPEED = 10.0  # of the robot and of its wheels' rims, m/s; out of reach, as is the next one
TOP_TURN_RATE = 100.0  # rad/s


class WheeledDynamics(MujocoDynamics):
    """The robots of :class:`WheeledEnv`.

    :param num_envs: how many robots.
    :param n_threads: how many threads step them, see :class:`htr_envs.mujoco_dynamics.MujocoDynamics`.
    :param ctrl_cost_weight: weight of the control cost.
    :param reset_noise_scale: noise of the starting state.
    """

    frame_skip = 2
    n_exact_positions = 3  # x, y, and z, with which the robot stands on the floor
    envs_per_thread = 32

    def __init__(self, num_envs: int, n_threads: int | None, ctrl_cost_weight: float, reset_noise_scale: float) -> None:
        bounds = [*[LOCOMOTION_ARENA] * 2, 1.0, 1.0, TOP_SPEED, TOP_SPEED, TOP_TURN_RATE, TOP_SPEED, TOP_SPEED]
        spec = mujoco.MjSpec.from_file(str(MODEL))
        super().__init__(num_envs, n_threads, spec, reset_noise_scale, np.array(bounds, dtype=np.float32))
        self.ctrl_cost_weight = finite_float("ctrl_cost_weight", ctrl_cost_weight)

    def _start_position(self) -> DoubleArray:
        return np.array([0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0])

    def _observe(self, states: DoubleArray) -> DoubleArray:
        x, y, _, heading, _, _ = self.positions(states).T
        velocity_x, velocity_y, _, turn_rate, left_wheel, right_wheel = self.velocities(states).T
        # copied, because numpy may compute them otherwise for numbers that do not lie side by side in memory
        heading = heading.copy()
        cos, sin = np.cos(heading), np.sin(heading)
        forwards = cos * velocity_x + sin * velocity_y
        sideways = cos * velocity_y - sin * velocity_x
        rims = WHEEL_RADIUS * left_wheel, WHEEL_RADIUS * right_wheel
        return np.stack((x, y, cos, sin, forwards, sideways, turn_rate, *rims), axis=-1)

    def _is_healthy(self, states: DoubleArray) -> BoolArray:
        return np.ones(len(states), dtype=np.bool_)

    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        return -self.ctrl_cost_weight * np.square(actions).sum(axis=-1)


def _wheeled(
    num_envs: int,
    n_threads: int | None,
    /,
    ctrl_cost_weight: float = 0.005,
    reset_noise_scale: float = 0.01,
    **family_kwargs: Any,
) -> tuple[LocomotionFamily, WheeledDynamics]:
    return LocomotionFamily(**family_kwargs), WheeledDynamics(num_envs, n_threads, ctrl_cost_weight, reset_noise_scale)


class WheeledEnv(DynamicsEnv):
    """
    ## Description

    A robot on two driven wheels must find a goal that it cannot see. The goal lies somewhere on a semicircle around the start,
    the reward for it is zero until the robot is within the goal's radius. It is the sparse form of the wheeled locomotion
    family of MAESN (Gupta et al., 2018), on which Hindsight Task Relabelling (Packer et al., 2021, appendix A.3) is tested.

    The model is our own: a robot of 2 kg, with a wheel of radius 0.1 m on either side, 0.3 m apart. It slides along x, y and
    z and turns about z, but never tips over. Only the friction of the wheels on the floor moves it, and it slips where the
    motors ask for more. Wheels at full power accelerate it by 13 m/s² up to 5.3 m/s, or turn it by 90° within 0.17 s.

    ## Action Space

    The action is clipped to the box. The motors' gear does the scaling to torque.

    | Num | Action                    | Min | Max | Name (in `wheeled.xml`) | Joint | Unit    |
    |-----|---------------------------|-----|-----|-------------------------|-------|---------|
    | 0   | torque on the left wheel  | -1  | 1   | left_wheel              | hinge | 1.6 N m |
    | 1   | torque on the right wheel | -1  | 1   | right_wheel             | hinge | 1.6 N m |

    ## Observation Space

    The bounds are out of reach within 200 steps; an observation is clipped to them.

    | Num | Observation                    | Min  | Max | Unit  |
    |-----|--------------------------------|------|-----|-------|
    | 0   | position x                     | -20  | 20  | m     |
    | 1   | position y                     | -20  | 20  | m     |
    | 2   | cosine of the heading          | -1   | 1   |       |
    | 3   | sine of the heading            | -1   | 1   |       |
    | 4   | velocity forwards              | -10  | 10  | m/s   |
    | 5   | velocity sideways, to the left | -10  | 10  | m/s   |
    | 6   | turn rate, anticlockwise       | -100 | 100 | rad/s |
    | 7   | speed of the left wheel's rim  | -10  | 10  | m/s   |
    | 8   | speed of the right wheel's rim | -10  | 10  | m/s   |

    Nothing in it tells the goal.

    ## Rewards

    With `d` the distance between the next position and the goal:

    - `reward_type="sparse"`: `1 - d` if `d < goal_radius`, else `0`.
    - `reward_type="dense"`: `-d`, the proxy reward of the oracle baseline.

    Both plus the task-free reward, a control cost of `ctrl_cost_weight` times the squared length of the clipped action.
    `info["is_success"]` is `d < goal_radius`.

    The paper makes the goal's reward sparse in meta-training and meta-test, and leaves the other terms as they are in MAESN,
    whose code has a control cost only for this robot. The formula within the radius is our choice: the one that the paper
    gives for the point robot. A success is thus worth at least `1 - goal_radius`, well above any control cost. Outside of the
    radius MAESN pays minus the goal's distance from the start, which would tell hindsight tasks apart without a visit: here it
    is 0.

    ## Task distribution

    A task is a goal position `(x, y)` at `goal_distance` from the start, at an angle between 0 and pi. The 80 training tasks
    are four fifths of 100 angles, evenly spaced from end to end and shuffled by `task_seed`. The 20 validation and the 100
    test tasks are drawn, uniformly and in balance: one from each of as many equal sectors. `task_space` is a square that
    no robot leaves within 200 steps, because a hindsight task is any position that the robot reached.

    The distance 2, the angles and the 200 steps of 0.01 s are MAESN's. The training tasks have the angles of
    PEARL's point robot, the validation and test tasks are our choice. So is the radius 0.5, where MAESN has 0.8: a larger
    disc makes tasks overlap more, and more hindsight tasks contain the start, which are solved without moving.

    A uniformly random policy never reached its goal in 25,000 episodes, by `examples/floor_and_ceiling.py`. It gets 0.23 m
    away from the start on average, 0.46 m in one episode of 20. A simple feedback controller that knows the goal is there
    after 0.7 to 0.8 s, and stays.

    ## Starting State

    The robot stands at (0, 0) and faces along y, the middle of the semicircle. Uniform noise of `reset_noise_scale` is added
    to its heading and its wheels' angles (rad), normal noise of that standard deviation to all velocities (m/s, rad/s).

    ## Episode End

    ### Termination

    Never, not even at the goal; only a simulation that has become unstable ends an episode.

    ### Truncation

    After 200 steps, which are 2 seconds.

    ## Arguments

    | Parameter            | Default    | Description                                        |
    |----------------------|------------|----------------------------------------------------|
    | `reward_type`        | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`          |
    | `render_mode`        | `None`     | `"human"` for a window, `"rgb_array"` for pictures |
    | `ctrl_cost_weight`   | `0.005`    | weight of the control cost; our choice, see below  |
    | `reset_noise_scale`  | `0.01`     | noise of the starting state; our choice            |
    | `goal_distance`      | `2.0`      | distance of the goals from the start               |
    | `goal_radius`        | `0.5`      | distance to the goal below which it is reached     |
    | `n_train_tasks`      | `80`       | number of training tasks                           |
    | `n_test_tasks`       | `100`      | number of test tasks                               |
    | `n_validation_tasks` | `20`       | number of validation tasks                         |
    | `task_seed`          | `1337`     | seed of the task sets, apart from the run's seed   |
    | `held_out`           | `None`     | degrees (from, to): no training tasks, all others  |

    MAESN's control cost, 0.05 times the squared control of up to 2, is up to 0.4 a step. Beside a reward of at most 1 that
    only few steps see, it would pay to stand still. The default costs at most 0.01 a step.

    `gymnasium.make_vec("SparseWheeled-v0", n)` steps n robots in native threads. It takes `n_threads` as well, by default
    `OMP_NUM_THREADS` if that is set, else one for each CPU, with at least 32 robots for each thread.
    `reset(options={"task_id": i})` or `reset(options={"task": [x, y]})` gives the env a task, which stays until it is
    changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 100}  # type: ignore[misc]

    def __init__(
        self, reward_type: str = "sparse", render_mode: str | None = None, n_threads: int | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*_wheeled(1, n_threads, **kwargs), reward_type, render_mode)


class WheeledVectorEnv(MujocoVectorEnv):
    """Many two-wheeled robots that step together, in native threads; see :class:`WheeledEnv` for what they do."""

    make = staticmethod(_wheeled)
