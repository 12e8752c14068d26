"""The environments of htr_envs: every registered one keeps the contracts, the point robot does what its docstring says."""

import pickle
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.utils.env_checker import data_equivalence
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from htr_envs import PointRobotEnv, PointRobotFamily, PointRobotVectorEnv, TaskEnv, TaskVectorEnv, Trajectory, check_task_env

ENV_IDS = [env_id for env_id, spec in gym.registry.items() if str(spec.entry_point).startswith("htr_envs.")]
POINT_ROBOT = "SparsePointRobot-v0"
NOISY_STARTS = ("SparseWheeled-v0", "SparseAnt-v0")

all_envs = pytest.mark.parametrize("env_id", ENV_IDS)


def make(env_id: str, **kwargs: Any) -> tuple[gym.Env[Any, Any], TaskEnv]:
    env = gym.make(env_id, **kwargs)
    base = env.unwrapped
    assert isinstance(base, TaskEnv)
    return env, base


def make_vec(env_id: str, num_envs: int, **kwargs: Any) -> TaskVectorEnv:
    env = gym.make_vec(env_id, num_envs=num_envs, **kwargs)
    assert isinstance(env, TaskVectorEnv)
    return env


def play(env: gym.Env[Any, Any], seed: int, **reset_kwargs: Any) -> list[tuple[Any, ...]]:
    env.action_space.seed(seed)
    steps: list[tuple[Any, ...]] = [env.reset(seed=seed, **reset_kwargs)]
    while len(steps) == 1 or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(env.action_space.sample()))
    return steps


def trajectory_to(next_observations: Any) -> Trajectory:
    states = np.asarray(next_observations, dtype=np.float32)
    return Trajectory(states, states, states, np.zeros(states.shape[:-1], dtype=np.float32))


# ---------------------------------------------------------------- every registered env


def test_the_point_robot_is_registered() -> None:
    assert POINT_ROBOT in ENV_IDS


@all_envs
def test_gymnasium_check_env_without_a_warning(env_id: str) -> None:
    _, base = make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(base, skip_render_check=True)


