"""Envs, and task families, that cannot be trained on are refused in one sentence, and unusual ones that can be are taken."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, RescaleObservation, TransformObservation
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from helpers import ENV_ID, ROLLOUT, MakePEARL
from helpers.broken_envs import LineEnv
from helpers.envs import Robot
from htr_envs import PointRobotEnv, PointRobotVectorEnv
from sb3_htr import evaluate_adaptation
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env


class WithoutTaskId(gym.Wrapper[Any, Any, Any, Any]):
    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {}


class WithSpaces(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any], **changed: spaces.Space[Any]) -> None:
        super().__init__(env)
        for name, space in changed.items():
            setattr(self, name, space)


class WithoutHook(gym.Wrapper[Any, Any, Any, Any]):
    class Family:
        train_tasks = np.zeros((3, 2))

    task_family = Family()


@pytest.mark.parametrize(
    ("make_env", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), "The env has no task_family, so there are no tasks to meta-train on"),
        (lambda: WithoutHook(gym.make(ENV_ID)), "task_family has no compute_reward"),
        (lambda: WithoutTaskId(gym.make(ENV_ID)), r"reset returns no info\['task_id'\]"),
        (
            lambda: WithSpaces(gym.make(ENV_ID), observation_space=spaces.Dict({"x": spaces.Box(0, 1, (2,))})),
            "The observation space is Dict.*, expected a Box of one axis",
        ),
        (
            lambda: WithSpaces(gym.make(ENV_ID), action_space=spaces.Discrete(3)),
            "The action space is Discrete.*no discrete actions",
        ),
        (lambda: gym.make(ENV_ID, reward_type="dense"), "reward_type is not 'sparse'.*rl_reward_type"),
        (lambda: PointRobotEnv(), "The env has no time limit"),
        (lambda: BatchedTaskVecEnv(PointRobotVectorEnv(2, max_episode_steps=None)), "The env has no time limit"),
        (
            lambda: gym.make_vec(ENV_ID, 2),
            "is a gymnasium VectorEnv, expected one of Stable-Baselines3: pass the env's id",
        ),
        (
            lambda: VecNormalize(make_task_vec_env(ENV_ID, 2)),
            "VecNormalize stands between .*policies normalize observations themselves",
        ),
        (lambda: DummyVecEnv([lambda: gym.make("Pendulum-v1")]), "no task_family"),
    ],
)
def test_envs(tiny_pearl: MakePEARL, make_env: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_pearl(make_env()).learn(1)


def test_an_unknown_id_is_gymnasiums_business(tiny_pearl: MakePEARL) -> None:
    with pytest.raises(gym.error.NameNotFound, match=r"Did you mean: `SparsePointRobot`\?.*Import the package"):
        tiny_pearl("SparsePointRobo-v0")


@pytest.mark.parametrize("tasks", [[[0.0, 1.0]], np.zeros((0, 2)), np.zeros(3)])
def test_training_tasks_that_are_no_array_of_tasks(tasks: Any, tiny_pearl: MakePEARL) -> None:
    class Family(WithoutHook.Family):
        train_tasks = tasks

    env = WithoutHook(gym.make(ENV_ID))
    env.task_family = Family()
    with pytest.raises(ValueError, match=r"train_tasks are .*, expected an array \(n_tasks, task_dim\)"):
        tiny_pearl(env, n_tasks_per_rollout=1)


def test_envs_of_several_families_are_refused(tiny_pearl: MakePEARL) -> None:
    """All experience would be relabelled by the rewards of the first one."""
    env = DummyVecEnv([partial(gym.make, ENV_ID, goal_radius=radius) for radius in (0.2, 0.2, 0.3)])
    with pytest.raises(ValueError, match=r"Env 2 .* has another task family: its goal_radius is 0.3, that of the first one"):
        tiny_pearl(env)
    with pytest.raises(ValueError, match="another task family"):
        evaluate_adaptation(tiny_pearl(), env, n_episodes=1)


def test_whole_numbers_are_no_actions(tiny_pearl: MakePEARL) -> None:
    whole = spaces.Box(-1, 1, (2,), np.int64)
    with pytest.raises(ValueError, match="has whole numbers, but actions are floats"):
        tiny_pearl(WithSpaces(gym.make(ENV_ID), action_space=whole), n_tasks_per_rollout=1)
    robot = Robot(20)
    robot.action_space = whole
    with pytest.raises(ValueError, match="has whole numbers, but actions are floats"):
        tiny_pearl().adapt(robot)


class Changed(gym.Wrapper[Any, Any, Any, Any]):
    """An env with one thing wrong in its steps."""

    def __init__(self, env: gym.Env[Any, Any], change: Callable[[int, list[Any]], None]) -> None:
        super().__init__(env)
        self.change = change
        self.n_steps = 0

    def step(self, action: Any) -> Any:
        values = list(self.env.step(action))
        self.n_steps += 1
        self.change(self.n_steps, values)
        return tuple(values)


def put(position: int, value: Any) -> Callable[[int, list[Any]], None]:
    def change(n_steps: int, values: list[Any]) -> None:
        values[position] = value

    return change


def another_task(n_steps: int, values: list[Any]) -> None:
    values[4] = {**values[4], "task_id": n_steps % 7}


def failing(n_steps: int, values: list[Any]) -> None:
    np.zeros(3) + np.zeros(2)


def no_training_task(n_steps: int, values: list[Any]) -> None:
    values[4] = {**values[4], "task_id": -1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(1, float("nan")), r"The reward of task .* is nan, expected finite numbers"),
        (put(1, float("inf")), r"The reward of task .* is inf, expected finite numbers"),
        (put(0, np.full(2, np.nan, dtype=np.float32)), r"The next_observation of task .* is \[nan nan\], expected finite"),
        (put(1, 0.5), r"The env gave 0.5 for a step of task \d+, but its compute_reward gives 0: .*check_task_env"),
        (put(0, np.zeros(3, dtype=np.float32)), r"^At env step \d+, on one of .* tasks \[\d+\]: .*the shape of"),
        (failing, r"^At env step \d+, on one .*: operands could not be broadcast"),
        (put(3, False), r"An episode is longer than the env's time limit of 20 steps"),
        (another_task, r"The task of env 0 changed from \d to \d within an episode"),
        (no_training_task, r"info\['task_id'\] is -1, expected a training task"),
    ],
)
def test_envs_that_do_something_wrong(tiny_pearl: MakePEARL, change: Callable[[int, list[Any]], None], message: str) -> None:
    # outside of gymnasium's own checker, which would be the first to see some of it
    env = gym.make(ENV_ID, disable_env_checker=True)
    with pytest.raises(ValueError, match=message):
        tiny_pearl(Changed(env, change), n_tasks_per_rollout=1).learn(1)


def test_episodes_of_one_step_are_episodes(tiny_pearl: MakePEARL) -> None:
    env = Changed(gym.make(ENV_ID), put(2, True))
    model = tiny_pearl(env, n_tasks_per_rollout=1, n_episodes_per_task=50).learn(200)
    assert model.replay_buffer is not None and model.replay_buffer.n_episodes.sum() == 200


@pytest.mark.parametrize("end", [{"speed": 0.1}, -0.01, float("nan"), "False", None, np.array([False])])
def test_an_end_of_an_episode_that_is_no_truth_value_is_named(end: Any) -> None:
    """gymnasium's own order has an info in its place, which is true: each episode would have one step."""

    class InfoInItsPlace(LineEnv):
        def _step_state(self, action: Any) -> Any:
            return *super()._step_state(action)[:2], end

    env = InfoInItsPlace()
    env.reset()
    with pytest.raises(ValueError, match="for whether the episode terminates, expected True or False: return an observation"):
        env.step(np.zeros(1, dtype=np.float32))


