"""The environments of htr_envs: every registered one keeps the contracts."""

import pickle
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from helpers.broken_envs import LineEnv, LineFamily
from helpers.envs import make, make_vec
from htr_envs import Dynamics, DynamicsEnv, DynamicsVectorEnv, Trajectory, check_task_env

# those of other packages have tests of their own
ENV_IDS = [env_id for env_id, spec in gym.registry.items() if str(spec.vector_entry_point).startswith("htr_envs.")]
POINT_ROBOT = "SparsePointRobot-v0"
NOISY_STARTS = ("SparseWheeled-v0", "SparseAnt-v0")

all_envs = pytest.mark.parametrize("env_id", ENV_IDS)


def play(env: gym.Env[Any, Any], seed: int, **reset_kwargs: Any) -> list[tuple[Any, ...]]:
    env.action_space.seed(seed)
    steps: list[tuple[Any, ...]] = [env.reset(seed=seed, **reset_kwargs)]
    while len(steps) == 1 or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(env.action_space.sample()))
    return steps


# ---------------------------------------------------------------- every registered env


def test_all_families_are_registered_with_a_batched_env() -> None:
    assert set(ENV_IDS) == {POINT_ROBOT, "SparseTargetSpeed-v0", "SparseWheeled-v0", "SparseAnt-v0"}


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
    with pytest.raises(AssertionError, match="The env has no time limit"):
        check_task_env(base)


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


def test_an_env_hands_arrays_to_its_family() -> None:
    env, states = LineEnv(), np.array([[0.0], [1.0]], dtype=np.float32)
    traj = Trajectory(states, states, states, np.zeros(2, dtype=np.float32))
    assert env.compute_reward(traj, [1.0]).tolist() == [0.0, 1.0]
    assert env.hindsight_task(traj, 1).tolist() == [1.0]


@all_envs
def test_pickled_env_and_family_go_on_alike(env_id: str) -> None:
    env, base = make(env_id)
    env.reset(options={"task_id": 3})
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:3]:
        env.step(action)
    twin = pickle.loads(pickle.dumps(env))
    for action in actions[3:]:
        assert data_equivalence(env.step(action), twin.step(action), exact=True)
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


# ---------------------------------------------------------------- dynamics of one's own


class Walkers(Dynamics[LineFamily]):
    """Walk on a line, pay for the effort, in float64, and end beyond 2."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, spaces.Box(-5.0, 5.0, (1,), np.float32), spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.states = np.zeros((num_envs, 1), dtype=np.float32)

    def reset(self, indices: Any, rng: np.random.Generator) -> Any:
        self.states[indices] = rng.uniform(-0.1, 0.1, (len(indices), 1))
        return self.states[indices]

    def step(self, actions: Any) -> Any:
        effort = np.clip(actions, -1.0, 1.0)
        self.states = np.clip(self.states + np.float32(0.2) * effort, -5.0, 5.0)
        return self.states, -0.01 * effort[:, 0].astype(np.float64) ** 2, self.states[:, 0] > 2.0


def test_dynamics_written_once_are_a_single_and_a_batched_env() -> None:
    single, vector = DynamicsEnv(LineFamily(), Walkers(1)), DynamicsVectorEnv(LineFamily(), Walkers(1))
    check_task_env(gym.wrappers.TimeLimit(single, 30))
    gymnasium_check_env(single, skip_render_check=True)
    observation, _ = single.reset(seed=1)
    np.testing.assert_array_equal(vector.reset(seed=1)[0], [observation])
    n_episodes = 0
    for action in np.random.default_rng(0).uniform(-0.5, 1.2, (200, 1)).astype(np.float32):
        observation, reward, terminated, _, info = single.step(action)
        observations, rewards, _, _, infos = vector.step(action[None])
        assert (rewards[0], infos["task_id"][0]) == (reward, info["task_id"])
        if terminated:
            n_episodes += 1
            observation, _ = single.reset()
        np.testing.assert_array_equal(observations, [observation])
    assert n_episodes >= 5
    for env in (single, vector):
        env.close()


class Writing(Walkers):
    """Writes into the actions that it is given."""

    def step(self, actions: Any) -> Any:
        actions *= 0.1
        return super().step(actions)


class PaysForEffort(LineFamily):
    """In each step, so that it is seen."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return traj.actions[..., 0].copy()


def test_rewards_are_of_what_the_agent_did_whatever_dynamics_make_of_it() -> None:
    """Which is what a replay buffer has."""
    single, vector = DynamicsEnv(PaysForEffort(), Writing(1)), DynamicsVectorEnv(PaysForEffort(), Writing(3))
    single.reset(seed=0)
    vector.reset(seed=0)
    assert single.step(np.array([0.5], dtype=np.float32))[1] == 0.5
    assert vector.step(np.full((3, 1), 0.5, dtype=np.float32))[1].tolist() == [0.5, 0.5, 0.5]


def test_dynamics_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="num_envs is 0"):
        Walkers(0)
    with pytest.raises(ValueError, match="needs dynamics of one"):
        DynamicsEnv(LineFamily(), Walkers(2))
    with pytest.raises(ValueError, match="render_mode is 'rgb_array'"):
        DynamicsEnv(LineFamily(), Walkers(1), render_mode="rgb_array")


def test_threads_make_no_difference_to_a_single_env() -> None:
    """Agents that were trained on a batch are watched, exported and adapted in one."""
    for env_id in NOISY_STARTS:
        steps = []
        for n_threads in (None, 2):
            env = gym.make(env_id, n_threads=n_threads)
            env.reset(seed=0)
            steps.append(env.step(np.full(env.action_space.shape or (), 0.5, dtype=np.float32))[0])
        np.testing.assert_array_equal(*steps)
        with pytest.raises(ValueError, match="n_threads is 0"):
            gym.make(env_id, n_threads=0)