class OnlyGym(gym.Env[Any, Any]):
    """Hides ``compute_reward``, a method that makes SB3's checker expect a goal env."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.observation_space, self.action_space = env.observation_space, env.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        return self._env.step(action)


@all_envs
def test_sb3_check_env_without_a_warning(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3_check_env(OnlyGym(gym.make(env_id)))


@all_envs
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_check_task_env(env_id: str, reward_type: str) -> None:
    env, base = make(env_id, reward_type=reward_type)
    check_task_env(env)
    check_task_env(base, n_episodes=1)


@all_envs
def test_two_instances_give_the_same_episode(env_id: str) -> None:
    (first, _), (second, _) = make(env_id), make(env_id)
    assert data_equivalence(play(first, 3), play(second, 3), exact=True)
    assert not data_equivalence(play(first, 3), play(second, 4))


@all_envs
def test_rewards_of_step_are_reproduced_bit_for_bit(env_id: str) -> None:
    env, base = make(env_id)
    goal = play(env, 0)[10][4]["achieved_task"]
    steps = play(env, 0, options={"task": goal})
    observations = np.stack([step[0] for step in steps])
    infos = [step[4] for step in steps[1:]]
    free = np.array([info["task_free_reward"] for info in infos], dtype=np.float32)
    traj = Trajectory(observations[:-1], np.zeros((len(infos), 1), np.float32), observations[1:], free)
    rewards = np.array([step[1] for step in steps[1:]], dtype=np.float32)
    assert base.task_family.is_success(traj, goal).any()
    np.testing.assert_array_equal(base.compute_reward(traj, goal), rewards)
    # as a batch of one-step trajectories, which is how a replay buffer may ask
    one_steps = Trajectory(*(values[:, None] for values in traj))
    np.testing.assert_array_equal(base.compute_reward(one_steps, goal)[:, 0], rewards)


@all_envs
def test_pickled_env_and_family_go_on_alike(env_id: str) -> None:
    env, base = make(env_id)
    env.reset(options={"task_id": 3})
    twin = pickle.loads(pickle.dumps(env))
    assert data_equivalence(play(env, 1, options={"task_id": 3}), play(twin, 1, options={"task_id": 3}), exact=True)
    family = pickle.loads(pickle.dumps(base.task_family))
    for name in ("train_tasks", "validation_tasks", "test_tasks"):
        np.testing.assert_array_equal(getattr(family, name), getattr(base, name))
        with pytest.raises(ValueError, match="read-only"):
            getattr(family, name)[0] = 0.0


@all_envs
def test_task_sets_do_not_follow_the_runs_seed(env_id: str) -> None:
    (first, first_base), (second, second_base) = make(env_id), make(env_id)
    first.reset(seed=1)
    second.reset(seed=2)
    for name in ("train_tasks", "validation_tasks", "test_tasks"):
        np.testing.assert_array_equal(getattr(first_base, name), getattr(second_base, name))


@all_envs
def test_single_and_batched_envs_agree_bit_for_bit(env_id: str) -> None:
    # the copies of a batch draw their noise from one generator, single envs each from their own
    kwargs = {"reset_noise_scale": 0.0} if env_id in NOISY_STARTS else {}
    singles = [make(env_id, **kwargs) for _ in range(4)]
    vector = make_vec(env_id, 4, **kwargs)
    # a task on the way of each robot, so that rewards other than "nothing found" are compared too
    tasks = np.stack([play(env, seed)[8 + seed][4]["achieved_task"] for seed, (env, _) in enumerate(singles)])
    observations, infos = vector.reset(seed=0, options={"task": tasks})
    for (env, _), observation, task in zip(singles, observations, tasks, strict=True):
        np.testing.assert_array_equal(env.reset(options={"task": task})[0], observation)
    for seed, (env, _) in enumerate(singles):
        env.action_space.seed(seed)

    n_successes = 0
    assert vector.max_episode_steps is not None
    for _ in range(2 * vector.max_episode_steps + 3):
        actions = np.stack([env.action_space.sample() for env, _ in singles])
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        n_successes += int(infos["is_success"].sum())
        for i, (env, _) in enumerate(singles):
            observation, reward, *ends, info = env.step(actions[i])
            np.testing.assert_array_equal(infos["final_obs"][i], observation)
            assert rewards[i] == reward and [terminated[i], truncated[i]] == ends
            # rl_zoo3, once it is imported, adds a key to what TimeLimit returns in the whole process
            assert all(np.array_equal(infos[key][i], value) for key, value in info.items() if key != "TimeLimit.truncated")
            assert infos["_final_obs"][i] == any(ends)
            if any(ends):
                observation = env.reset()[0]
            np.testing.assert_array_equal(observations[i], observation)
    assert n_successes > 0


@all_envs
def test_vector_env_follows_gymnasiums_conventions(env_id: str) -> None:
    vector = make_vec(env_id, 3)
    assert vector.metadata["autoreset_mode"] is gym.vector.AutoresetMode.SAME_STEP
    assert vector.observation_space == gym.vector.utils.batch_space(vector.single_observation_space, 3)
    observations, infos = vector.reset(seed=7)
    assert observations in vector.observation_space and infos["task_id"].dtype == np.int64
    again, infos_again = vector.reset(seed=7)
    np.testing.assert_array_equal(observations, again)
    np.testing.assert_array_equal(infos["task_id"], infos_again["task_id"])
    vector.action_space.seed(0)
    observations, rewards, terminated, truncated, infos = vector.step(vector.action_space.sample())
    assert observations in vector.observation_space and rewards.dtype == np.float32
    assert terminated.dtype == truncated.dtype == infos["is_success"].dtype == np.bool_
    assert infos["achieved_task"].shape == (3, *vector.task_family.task_space.shape)
    assert infos["task_free_reward"].shape == (3,)
    kept = observations.copy()
    vector.step(vector.action_space.sample())
    np.testing.assert_array_equal(observations, kept)


# ---------------------------------------------------------------- the rules on tasks


@all_envs
def test_a_given_task_stays_until_it_is_changed(env_id: str) -> None:
    env, base = make(env_id)
    base.set_task(5)
    assert [env.reset(seed=seed)[1]["task_id"] for seed in (0, 1, None)] == [5, 5, 5]
    env.reset(options={"task": base.test_tasks[2]})
    for _ in range(2):
        assert env.reset()[1]["task_id"] == -1
        np.testing.assert_array_equal(base.task, base.test_tasks[2])
    base.set_task(None)
    assert len({env.reset()[1]["task_id"] for _ in range(50)} - {-1}) > 5


@all_envs
def test_set_task_waits_for_the_next_reset(env_id: str) -> None:
    env, base = make(env_id)
    env.reset(options={"task_id": 1})
    base.set_task(2)
    assert env.step(env.action_space.sample())[4]["task_id"] == 1
    assert env.reset()[1]["task_id"] == 2


@all_envs
def test_the_start_does_not_depend_on_how_the_task_was_chosen(env_id: str) -> None:
    (drawing, _), (given_one, _) = make(env_id), make(env_id)
    given_one.reset(options={"task_id": 0})
    for seed in (0, None, None):
        np.testing.assert_array_equal(drawing.reset(seed=seed)[0], given_one.reset(seed=seed)[0])
    assert drawing.np_random.random() == given_one.np_random.random()


@all_envs
def test_the_env_keeps_no_hold_of_a_given_vector(env_id: str) -> None:
    env, base = make(env_id)
    vector = base.test_tasks[0].copy()
    base.set_task(vector)
    vector[:] = 0.0
    env.reset()
    base.task[:] = 0.0
    np.testing.assert_array_equal(base.task, base.test_tasks[0])


@all_envs
def test_each_env_of_a_batch_has_its_own_given_task(env_id: str) -> None:
    vector = make_vec(env_id, 40)
    vector.set_task([3, 4], indices=[1, 2])
    mask = np.arange(40) == 39
    vector.set_task(vector.task_family.test_tasks[:1], indices=mask)
    drawn = []
    for _ in range(3):
        task_ids = vector.reset()[1]["task_id"]
        assert task_ids[[1, 2, 39]].tolist() == [3, 4, -1]
        np.testing.assert_array_equal(vector.tasks[39], vector.task_family.test_tasks[0])
        np.testing.assert_array_equal(vector.tasks[:39], vector.task_family.train_tasks[task_ids[:39]])
        drawn.append(task_ids[3:39].tolist())
    assert drawn[0] != drawn[1] != drawn[2]
    vector.set_task(None, indices=[1])
    assert len({int(vector.reset()[1]["task_id"][1]) for _ in range(30)}) > 1
    assert vector.task_ids[2] == 4
    vector.set_task(None)
    assert -1 not in vector.reset()[1]["task_id"]


@all_envs
def test_a_step_reports_the_task_of_the_episode_that_it_ends(env_id: str) -> None:
    vector = make_vec(env_id, 2, max_episode_steps=3)
    vector.reset(options={"task_id": [6, 7]})
    vector.set_task([8], indices=[0])
    for step in range(3):
        assert vector.task_ids.tolist() == [6, 7]
        infos = vector.step(vector.action_space.sample())[4]
        assert infos["task_id"].tolist() == [6, 7]
        assert infos["_final_obs"].tolist() == [step == 2] * 2
    assert vector.task_ids.tolist() == [8, 7]
    assert vector.step(vector.action_space.sample())[4]["task_id"].tolist() == [8, 7]


BAD_OPTIONS = [
    ({"task_id": 10_000}, "out of range"),
    ({"task_id": -1}, "out of range"),
    ({"task_id": 1.5}, "no integer"),
    ({"task_id": True}, "no integer"),
    ({"task_id": None}, "no integer"),
    ({"task_id": [1, 2]}, "shape"),
    ({"task": [0.0, 0.0, 0.0]}, "shape"),
    ({"task": "north"}, "not made of numbers"),
    ({"goal": [0.0, 1.0]}, "Unknown reset options"),
    ({"task_id": 0, "task": [0.0, 1.0]}, "only one"),
]


@all_envs
@pytest.mark.parametrize(("options", "sentence"), BAD_OPTIONS)
def test_bad_options_are_refused_and_change_nothing(env_id: str, options: dict[str, Any], sentence: str) -> None:
    env, base = make(env_id)
    base.set_task(4)
    with pytest.raises(ValueError, match=sentence):
        env.reset(options=options)
    assert env.reset()[1]["task_id"] == 4


@all_envs
@pytest.mark.parametrize("value", [np.nan, 1e6])
def test_a_vector_outside_the_task_space_is_refused_and_changes_nothing(env_id: str, value: float) -> None:
    env, base = make(env_id)
    base.set_task(4)
    task = base.train_tasks[0].copy()
    task[-1] = value
    with pytest.raises(ValueError, match="not in"):
        env.reset(options={"task": task})
    vector = make_vec(env_id, 2)
    vector.set_task([4, 5])
    with pytest.raises(ValueError, match="not in"):
        vector.reset(options={"task": np.stack([base.train_tasks[0], task])})
    assert env.reset()[1]["task_id"] == 4
    assert vector.reset()[1]["task_id"].tolist() == [4, 5]


@all_envs
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"task_id": 3}, "shape"),
        ({"task_id": [0, 1, 2]}, "shape"),
        ({"task_id": [0, 10_000]}, "out of range"),
        ({"task": [[0.0, 1.0]]}, "shape"),
        ({"goal": 0}, "Unknown reset options"),
    ],
)
def test_bad_options_of_a_batch_are_refused_and_change_nothing(env_id: str, options: dict[str, Any], sentence: str) -> None:
    vector = make_vec(env_id, 2)
    vector.set_task([4, 5])
    with pytest.raises(ValueError, match=sentence):
        vector.reset(options=options)
    assert vector.reset()[1]["task_id"].tolist() == [4, 5]


@all_envs
def test_wrong_use_is_refused(env_id: str) -> None:
    _, base = make(env_id)
    vector = make_vec(env_id, 2)
    calls: list[tuple[Any, Any]] = [(base.step, base.action_space.sample()), (vector.step, vector.action_space.sample())]
    for early_step, action in calls:
        with pytest.raises(ResetNeeded):
            early_step(action)
    with pytest.raises(ResetNeeded):
        _ = base.task
    base.reset()
    vector.reset()
    with pytest.raises(ValueError, match="shape"):
        base.step(calls[1][1])
    with pytest.raises(ValueError, match="shape"):
        vector.step(calls[0][1])
    for build in (lambda: gym.make(env_id, reward_type="shaped"), lambda: make_vec(env_id, 2, reward_type="shaped")):
        with pytest.raises(ValueError, match="reward_type"):
            build()
    with pytest.raises(ValueError, match="num_envs"):
        make_vec(env_id, 0)


# ---------------------------------------------------------------- the point robot

coordinates = st.floats(-10.0, 10.0, width=32)
points = arrays(np.float32, 2, elements=coordinates)


@given(state=points, goal=points, near=st.booleans(), free=st.floats(-1.0, 1.0, width=32))
def test_reward_is_the_formula_of_the_docstring(state: Any, goal: Any, near: bool, free: float) -> None:
    if near:
        goal = state + goal / 50.0
    family = PointRobotFamily()
    traj = trajectory_to(state[None])._replace(task_free_reward=np.array([free], dtype=np.float32))
    distance = float(np.linalg.norm(state.astype(np.float64) - goal))
    assume(abs(distance - 0.2) > 1e-5)
    reached = distance < 0.2
    expected = (1.0 - distance if reached else 0.0) + free
    assert family.compute_reward(traj, goal)[0] == pytest.approx(expected, abs=1e-5)
    assert family.compute_reward(traj, goal, "dense")[0] == pytest.approx(-distance + free, abs=1e-5)
    assert family.is_success(traj, goal)[0] == reached


@given(
    states=arrays(np.float32, (3, 5, 2), elements=coordinates),
    indices=st.lists(st.integers(0, 4), min_size=3, max_size=3),
)
def test_a_hindsight_task_is_solved_by_its_own_state(states: Any, indices: list[int]) -> None:
    family = PointRobotFamily()
    traj = trajectory_to(states)
    tasks = family.hindsight_task(traj, indices)
    np.testing.assert_array_equal(tasks, states[np.arange(3), indices])
    np.testing.assert_array_equal(family.compute_reward(traj, tasks)[np.arange(3), indices], 1.0)


def test_the_split_is_that_of_pearls_reference() -> None:
    # what the reference does: goals at even angles, then one legacy shuffle of the rows with seed 1337
    angles = np.linspace(0.0, np.pi, 100)
    goals = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    np.random.RandomState(1337).shuffle(goals)
    family = PointRobotFamily()
    np.testing.assert_array_equal(family.train_tasks, goals[:80].astype(np.float32))
    np.testing.assert_array_equal(family.test_tasks, goals[-20:].astype(np.float32))


@given(
    distance=st.floats(0.1, 10.0),
    counts=st.tuples(*[st.integers(1, 40)] * 3),
    task_seed=st.integers(0, 2**32 - 1),
)
def test_tasks_lie_on_the_semicircle_in_the_numbers_asked_for(
    distance: float, counts: tuple[int, int, int], task_seed: int
) -> None:
    n_train, n_test, n_validation = counts
    family = PointRobotFamily(distance, 0.2, n_train, n_test, n_validation, task_seed)
    sets = (family.train_tasks, family.test_tasks, family.validation_tasks, family.sample_tasks(7, np.random.default_rng(0)))
    assert [len(tasks) for tasks in sets] == [n_train, n_test, n_validation, 7]
    tasks = np.concatenate(sets)
    np.testing.assert_allclose(np.linalg.norm(tasks, axis=-1), distance, rtol=1e-5)
    assert (tasks[:, 1] >= -1e-6).all()
    # even angles: the train and test tasks fill the semicircle from end to end
    grid = np.sort(np.arctan2(np.abs(np.concatenate(sets[:2])[:, 1]), np.concatenate(sets[:2])[:, 0]))
    np.testing.assert_allclose(grid, np.linspace(0.0, np.pi, n_train + n_test), atol=1e-5)
    assert not np.array_equal(PointRobotFamily(distance, task_seed=1).train_tasks, PointRobotFamily(distance).train_tasks)


def test_dynamics_are_clipped_steps_that_stay_in_the_arena() -> None:
    env = PointRobotEnv()
    observation, _ = env.reset()
    np.testing.assert_array_equal(observation, 0.0)
    observation = env.step(np.array([0.5, -3.0], dtype=np.float32))[0]
    np.testing.assert_allclose(observation, [0.05, -0.1], rtol=1e-6)
    for _ in range(110):
        observation = env.step(np.ones(2, dtype=np.float32))[0]
        assert observation in env.observation_space
    np.testing.assert_array_equal(observation, 10.0)


def test_an_episode_is_twenty_steps_also_at_the_goal() -> None:
    env, _ = make(POINT_ROBOT)
    env.reset(options={"task": [0.0, 0.0]})
    ends = [env.step(np.zeros(2, dtype=np.float32)) for _ in range(20)]
    assert [end[3] for end in ends] == [False] * 19 + [True]
    assert all(end[1] == 1.0 and end[4]["is_success"] and not end[2] for end in ends)


def test_every_task_is_solvable_and_pays_what_was_computed_elsewhere() -> None:
    family = PointRobotFamily()
    tasks = np.concatenate((family.train_tasks, family.test_tasks))
    vector = PointRobotVectorEnv(num_envs=100)
    observations, _ = vector.reset(options={"task": tasks})
    returns = np.zeros(100)
    for step in range(20):
        observations, rewards, _, _, infos = vector.step(10.0 * (tasks - observations))
        returns += rewards
        assert step < 19 or infos["is_success"].all()
    # 13.38 [11.90, 14.84] was computed by an independent script as the best return with the goal known
    assert returns.mean() == pytest.approx(13.38, abs=0.05)
    assert returns.max() == pytest.approx(14.84, abs=0.05)
    # not 11.90: at the goals (1, 0) and (-1, 0) the 8th step ends at 0.2 exactly, and in float32 just inside
    assert returns.min() >= 11.90


def test_random_exploration_finds_the_goal_in_at_most_one_episode_of_a_thousand() -> None:
    vector = make_vec(POINT_ROBOT, 50_000)
    vector.reset(seed=0)
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(4):
        reached = np.zeros(50_000, dtype=np.bool_)
        for _ in range(20):
            infos = vector.step(rng.uniform(-1.0, 1.0, (50_000, 2)).astype(np.float32))[4]
            reached |= infos["is_success"]
        hits += int(reached.sum())
    # the docstring states 0.05 %; four standard deviations of 200,000 episodes around it
    assert hits / 200_000 <= 0.001
    assert hits / 200_000 == pytest.approx(0.0005, abs=0.0002)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"goal_distance": 0.0},
        {"goal_distance": 10.5},
        {"goal_distance": float("nan")},
        {"goal_radius": 0.0},
        {"goal_radius": 1.5},
        {"n_train_tasks": 0},
        {"n_test_tasks": 0},
        {"n_validation_tasks": 0},
    ],
)
def test_impossible_arguments_are_refused(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        gym.make(POINT_ROBOT, **kwargs)


# ---------------------------------------------------------------- pictures


def frame_at(env: PointRobotEnv, point: Any) -> Any:
    """Colour at a point of the plane; the picture shows -2.2 to 2.2 at the default distance."""
    frame = env.render()
    assert frame is not None and frame.shape == (400, 400, 3) and frame.dtype == np.uint8
    column, row = (np.array([point[0], -point[1]]) + 2.2) / 4.4 * 400
    return frame[int(row), int(column)].tolist()


def test_gymnasium_checks_the_rendering_without_a_warning() -> None:
    _, base = make(POINT_ROBOT, render_mode="rgb_array", disable_env_checker=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(base)


def test_the_picture_shows_goal_robot_and_success() -> None:
    env = PointRobotEnv(render_mode="rgb_array")
    env.reset(options={"task": [0.0, 1.0]})
    white, faint_goal = [255, 255, 255], frame_at(env, (0.1, 1.05))
    assert faint_goal != white
    assert frame_at(env, (0.55, 1.0)) == white
    robot = frame_at(env, (0.0, 0.0))
    for _ in range(9):
        env.step(np.array([0.0, 1.0], dtype=np.float32))
    assert frame_at(env, (0.0, 0.9)) == robot
    assert frame_at(env, (0.0, 0.5)) == robot, "the path is drawn in the robot's colour"
    full_goal = frame_at(env, (0.1, 1.05))
    assert full_goal not in (white, faint_goal, robot)
    env.reset(options={"task": [-1.0, 0.0]})
    assert frame_at(env, (0.1, 1.05)) == white


@pytest.mark.parametrize("goal_distance", [0.3, 1.0, 2.0, 3.5, 4.2, 4.4, 5.0, 7.0, 9.9, 10.0])
def test_pictures_of_any_goal_distance(goal_distance: float) -> None:
    env = PointRobotEnv(render_mode="rgb_array", goal_distance=goal_distance)
    env.reset(options={"task": [9.0, -9.0]})
    for _ in range(100):
        env.step(np.ones(2, dtype=np.float32))
    frame = env.render()
    assert frame is not None and len(np.unique(frame.reshape(-1, 3), axis=0)) > 5


def test_no_picture_without_a_render_mode() -> None:
    env = PointRobotEnv()
    env.reset()
    assert env.render() is None
    with pytest.raises(ValueError, match="render_mode"):
        PointRobotEnv(render_mode="human")


def test_htr_envs_needs_neither_sb3_nor_torch() -> None:
    code = "import sys, htr_envs; print([m for m in ('sb3_htr', 'stable_baselines3', 'torch') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