def test_a_step_of_all_envs_tells_of_each(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_task_vec_env(ENV_ID, 4)
    env.reset()
    vector_env = env.unwrapped.vector_env  # type: ignore[attr-defined]
    states, ends = np.zeros((4, 2), dtype=np.float32), np.zeros(4, dtype=bool)
    for step, got in (
        ((states, 0.0, ends), r"\(\(4, 2\), \(\), \(4,\)\)"),
        ((states[:, 0], np.zeros(4), ends), r"\(\(4,\), \(4,\), \(4,\)\)"),  # each would be judged by what the first sees
    ):
        monkeypatch.setattr(vector_env, "_step_state", lambda actions, step=step: step)
        with pytest.raises(ValueError, match=rf"expected arrays of the shapes \(\(4, 2\), \(4,\), \(4,\)\), got {got}"):
            env.step(np.zeros((4, 2), dtype=np.float32))
    monkeypatch.setattr(vector_env, "_step_state", lambda actions: (np.zeros((4, 2), np.float32), np.zeros(4), np.zeros(4)))
    with pytest.raises(ValueError, match="_step_state returns terminations of dtype float64, expected bool"):
        env.step(np.zeros((4, 2), dtype=np.float32))


class EndsAtGoal(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or info["is_success"], truncated, info


def test_episodes_that_end_where_they_are_solved_are_warned_of(tiny_pearl: MakePEARL) -> None:
    env = EndsAtGoal(gym.make(ENV_ID, goal_distance=0.1))
    with pytest.warns(UserWarning, match="Episodes end where their task is solved, and only there"):
        tiny_pearl(env, n_tasks_per_rollout=4).learn(ROLLOUT)


BOUNDED = spaces.Box(-5, 5, (2,), np.float32)


@pytest.mark.parametrize(
    "wrap", [lambda env: RescaleObservation(env, np.float32(-1), np.float32(1)), lambda env: FrameStackObservation(env, 2)]
)
def test_a_wrapper_that_changes_observations_is_refused_in_the_first_rollout(wrap: Any, tiny_pearl: MakePEARL) -> None:
    """Rewards do not tell: nearly all are 0, with and without it."""
    env = FlattenObservation(wrap(TransformObservation(gym.make(ENV_ID), lambda obs: obs, BOUNDED)))
    with pytest.raises(ValueError, match="a wrapper changes observations, and hindsight rewards would be wrong"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(1)


class FarAway(gym.ObservationWrapper[Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def observation(self, observation: Any) -> Any:
        return (observation + 1e5).astype(np.float32)

    def step(self, action: Any) -> Any:
        *step, info = super().step(action)
        del info["achieved_task"]  # by which it would be refused
        return (*step, info)


@pytest.mark.filterwarnings("ignore:The posterior")
@pytest.mark.parametrize("seed", range(3))
def test_observations_may_be_large(seed: int, tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(FarAway(gym.make(ENV_ID)), n_tasks_per_rollout=1, seed=seed, gradient_steps=10).learn(300)
    assert np.isfinite(model.knowledge.sample_aggregate(5, 1.0)).all()


def test_a_time_limit_around_an_env_is_one(tiny_pearl: MakePEARL) -> None:
    env = gym.wrappers.TimeLimit(PointRobotEnv(), 7)
    model = tiny_pearl(env, n_tasks_per_rollout=1).learn(20)
    assert model.replay_buffer is not None and model.replay_buffer.max_episode_steps == 7


@pytest.mark.parametrize("lengths", [(20, 1000), (1000, 20)])
def test_the_shortest_time_limit_around_an_env_is_the_one_that_counts(lengths: tuple[int, int], tiny_pearl: MakePEARL) -> None:
    inner, outer = lengths
    env = gym.wrappers.TimeLimit(gym.make(ENV_ID, max_episode_steps=inner), outer)
    assert tiny_pearl(env, n_tasks_per_rollout=1).max_episode_steps == 20


def test_the_longest_time_limit_of_several_envs_is_the_one_that_counts(tiny_pearl: MakePEARL) -> None:
    env = DummyVecEnv([partial(gym.make, ENV_ID, max_episode_steps=length) for length in (10, 20, 10, 10)])
    model = tiny_pearl(env).learn(ROLLOUT)
    assert model.max_episode_steps == 20 and model._n_updates > 0


def test_a_window_without_a_screen_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    env = gym.make("SparseWheeled-v0", render_mode="rgb_array")
    env.reset()
    with pytest.raises(DependencyNotInstalled, match=r"MUJOCO_GL is glfw, which needs a screen, .*: set MUJOCO_GL=egl"):
        env.render()
