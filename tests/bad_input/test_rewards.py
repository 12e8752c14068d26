"""Rewards, successes and hindsight tasks that break the promises of a task family are named in the first rollout."""

import contextlib
import warnings
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest

from helpers import ENV_ID, ROLLOUT, MakePEARL
from helpers.broken_envs import LineEnv
from htr_envs import DynamicsVectorEnv, PointRobotFamily, check_task_env
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env


class Accumulating(PointRobotFamily):
    """What was solved once stays solved."""

    def is_success(self, traj: Any, task: Any) -> Any:
        return np.logical_or.accumulate(super().is_success(traj, task), axis=-1)

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return self.is_success(traj, task).astype(np.float32)


class Forgetful(PointRobotFamily):
    """Its env pays a step penalty of which its hook knows nothing."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return self.is_success(traj, task).astype(np.float32)


class Penalized(PointRobotDynamics):
    def step(self, actions: Any) -> Any:
        states, task_free, terminated = super().step(actions)
        return states, task_free - np.float32(0.1), terminated


@pytest.mark.parametrize(
    ("family", "dynamics", "message"),
    [
        (Accumulating, PointRobotDynamics, "compute_reward of a whole episode differs from .* of its steps one by one"),
        (
            type(
                "Floats",
                (PointRobotFamily,),
                {"is_success": lambda *args: PointRobotFamily.is_success(*args).astype(np.float32)},
            ),
            PointRobotDynamics,
            "is_success must return bool, one for each step, and returned float32",
        ),
        (
            Forgetful,
            Penalized,
            r"A step that does not solve its task.* returned 0, .* and its info.* is -0\.1",
        ),
        # Much less than a success, but more than rounding, and all that learns from rewards takes it for one
        (
            type(
                "Inexact",
                (PointRobotFamily,),
                {"compute_reward": lambda *args: PointRobotFamily.compute_reward(*args) + np.float32(5e-5)},
            ),
            PointRobotDynamics,
            r"A step that does not solve its task.* returned 5e-05, by compute_reward .* and its info.* is 0:",
        ),
    ],
)
def test_families_that_break_their_promises_are_refused_in_the_first_rollout(
    tiny_pearl: MakePEARL, family: Any, dynamics: Any, message: str
) -> None:
    env = BatchedTaskVecEnv(DynamicsVectorEnv(family(goal_distance=0.1), dynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=message):
        tiny_pearl(env).learn(ROLLOUT)


@pytest.mark.parametrize(
    ("hook", "spoil", "one", "several"),
    [
        ("compute_reward", np.mean, r"shape \(\) .* shape \(1,\)", r"shape \(\) .* shape \(4, 1\)"),
        ("is_success", lambda a: a[..., None], r"shape \(1, 1\) .* shape \(1,\)", r"shape \(4, 1, 1\) .* shape \(4, 1\)"),
        ("hindsight_task", np.ndarray.tolist, r"a list .* shape \(2,\)", r"a list .* shape \(4, 2\)"),
        # It has the goal in it, and would be found out when tasks are put side by side
        (
            "hindsight_task",
            lambda a: np.append(a, a, axis=-1),
            r"shape \(4,\) .* shape \(2,\)",
            r"shape \(4, 4\) .* shape \(4, 2\)",
        ),
    ],
)
def test_a_reward_hook_of_another_shape_is_named_in_the_first_step(
    hook: str, spoil: Any, one: str, several: str, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, family = gym.make(ENV_ID), get_task_family(make_task_vec_env(ENV_ID))
    env.reset(seed=0)
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4))
    right = getattr(family, hook)
    monkeypatch.setattr(type(family), hook, lambda self, *args, **kwargs: spoil(right(*args, **kwargs)))
    with pytest.raises(ValueError, match=f"^{hook} of the task family returned {one}"):
        env.step(env.action_space.sample())
    with pytest.raises(AssertionError, match=rf"The env fails in a step\. .*{hook} of the task family returned {one}"):
        check_task_env(env)
    with pytest.raises(ValueError, match=f"^At env step 0, .* {hook} of the task family returned {several}"):
        model.learn(ROLLOUT)


def in_place_of(right: Any) -> Any:
    def hook(family: Any, traj: Any, *args: Any) -> Any:
        traj.next_observations[...] -= 1
        return right(family, traj, *args)

    return hook


@pytest.mark.parametrize("hook", ["compute_reward", "is_success", "hindsight_task"])
def test_a_reward_hook_that_writes_into_a_step_is_named_there(
    hook: str, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next one would be told another step, and a wrapper be blamed."""
    env = gym.make(ENV_ID)
    env.reset(seed=0)
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4))
    monkeypatch.setattr(PointRobotFamily, hook, in_place_of(getattr(PointRobotFamily, hook)))
    for step in (lambda: env.step(env.action_space.sample()), lambda: model.learn(ROLLOUT)):
        with pytest.raises(ValueError, match=f"{hook} of the task family writes into the trajectory or task that it is given"):
            step()


class WideBeyondTheEnv(PointRobotFamily):
    """What an env that asks its family for nothing would not notice."""

    def hindsight_task(self, traj: Any, index: Any) -> Any:
        tasks = super().hindsight_task(traj, index)
        return np.append(tasks, tasks, axis=-1) if len(tasks) > 4 else tasks


