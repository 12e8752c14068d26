"""Sparse Ant: walk on four weak legs to an unseen goal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np

from htr_envs.arguments import finite_float
from htr_envs.dynamics import DynamicsEnv
from htr_envs.mujoco_dynamics import (  # says so where MuJoCo is missing
    DoubleArray,
    MujocoDynamics,
    MujocoVectorEnv,
    mujoco,
)
from htr_envs.semicircle_goals import LOCOMOTION_ARENA, AntGoalFamily
from htr_envs.task_env import BoolArray, FloatArray

MODEL = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "ant.xml"
GEAR = 30.0
LOWER_LEGS = ("left_ankle_geom", "right_ankle_geom", "third_ankle_geom", "fourth_ankle_geom")
HEALTHY_Z_RANGE = (0.2, 1.0)


def _low_gear_ant() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(MODEL))
    for actuator in spec.actuators:
        actuator.gear[0] = GEAR
    for name in LOWER_LEGS:
        leg = spec.geom(name)
        # a little thicker than the leg, whose contacts lie on its surface
        leg.parent.add_site(name=name, type=leg.type, fromto=leg.fromto, size=1.2 * leg.size, group=4)
        spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)
    _calm_down(spec)
    return spec


def _calm_down(spec: mujoco.MjSpec) -> None:
    # gymnasium's ant walks on a black and white mirror in glaring light, where a goal is hard to see
    floor = spec.material("MatPlane")
    floor.reflectance, floor.specular, floor.shininess = 0.0, 0.0, 0.0
    checks = spec.texture("texplane")
    checks.rgb1, checks.rgb2 = [0.95, 0.95, 0.95], [0.87, 0.87, 0.87]
    spec.geom("floor").rgba = [1.0, 1.0, 1.0, 1.0]
    for light in spec.lights:
        light.diffuse = [0.6, 0.6, 0.6]


class AntDynamics(MujocoDynamics):
    """The robots of :class:`AntEnv`.

    :param num_envs: how many ants.
    :param n_threads: how many threads step them, see :class:`htr_envs.mujoco_dynamics.MujocoDynamics`.
    :param ctrl_cost_weight: weight of the control cost.
    :param contact_cost_weight: weight of the contact cost.
    :param healthy_reward: reward of each step that ends healthy.
    :param reset_noise_scale: noise of the starting state.
    """

    frame_skip = 5
    n_exact_positions = 2  # x, y
    envs_per_thread = 4

    def __init__(
        self,
        num_envs: int,
        n_threads: int | None,
        ctrl_cost_weight: float,
        contact_cost_weight: float,
        healthy_reward: float,
        reset_noise_scale: float,
    ) -> None:
        bounds = [*[LOCOMOTION_ARENA] * 2, 10.0, *[1.0] * 4, *[np.pi] * 8, *[100.0] * 14]
        super().__init__(num_envs, n_threads, _low_gear_ant(), reset_noise_scale, np.array(bounds, dtype=np.float32))
        self.ctrl_cost_weight = finite_float("ctrl_cost_weight", ctrl_cost_weight)
        self.contact_cost_weight = finite_float("contact_cost_weight", contact_cost_weight)
        self.healthy_reward = finite_float("healthy_reward", healthy_reward)

    def _start_position(self) -> DoubleArray:
        return np.array(self.model.qpos0)

    def start_states(self, n: int, rng: np.random.Generator) -> DoubleArray:
        states = super().start_states(n, rng)
        quaternions = self.positions(states)[:, 3:7]
        quaternions /= np.sqrt(np.square(quaternions).sum(axis=-1, keepdims=True))
        return states

    def _observe(self, states: DoubleArray) -> DoubleArray:
        return states[:, 1:]

    def _is_healthy(self, states: DoubleArray) -> BoolArray:
        low, high = HEALTHY_Z_RANGE
        z = self.positions(states)[:, 2]
        return (z >= low) & (z <= high)

    def task_free_reward(self, actions: FloatArray, states: DoubleArray, sensors: DoubleArray) -> FloatArray:
        contacts = np.clip(sensors, -1.0, 1.0).astype(np.float32)
        healthy = ~self.terminated(states)
        return (
            self.healthy_reward * healthy
            - self.ctrl_cost_weight * np.square(actions).sum(axis=-1)
            - self.contact_cost_weight * np.square(contacts).sum(axis=-1)
        )


def _ants(
    num_envs: int,
    n_threads: int | None,
    /,
    ctrl_cost_weight: float = 0.005,
    contact_cost_weight: float = 5e-4,
    healthy_reward: float = 0.05,
    reset_noise_scale: float = 0.01,
    **family_kwargs: Any,
) -> tuple[AntGoalFamily, AntDynamics]:
    dynamics = AntDynamics(num_envs, n_threads, ctrl_cost_weight, contact_cost_weight, healthy_reward, reset_noise_scale)
    return AntGoalFamily(**family_kwargs), dynamics


class AntEnv(DynamicsEnv):
    """
    ## Description

    An ant with weak motors must find a goal that it cannot see, and learn to walk for it. The goal lies somewhere on a
    semicircle around the start, the reward for it is zero until the ant is within the goal's radius. It is the sparse form of
    the ant family of MAESN (Gupta et al., 2018), on which Hindsight Task Relabelling (Packer et al., 2021, appendix A.3) is
    tested.

    The model is gymnasium's `ant.xml` with a gear of 30 instead of 150, as in MAESN's low-gear ant, with touch sensors on the
    lower legs, and with a solver that starts cold, so that the state alone determines the next one.

    ## Action Space

    The action is clipped to the box.

    | Num | Action                          | Min | Max | Name (in `ant.xml`) | Joint | Unit   |
    |-----|---------------------------------|-----|-----|---------------------|-------|--------|
    | 0   | torque on the back right hip    | -1  | 1   | hip_4               | hinge | 30 N m |
    | 1   | torque on the back right ankle  | -1  | 1   | ankle_4             | hinge | 30 N m |
    | 2   | torque on the front left hip    | -1  | 1   | hip_1               | hinge | 30 N m |
    | 3   | torque on the front left ankle  | -1  | 1   | ankle_1             | hinge | 30 N m |
    | 4   | torque on the front right hip   | -1  | 1   | hip_2               | hinge | 30 N m |
    | 5   | torque on the front right ankle | -1  | 1   | ankle_2             | hinge | 30 N m |
    | 6   | torque on the back left hip     | -1  | 1   | hip_3               | hinge | 30 N m |
    | 7   | torque on the back left ankle   | -1  | 1   | ankle_3             | hinge | 30 N m |

    ## Observation Space

    Positions and velocities of the model. The bounds are out of reach in practice; an observation is clipped to them.

    | Num   | Observation                                                              | Min  | Max | Unit  |
    |-------|--------------------------------------------------------------------------|------|-----|-------|
    | 0     | position x of the torso                                                  | -20  | 20  | m     |
    | 1     | position y of the torso                                                  | -20  | 20  | m     |
    | 2     | height z of the torso                                                    | -10  | 10  | m     |
    | 3-6   | orientation of the torso, a quaternion (w, x, y, z)                      | -1   | 1   |       |
    | 7-14  | angles of hip_1, ankle_1, hip_2, ankle_2, hip_3, ankle_3, hip_4, ankle_4 | -pi  | pi  | rad   |
    | 15-17 | velocity of the torso along x, y, z                                      | -100 | 100 | m/s   |
    | 18-20 | angular velocity of the torso about its x, y, z                          | -100 | 100 | rad/s |
    | 21-28 | angular velocities of the joints, in the order of 7-14                   | -100 | 100 | rad/s |

    Nothing in it tells the goal. The contact forces are not in it.

    ## Rewards

    With `d` the distance between the torso's next position on the floor and the goal:

    - `reward_type="sparse"`: `1 - d` if `d < goal_radius`, else `0`.
    - `reward_type="dense"`: `goal_distance - d`, the proxy reward of the oracle baseline. It is 0 where an episode starts, so
      that falling, which ends it, pays nothing. With `-d`, three of five agents learned to fall early.

    Both plus the task-free reward `healthy_reward - ctrl_cost - contact_cost`:

    - `healthy_reward`, for each step that does not terminate the episode;
    - `ctrl_cost`: `ctrl_cost_weight` times the squared length of the clipped action;
    - `contact_cost`: `contact_cost_weight` times the sum of the squared contact forces, each clipped at 1 N. They are the
      normal forces on the four lower legs as the last physics step begins.

    `info["is_success"]` is `d < goal_radius`.

    The paper makes the goal's reward sparse in meta-training and meta-test, and leaves control cost, contact cost and survival
    bonus as they are in MAESN. The weights are those of MAESN's code, where the contact forces are those on all bodies. The
    formula within the radius is our choice: the one that the paper gives for the point robot. A success is thus worth at least
    `1 - goal_radius`, well above any cost of a step. Outside of the radius MAESN pays a number that depends on the goal's
    direction, and so tells it to an ant that never gets there: here it is 0.
    MAESN's dense reward has a constant as well: 4, and the distance is the sum of those along x and y.

    ## Task distribution

    A task is a goal position `(x, y)` at `goal_distance` from the start, at an angle between 0 and pi. The 80 training tasks
    are four fifths of 100 angles, evenly spaced from end to end and shuffled by `task_seed`. The 20 validation and the 100
    test tasks are drawn, uniformly and in balance: one from each of as many equal sectors. `task_space` is a square that
    no ant leaves within 200 steps, because a hindsight task is any position that the ant reached.

    The distance 2, the angles and the 200 steps are MAESN's. The training tasks have the angles of PEARL's point robot, the
    validation and test tasks are our choice. A control step is 0.05 s, as in PEARL's ants: MAESN's 0.01 s leave 2 seconds to
    walk 2 metres. Because random actions lead further then, the radius is 0.4 here, where MAESN has 0.8: our choice.

    A uniformly random policy reaches the goal in 0.06 % of its episodes (of 25,000, by `examples/floor_and_ceiling.py`; with a
    radius of 0.5 about three times as often). It gets 0.80 m away from the start on average, 1.31 m in one episode of 20.
    Open-loop gaits, found by a short random search, walk 2 m in 44 steps and up to 7.9 m in an episode.

    ## Starting State

    The start of gymnasium's ant: at (0, 0), the torso 0.75 m above the floor, all joints at 0. Uniform noise of
    `reset_noise_scale` is added to all positions but x and y (m, rad; the quaternion is normalised), normal noise of that
    standard deviation to all velocities (m/s, rad/s).

    ## Episode End

    ### Termination

    When the ant is unhealthy: its torso's height is outside of [0.2, 1.0], or the state is not finite. Never at the goal.

    ### Truncation

    After 200 steps, which are 10 seconds.

    ## Arguments

    | Parameter             | Default    | Description                                                      |
    |-----------------------|------------|------------------------------------------------------------------|
    | `reward_type`         | `"sparse"` | reward of `step`, `"sparse"` or `"dense"`                        |
    | `render_mode`         | `None`     | `"human"` for a window, `"rgb_array"` for pictures               |
    | `ctrl_cost_weight`    | `0.005`    | weight of the control cost; MAESN's                              |
    | `contact_cost_weight` | `5e-4`     | weight of the contact cost; MAESN's                              |
    | `healthy_reward`      | `0.05`     | reward of a step that ends healthy; MAESN's                      |
    | `reset_noise_scale`   | `0.01`     | noise of the starting state; our choice, gymnasium's ant has 0.1 |
    | `goal_distance`       | `2.0`      | distance of the goals from the start                             |
    | `goal_radius`         | `0.4`      | distance to the goal below which it is reached                   |
    | `n_train_tasks`       | `80`       | number of training tasks                                         |
    | `n_test_tasks`        | `100`      | number of test tasks                                             |
    | `n_validation_tasks`  | `20`       | number of validation tasks                                       |
    | `task_seed`           | `1337`     | seed of the task sets, apart from the run's seed                 |
    | `held_out`            | `None`     | degrees (from, to): no training tasks, all others                |

    `gymnasium.make_vec("SparseAnt-v0", n)` steps n ants in native threads. It takes `n_threads` as well, by default
    `OMP_NUM_THREADS` if that is set, else one for each CPU, with at least 4 ants for each thread.
    `reset(options={"task_id": i})` or `reset(options={"task": [x, y]})` gives the env a task, which stays until it is
    changed.

    ## Version History

    - v0: first version
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # type: ignore[misc]

    def __init__(
        self, reward_type: str = "sparse", render_mode: str | None = None, n_threads: int | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*_ants(1, n_threads, **kwargs), reward_type, render_mode)


class AntVectorEnv(MujocoVectorEnv):
    """Many ants that step together, in native threads; see :class:`AntEnv` for what they do."""

    make = staticmethod(_ants)
