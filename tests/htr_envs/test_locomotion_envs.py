"""SparseWheeled-v0 and SparseAnt-v0: what test_envs.py does not ask of every env."""

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from helpers.robots import ANT, WHEELED, both_envs, make, make_vec, mujoco, random_actions, robots
from htr_envs import LocomotionFamily, Trajectory
from htr_envs.ant import AntEnv, AntVectorEnv
from htr_envs.mujoco_dynamics import FULL_PHYSICS, available_threads
from htr_envs.wheeled import WHEEL_RADIUS, WheeledEnv, WheeledVectorEnv
from sb3_htr.common.random_state import get_generator_state, set_generator_state
from sb3_htr.common.vec_env import make_task_vec_env


def roll(env: Any, actions: Any) -> list[Any]:
    steps = []
    for action in actions:
        steps.append(env.step(action))
        if isinstance(env, gym.Env) and (steps[-1][2] or steps[-1][3]):
            steps.append(env.reset())
    return steps


# ---------------------------------------------------------------- single and batched


@both_envs
def test_a_batch_of_one_is_the_single_env_over_several_episodes(env_id: str) -> None:
    env, _ = make(env_id)
    vector = make_vec(env_id, 1)
    (observation, info), (observations, infos) = env.reset(seed=5), vector.reset(seed=5)
    np.testing.assert_array_equal(observations[0], observation)
    assert infos["task_id"][0] == info["task_id"]
    n_episodes = 0
    for action in random_actions(env, 450):
        observation, reward, terminated, truncated, info = env.step(action)
        observations, rewards, *ends, infos = vector.step(action[None])
        np.testing.assert_array_equal(infos["final_obs"][0], observation)
        assert [rewards[0], *(end[0] for end in ends)] == [reward, terminated, truncated]
        for key in ("task_id", "is_success", "task_free_reward", "achieved_task"):
            np.testing.assert_array_equal(infos[key][0], info[key])
        if terminated or truncated:
            n_episodes += 1
            np.testing.assert_array_equal(env.reset()[0], observations[0])
    assert n_episodes >= 2