def test_a_hindsight_task_of_another_width_is_named_whoever_made_the_env(tiny_pearl: MakePEARL) -> None:
    family = WideBeyondTheEnv(goal_distance=0.1)
    env = BatchedTaskVecEnv(DynamicsVectorEnv(family, PointRobotDynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=r"hindsight_task returned shape \(\d+, 4\) for \d+ steps, expected \(\d+, 2\)"):
        tiny_pearl(env).learn(ROLLOUT)


def test_a_hindsight_task_that_its_step_does_not_solve_is_named(
    tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_task_vec_env(ENV_ID, 4)
    family = get_task_family(env)
    right = family.hindsight_task
    monkeypatch.setattr(type(family), "hindsight_task", lambda self, traj, step: right(traj, step) + 3)
    with pytest.raises(ValueError, match="hindsight_task names a task that its own step does not solve"):
        tiny_pearl(env).learn(ROLLOUT)


def test_a_hindsight_task_of_nan_is_named(tiny_pearl: MakePEARL) -> None:
    """And no wrapper is blamed."""

    class Unsafe(PointRobotFamily):
        def hindsight_task(self, traj: Any, index: Any) -> Any:
            return super().hindsight_task(traj, index) * np.float32(np.nan)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Unsafe()
    with pytest.raises(ValueError, match=r"^hindsight_task returned NaN or infinity for a step of finite numbers"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(ROLLOUT)


def test_a_reward_of_nan_at_the_goal_is_named(tiny_pearl: MakePEARL) -> None:
    """Which no step of a rollout may reach."""

    class Unsafe(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            rewards = super().compute_reward(traj, task, reward_type)
            return np.where(super().is_success(traj, task), np.float32(np.nan), rewards)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Unsafe()
    with pytest.raises(ValueError, match=r"^compute_reward for the task that hindsight_task named returned NaN or infinity"):
        tiny_pearl(env, n_tasks_per_rollout=1).learn(ROLLOUT)


@pytest.mark.parametrize(("given", "what"), [([0.1], r"of shape \(1,\)"), (None, "that is None")])
def test_a_reward_of_the_dynamics_that_is_no_number_is_named(given: Any, what: str) -> None:
    class OtherReward(LineEnv):
        def _step_state(self, action: Any) -> Any:
            state, _, terminated = super()._step_state(action)
            return state, given, terminated

    env = OtherReward()
    env.reset()
    with pytest.raises(ValueError, match=f"_step_state returned a reward {what}, expected a number"):
        env.step(np.zeros(1, dtype=np.float32))


@pytest.mark.parametrize("factor", [0.1, 1.0, 100.0])
def test_rewards_of_another_scale_are_warned_of(factor: float, tiny_pearl: MakePEARL) -> None:
    class Scaled(PointRobotFamily):
        def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
            return super().compute_reward(traj, task, reward_type) * np.float32(factor)

    env = gym.make(ENV_ID)
    cast(Any, env.unwrapped).task_family = Scaled()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tiny_pearl(env, n_tasks_per_rollout=1).learn(1)
    about = [str(warning.message) for warning in caught if "A success is worth" in str(warning.message)]
    assert bool(about) == (factor != 1)
    assert factor == 1 or f"about {factor:.2g} here" in about[0]


@pytest.mark.parametrize(("radius", "is_refused"), [(0.02, True), (0.195, False)])
def test_successes_that_pay_nothing_are_named(
    radius: float, is_refused: bool, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """
    Exact hindsight tasks do pay, and own tasks are seldom solved. But where rewards fall to 0 at the rim of a goal, some
    successes are worth nothing.
    """
    near, compute_reward = PointRobotFamily(goal_radius=radius), PointRobotFamily.compute_reward

    def pays_near(self: Any, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        return compute_reward(near, traj, task, reward_type)

    monkeypatch.setattr(PointRobotFamily, "compute_reward", pays_near)
    refused = pytest.raises(ValueError, match=r"\d+ of \d+ steps that solve a task which was reached, by is_success, are")
    with refused if is_refused else contextlib.nullcontext():
        tiny_pearl().learn(4 * ROLLOUT)


class PaysAround(PointRobotFamily):
    """Also beside the goal, where an untrained robot hardly ever is."""

    def compute_reward(self, traj: Any, task: Any, reward_type: str = "sparse") -> Any:
        around = self._distance(traj, task) < 2 * self.goal_radius
        return np.maximum(super().compute_reward(traj, task, reward_type), np.float32(0.5) * around)


def test_a_failure_that_pays_is_named_before_one_is_seen(tiny_pearl: MakePEARL) -> None:
    """Hindsight tasks are reached from the first episode on."""
    env = BatchedTaskVecEnv(DynamicsVectorEnv(PaysAround(goal_distance=9.0), PointRobotDynamics(4), max_episode_steps=20))
    with pytest.raises(ValueError, match=r"does not solve a task which was reached, by is_success, is worth 0\.5 beside"):
        tiny_pearl(env).learn(ROLLOUT)


class WithoutSuccess(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        *result, info = self.env.step(action)
        return *result, {key: value for key, value in info.items() if key != "is_success"}


def test_an_env_that_does_not_tell_its_successes_is_named(tiny_pearl: MakePEARL) -> None:
    env = make_task_vec_env(ENV_ID, 2, wrapper=WithoutSuccess)
    with pytest.raises(ValueError, match=r"The env's step returns no info\['is_success'\], though its task family tells"):
        tiny_pearl(env).learn(1)