@pytest.mark.parametrize(
    ("env_id", "argument"),
    [
        ("SparsePointRobot-v0", "goal_distance"),
        ("SparsePointRobot-v0", "goal_radius"),
        ("SparseTargetSpeed-v0", "min_speed"),
        ("SparseTargetSpeed-v0", "max_speed"),
        ("SparseTargetSpeed-v0", "tolerance"),
        ("SparseWheeled-v0", "reset_noise_scale"),
        ("SparseWheeled-v0", "n_threads"),
    ],
)
def test_an_argument_that_is_no_number_is_named(env_id: str, argument: str) -> None:
    for value in ("1,5", True):
        with pytest.raises(ValueError, match=rf"{argument}.* {value!r}"):
            gym.make(env_id, **{argument: value})  # type: ignore[arg-type]


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


BAD_OPTIONS_OF_A_BATCH: list[tuple[dict[str, Any], str]] = [
    ({"task_id": 3}, "shape"),
    ({"task_id": [0, 1, 2]}, "shape"),
    ({"task_id": [0, 10_000]}, "out of range"),
    ({"task": [[0.0, 1.0]]}, "shape"),
    ({"goal": 0}, "Unknown reset options"),
]


@all_envs
def test_bad_options_are_refused_and_change_nothing(env_id: str) -> None:
    env, base = make(env_id)
    vector = make_vec(env_id, 2)
    outside = [base.train_tasks[0].copy() for _ in range(2)]
    outside[0][-1], outside[1][-1] = np.nan, 1e6
    of_env = [*BAD_OPTIONS, *(({"task": task}, "not in") for task in outside)]
    of_batch = [*BAD_OPTIONS_OF_A_BATCH, *(({"task": [base.train_tasks[0], task]}, "not in") for task in outside)]
    cases: list[tuple[Any, Any, Any]] = [(env, 4, of_env), (vector, [4, 5], of_batch)]
    for refusing, task_ids, bad in cases:
        refusing.unwrapped.set_task(task_ids)
        for options, sentence in bad:
            before = refusing.unwrapped.np_random.bit_generator.state
            with pytest.raises(ValueError, match=sentence):
                refusing.reset(seed=7, options=options)
            assert refusing.unwrapped.np_random.bit_generator.state == before, options
            np.testing.assert_array_equal(refusing.reset()[1]["task_id"], task_ids, err_msg=str(options))
        with pytest.raises(gym.error.Error, match="Seed must be"):
            refusing.reset(seed=-1, options={"task_id": np.ones_like(task_ids)})
        np.testing.assert_array_equal(refusing.reset()[1]["task_id"], task_ids)


@pytest.mark.parametrize(
    ("tasks", "indices", "sentence"),
    [
        ([1, 2], [0, 7], r"indices are \[0, 7\]: pass whole numbers below 3, or a mask of 3 bools"),
        ([1, 2], [0.0, 1.0], r"indices are \[0.0, 1.0\]: pass whole numbers"),
        ([1], [True, False], "or a mask of 3 bools"),
        (None, [[0], [1, 2]], "pass whole numbers"),
        ([0.0, 1.0], [0], r"The tasks \[0.0, 1.0\] are no whole numbers, as ids are: vectors need the shape \(1, 2\)"),
        ([1], [], r"shape \(1,\), expected \(0,\)"),
    ],
)
def test_tasks_for_envs_that_are_none_are_refused(tasks: Any, indices: Any, sentence: str) -> None:
    vector = make_vec(POINT_ROBOT, 3)
    vector.set_task([4, 5, 6])
    with pytest.raises(ValueError, match=sentence):
        vector.set_task(tasks, indices)
    nothing: Any
    for nothing in (None, 3, [], np.zeros((0, 2))):
        vector.set_task(nothing, [])
    assert vector.reset()[1]["task_id"].tolist() == [4, 5, 6]


@all_envs
def test_tasks_of_other_spaces_have_no_rewards(env_id: str) -> None:
    env, base = make(env_id)
    observation = env.reset()[0][None]
    traj = Trajectory(observation, observation, observation, np.zeros(1, dtype=np.float32))
    task = base.train_tasks[0]
    for other in (task[:-1], np.append(task, task), 0.5):
        with pytest.raises(ValueError, match=rf"The task has shape .*, expected \(..., {len(task)}\)"):
            base.compute_reward(traj, other)


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
    for step, action in calls:
        action[..., -1] = np.nan
        with pytest.raises(ValueError, match=r"nan.*expected finite numbers"):
            step(action)
    bad: Any
    for bad in ([[0.0], [0.0, 1.0]], "north", {"left": 1.0}):
        for early_step, _ in calls:
            with pytest.raises(ValueError, match=r"^The action is .*, expected numbers of shape"):
                early_step(bad)
    with pytest.raises(ValueError, match="A batch draws no pictures: make a single env for render_mode='rgb_array'"):
        make_vec(env_id, 2, render_mode="rgb_array")
    for build in (lambda: gym.make(env_id, reward_type="shaped"), lambda: make_vec(env_id, 2, reward_type="shaped")):
        with pytest.raises(ValueError, match="reward_type"):
            build()
    with pytest.raises(ValueError, match="num_envs"):
        make_vec(env_id, 0)


def test_htr_envs_needs_neither_sb3_nor_torch() -> None:
    code = "import sys, htr_envs; print([m for m in ('sb3_htr', 'stable_baselines3', 'torch') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