def test_a_fork_steps_with_threads_of_its_own() -> None:
    code = f"""
import os, gymnasium, htr_envs
env = gymnasium.make_vec({ANT!r}, 4, n_threads=2)
env.reset(seed=0)
actions = env.action_space.sample()
env.step(actions)
child = os.fork()
states = env.step(actions)[0].tobytes()
if child == 0:
    env.close()
    os._exit(0 if len(states) else 1)
assert os.waitpid(child, 0)[1] == 0
if os.fork() == 0:  # without a step
    env.close()
    os._exit(0)
assert os.wait()[1] == 0
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@both_envs
def test_the_number_of_threads_changes_nothing(env_id: str) -> None:
    episodes = []
    for n_threads in (1, 2, 5):
        vector = make_vec(env_id, 7, n_threads=n_threads, max_episode_steps=30)
        episodes.append((vector.reset(seed=3), roll(vector, random_actions(vector, 70))))
        vector.close()
    assert data_equivalence(episodes[0], episodes[1], exact=True)
    assert data_equivalence(episodes[0], episodes[2], exact=True)


@both_envs
def test_steps_are_mujocos_own(env_id: str) -> None:
    _, base = make(env_id)
    base.reset(seed=0)
    dynamics = robots(base)
    model = dynamics.model
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, dynamics.states[0], FULL_PHYSICS)
    for action in random_actions(base, 100):
        data.ctrl[:] = np.clip(action, -1.0, 1.0)
        mujoco.mj_step(model, data, dynamics.frame_skip)
        info = base.step(action)[4]
        np.testing.assert_array_equal(dynamics.positions(dynamics.states)[0], data.qpos)
        np.testing.assert_array_equal(dynamics.velocities(dynamics.states)[0], data.qvel)
        cost = 0.005 * np.square(np.clip(action, -1.0, 1.0)).sum()
        if env_id == ANT:
            cost += 5e-4 * np.square(np.clip(data.sensordata, -1.0, 1.0)).sum() - 0.05
        assert info["task_free_reward"] == pytest.approx(-cost, abs=1e-6)
    assert data.time == pytest.approx(100 * dynamics.frame_skip * model.opt.timestep)


# ---------------------------------------------------------------- copies, threads, randomness


@both_envs
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_alike_in_the_middle_of_an_episode(env_id: str, duplicate: Any) -> None:
    env, _ = make(env_id)
    vector = make_vec(env_id, 3, n_threads=2, max_episode_steps=20)
    for original in (env, vector):
        original.reset(seed=1)
        roll(original, random_actions(original, 10))
        twin = duplicate(original)
        actions = random_actions(original, 30, seed=1)
        assert data_equivalence(roll(original, actions), roll(twin, actions), exact=True)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="counts threads as Linux lists them")
def test_threads_start_with_the_first_step_and_end_with_close() -> None:
    def count() -> int:
        return len(os.listdir("/proc/self/task"))

    before = count()
    vector = make_vec(WHEELED, 8, n_threads=3)
    vector.reset(seed=0)
    assert count() == before
    vector.step(vector.action_space.sample())
    assert count() == before + 3
    vector.close()
    assert count() == before
    vector.reset()  # and anew
    vector.step(vector.action_space.sample())
    vector.close()
    assert count() == before
    single_threaded = make_vec(WHEELED, 8, n_threads=1)
    single_threaded.reset()
    single_threaded.step(single_threaded.action_space.sample())
    assert count() == before


def test_the_default_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in (("1", 1), ("3", 3), ("2,1", 2)):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        assert available_threads() == expected
        assert robots(make_vec(ANT, 64)).n_threads == expected
        assert robots(make_vec(WHEELED, 16)).n_threads == 1
    for value in ("many", "0", "-1"):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        with pytest.raises(ValueError, match="OMP_NUM_THREADS"):
            make_vec(WHEELED, 2)
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert 1 <= available_threads() <= (os.cpu_count() or 1)


@both_envs
def test_generators_saved_between_rollouts_give_the_same_next_rollout(env_id: str) -> None:
    venv = make_task_vec_env(env_id, 2, seed=4)
    venv.reset()
    generator = venv.get_attr("np_random")[0]
    saved = get_generator_state(generator)
    actions = random_actions(venv.unwrapped.vector_env, 5)  # type: ignore[attr-defined]

    def rollout() -> list[Any]:
        return [venv.reset(), *[venv.step(step_actions)[:3] for step_actions in actions]]

    first = rollout()
    set_generator_state(generator, saved)
    venv.set_attr("np_random", generator)
    assert data_equivalence(first, rollout(), exact=True)


@both_envs
def test_starts_differ_a_little_and_are_at_the_origin(env_id: str) -> None:
    vector = make_vec(env_id, 50)
    starts = vector.reset(seed=0)[0]
    np.testing.assert_array_equal(starts[:, :2], 0.0)
    assert 0.0 < np.ptp(starts[:, 2:], axis=0).min() and np.ptp(starts[:, 2:], axis=0).max() < 0.1
    still = make_vec(env_id, 3, reset_noise_scale=0.0).reset(seed=0)[0]
    np.testing.assert_array_equal(still[0], still[1])
    np.testing.assert_allclose(starts.mean(axis=0), still[0], atol=0.01)


# ---------------------------------------------------------------- rewards and ends


@both_envs
def test_rewards_are_the_formulas_of_the_docstring(env_id: str) -> None:
    _, base = make(env_id)
    family = base.task_family
    assert isinstance(family, LocomotionFamily)
    assert family.goal_radius == {WHEELED: 0.5, ANT: 0.4}[env_id] and family.goal_distance == 2.0
    distances = np.linspace(0.0, 3.0, 50, dtype=np.float32)
    states = np.zeros((50, 5), dtype=np.float32)
    states[:, 1] = 2.0 - distances
    free = np.full(50, -0.01, dtype=np.float32)
    traj = Trajectory(states, states, states, free)
    inside = distances < family.goal_radius
    sparse = family.compute_reward(traj, [0.0, 2.0])
    np.testing.assert_allclose(sparse, np.where(inside, 1.0 - distances, 0.0) - 0.01, atol=1e-6)
    # What a start is worth: an ant that falls there ends its episode, and earns nothing by that
    start = {WHEELED: -2.0, ANT: 0.0}[env_id]
    dense = family.compute_reward(traj, [0.0, 2.0], "dense")
    np.testing.assert_allclose(dense, start + 2.0 - distances - 0.01, atol=1e-6)
    np.testing.assert_array_equal(family.is_success(traj, [0.0, 2.0]), inside)
    assert sparse[inside].min() > 0.4 and (sparse[~inside] == np.float32(-0.01)).all()


def test_the_weights_are_arguments() -> None:
    action = np.array([0.5, -3.0], dtype=np.float32)
    for weight in (0.0, 0.1):
        env = WheeledEnv(ctrl_cost_weight=weight)
        env.reset(seed=0)
        assert env.step(action)[4]["task_free_reward"] == pytest.approx(-1.25 * weight)

    def free_rewards(torque: float, ctrl_cost: float, contact_cost: float, healthy_reward: float) -> Any:
        ant = AntEnv(ctrl_cost_weight=ctrl_cost, contact_cost_weight=contact_cost, healthy_reward=healthy_reward)
        ant.reset(seed=0)
        return np.array([ant.step(np.full(8, torque, np.float32))[4]["task_free_reward"] for _ in range(100)])

    np.testing.assert_allclose(free_rewards(0.5, 0.1, 0.0, 0.0), -0.2, rtol=1e-6)
    np.testing.assert_allclose(free_rewards(0.5, 0.0, 0.0, 0.3), 0.3, rtol=1e-6)
    # in the air at first; in the end it stands on two to four feet, with more than the 1 N at which forces are clipped
    contact_rewards = free_rewards(0.0, 0.0, 1.0, 0.0)
    assert contact_rewards[0] == 0.0 and -4.0 <= contact_rewards[-1] <= -2.0


def test_an_unhealthy_ant_ends_its_episode_without_the_bonus() -> None:
    vector = AntVectorEnv(num_envs=4, contact_cost_weight=0.0)
    vector.reset(seed=0)
    z = robots(vector).positions(robots(vector).states)[:, 2]
    z[:] = [0.7, 1.3, 0.1, 0.75]
    # held there by the model's own speed: the step is short
    _, _, terminated, _, infos = vector.step(np.zeros((4, 8), np.float32))
    heights = infos["final_obs"][:, 2]
    np.testing.assert_array_equal(terminated, (heights < 0.2) | (heights > 1.0))
    assert terminated[1] and not terminated[0] and not terminated[3]
    np.testing.assert_array_equal(infos["task_free_reward"], np.where(terminated, 0.0, np.float32(0.05)))


@both_envs
@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_a_state_that_is_not_finite_ends_the_episode_with_finite_numbers(
    env_id: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log of its warnings
    vector = make_vec(env_id, 3)
    vector.reset(seed=0)
    robots(vector).states[1, 3:] = value
    observations, rewards, terminated, _, infos = vector.step(vector.action_space.sample())
    assert terminated.tolist() == [False, True, False]
    assert infos["final_obs"] in vector.observation_space and observations in vector.observation_space
    assert np.isfinite(rewards).all()
    assert not vector.step(vector.action_space.sample())[2].any()


# ---------------------------------------------------------------- the robots


def test_the_wheeled_robots_observation_is_that_of_the_docstring() -> None:
    vector = WheeledVectorEnv(num_envs=3)
    vector.reset(seed=0)
    before = vector._last_observations
    assert before is not None
    for actions in random_actions(vector, 50):
        after = vector.step(actions)[0]
        cos, sin, forwards, sideways, turn_rate = after.T[2:7].astype(np.float64)
        np.testing.assert_allclose(np.hypot(cos, sin), 1.0, rtol=1e-5)
        # what the robot did within a hundredth of a second
        moved = (after - before)[:, :2] / 0.01
        np.testing.assert_allclose(cos * forwards - sin * sideways, moved[:, 0], atol=0.1)
        np.testing.assert_allclose(sin * forwards + cos * sideways, moved[:, 1], atol=0.1)
        turned = cos * before[:, 3] - sin * before[:, 2]
        np.testing.assert_allclose(turn_rate, -np.arcsin(turned) / 0.01, atol=1.5)
        before = after
    assert WHEEL_RADIUS == robots(vector).model.geom("left_wheel").size[0]


def test_the_wheels_roll_where_the_motors_are_steady() -> None:
    vector = WheeledVectorEnv(num_envs=4)
    vector.reset(seed=0)
    actions = np.array([[1.0, 1.0], [0.3, 0.2], [-0.5, -0.5], [-0.1, 0.1]], np.float32)
    for _ in range(150):
        observations = vector.step(actions)[0].astype(np.float64)
    forwards, sideways, turn_rate, left, right = observations.T[4:]
    # the rims are as fast as the robot is 0.15 m to either side of its middle
    np.testing.assert_allclose(left, forwards - 0.15 * turn_rate, atol=0.03)
    np.testing.assert_allclose(right, forwards + 0.15 * turn_rate, atol=0.03)
    np.testing.assert_allclose(sideways, 0.0, atol=0.1)
    assert 5.0 < forwards[0] < 5.4 and abs(forwards[3]) < 0.01 and turn_rate[3] > 3.0 and turn_rate[1] < -0.5


def drive_to(goals: Any, observations: Any) -> Any:
    """Turn to the goal, drive as fast as the brakes allow, stop."""
    offset = goals - observations[:, :2]
    distance = np.hypot(*offset.T)
    cos, sin, forwards, turn_rate = observations[:, [2, 3, 4, 6]].T
    ahead, aside = cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]
    angle = np.where(distance > 0.1, np.arctan2(aside, ahead), 0.0)
    speed = np.sqrt(14.0 * distance) * np.clip(np.cos(angle), 0.0, 1.0) ** 2
    thrust, turn = np.clip(3.0 * (np.minimum(speed, 3.0 * distance) - forwards), -1, 1), 4.0 * angle - 0.5 * turn_rate
    return np.stack((thrust - turn, thrust + turn), axis=-1).astype(np.float32)


def test_a_simple_controller_drives_to_every_test_goal_and_stays_there() -> None:
    vector = WheeledVectorEnv(num_envs=100)
    goals = vector.task_family.test_tasks
    observations, _ = vector.reset(seed=0, options={"task": goals})
    successes, returns = [], np.zeros(100)
    for _ in range(200):
        observations, rewards, _, _, infos = vector.step(drive_to(goals, observations))
        successes.append(infos["is_success"])
        returns += rewards
    reached = np.argmax(successes, axis=0)
    print(f"first success at steps {reached.min()} to {reached.max()}, returns {returns.min():.1f} to {returns.max():.1f}")
    assert 60 < reached.min() and reached.max() < 110
    assert all(np.array(successes)[step:, i].all() for i, step in enumerate(reached))
    assert np.hypot(*(infos["final_obs"][:, :2] - goals).T).max() < 0.05
    assert returns.min() > 80.0


def test_the_ant_is_gymnasiums_with_a_lower_gear() -> None:
    ant, reference = robots(AntEnv()).model, gym.make("Ant-v5").unwrapped.model  # type: ignore[attr-defined]
    np.testing.assert_array_equal(ant.actuator_gear[:, 0], 30.0)
    np.testing.assert_array_equal(ant.actuator_gear[:, 0] * 5.0, reference.actuator_gear[:, 0])
    bodies = [reference.body(i).name for i in range(reference.nbody)]
    assert bodies == [ant.body(i).name for i in range(reference.nbody)]
    for name in ("body_mass", "body_inertia", "jnt_range", "dof_damping", "dof_armature", "qpos0"):
        np.testing.assert_array_equal(getattr(ant, name)[: len(getattr(reference, name))], getattr(reference, name))
    assert (ant.nq, ant.nv, ant.opt.timestep) == (reference.nq, reference.nv, reference.opt.timestep)


def test_the_feet_of_a_standing_ant_bear_its_weight() -> None:
    env = AntEnv()
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.zeros(8, np.float32))
    weight = 9.81 * robots(env).model.body("torso").subtreemass[0]
    assert robots(env)._sensors[0, -1].sum() == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize(("env_id", "n_episodes", "radius"), [(WHEELED, 2000, 0.225), (ANT, 250, 0.81)])
def test_random_exploration_finds_the_goal_in_at_most_one_episode_of_a_thousand(
    env_id: str, n_episodes: int, radius: float
) -> None:
    vector = make_vec(env_id, n_episodes)
    vector.reset(seed=0)
    vector.action_space.seed(0)
    hit, far = np.zeros(n_episodes, dtype=np.bool_), np.zeros(n_episodes)
    for _ in range(200):
        infos = vector.step(vector.action_space.sample())[4]
        hit |= infos["is_success"]
        far = np.maximum(far, np.hypot(*infos["final_obs"][:, :2].T))
    # the docstring's rate is that of a larger sample; this one must not contradict the promise, and explore as far
    assert hit.sum() <= 0.001 * n_episodes + 1
    assert far.mean() == pytest.approx(radius, rel=0.1)


# ---------------------------------------------------------------- bad input, no MuJoCo


@pytest.mark.parametrize(
    "kwargs",
    [
        {"goal_radius": 1.5},
        {"goal_distance": 30.0},
        *({"reset_noise_scale": value} for value in (-0.1, np.nan, np.inf)),
        *({"ctrl_cost_weight": value} for value in (np.nan, np.inf)),
    ],
)
@both_envs
def test_impossible_arguments_are_refused(env_id: str, kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        gym.make(env_id, **kwargs)
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        make_vec(env_id, 2, **kwargs)


@pytest.mark.parametrize("name", ["contact_cost_weight", "healthy_reward"])
def test_an_ant_pays_finite_numbers(name: str) -> None:
    infinite: dict[str, Any] = {name: np.inf}
    with pytest.raises(ValueError, match=f"{name} is inf, expected a finite number"):
        AntEnv(**infinite)


def test_impossible_threads_and_render_modes_are_refused() -> None:
    with pytest.raises(ValueError, match="n_threads"):
        make_vec(ANT, 2, n_threads=0)
    with pytest.raises(ValueError, match="num_envs"):
        make_vec(ANT, -1)
    with pytest.raises(ValueError, match="render_mode"):
        WheeledEnv(render_mode="ansi")


def test_without_mujoco_only_making_these_envs_fails() -> None:
    code = """
import sys
sys.modules["mujoco"] = None
import gymnasium, htr_envs, pickle
gymnasium.make("SparsePointRobot-v0")
pickle.loads(pickle.dumps(htr_envs.LocomotionFamily()))
for make in (gymnasium.make, gymnasium.make_vec):
    for env_id in ("SparseWheeled-v0", "SparseAnt-v0"):
        try:
            make(env_id)
        except gymnasium.error.DependencyNotInstalled as error:
            print(error)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == ['MuJoCo is missing or too old: run `pip install "sb3_htr[mujoco]"`.'] * 4


@pytest.mark.parametrize("how", ["egl", "nonsense"])
def test_mujoco_that_cannot_draw_as_the_environment_asks_says_so(how: str) -> None:
    """MuJoCo looks for the library when it is imported, and says nothing of the variable."""
    code = """
import ctypes
load = ctypes.CDLL.__init__

def load_others(library, name, *args, **kwargs):
    if "libEGL" in str(name):
        raise OSError("there is no such library")
    load(library, name, *args, **kwargs)

ctypes.CDLL.__init__ = load_others
import gymnasium, htr_envs
try:
    gymnasium.make("SparseWheeled-v0")
except gymnasium.error.DependencyNotInstalled as error:
    print(error)
"""
    environment = {**os.environ, "MUJOCO_GL": how}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert result.stdout.splitlines() == [
        f"MuJoCo cannot draw by what MUJOCO_GL asks for, {how}: install that library, take another of egl, osmesa and glfw, "
        "or unset MUJOCO_GL, which is needed for pictures alone."
    ]
