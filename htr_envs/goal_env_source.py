"""GoalEnvs of other packages: how one is found, made and asked for goals and rewards."""

from __future__ import annotations

import copy
import importlib
import inspect
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.error import DependencyNotInstalled, UnregisteredEnv
from numpy.typing import ArrayLike, NDArray

from htr_envs.task_env import FloatArray

# Packages whose ids are known without their names, and the extras that install them
SUITES = {"gymnasium_robotics": "robotics", "panda_gym": "panda"}
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
# How far from one goal to the next rewards are looked at, to tell a sparse reward from one that grows on the way
WAY = (0.001, 0.01, 0.1, 0.5, 1.0)
N_STEPS = 20  # whose rewards are compared with compute_reward
SPARSE_ONLY = (
    "but a sparse reward is -1 and 0, or 0 and 1, the larger one at the goal: choose it by an argument of the env, such as "
    "reward_type='sparse'."
)
MAX_DRAWS = 100  # for each task, where an env draws the same goals again and again


@dataclass(frozen=True)
class GoalEnvSource:
    """Where GoalEnvs come from, as small as a task family needs it to be pickled. Equal sources make equal envs."""

    name: str
    """The id with its arguments."""
    spec: EnvSpec = field(repr=False, compare=False)
    """The registration, of a copy that has the arguments; what is pickled needs no registry where it is unpickled."""
    entry_point: Any = field(repr=False)
    """What makes it: the same id may be registered again, for another class."""

    @classmethod
    def find(cls, env_id: str | EnvSpec, env_kwargs: dict[str, Any]) -> GoalEnvSource:
        """Look a GoalEnv up.

        :param env_id: a registered id, ``"module:id"`` of one that the module registers, or a registration.
        :param env_kwargs: its arguments, beside those of the registration.
        :return: the source.
        :raises gymnasium.error.Error: if there is no such env, or its package is not installed.
        """
        spec = copy.deepcopy(_find_spec(env_id) if isinstance(env_id, str) else env_id)
        spec.kwargs.update(env_kwargs)
        with np.printoptions(threshold=sys.maxsize, floatmode="unique"):  # arrays in full, as they tell sources apart
            arguments = ", ".join(f"{key}={value!r}" for key, value in sorted(spec.kwargs.items()))
            wrappers = f" in {spec.additional_wrappers!r}" if spec.additional_wrappers else ""
        return cls(f"{spec.id}({arguments}){wrappers}", spec, spec.entry_point)

    @lru_cache(maxsize=16)  # noqa: B019 sources are few; a copy may have objects of another address, and be another source
    def dense(self) -> GoalEnvSource | None:
        """The same env with its dense reward, None where it has no argument ``reward_type``."""
        creator = load_env_creator(self.entry_point) if isinstance(self.entry_point, str) else self.entry_point
        has_one = "reward_type" in {*self.spec.kwargs, *inspect.signature(creator).parameters}
        return self.find(self.spec, {"reward_type": "dense"}) if has_one else None

    def make(self, **kwargs: Any) -> gym.Env[Any, Any]:
        """Make an env without a time limit.

        :param kwargs: further arguments, such as ``render_mode``.
        :return: the env.
        :raises gymnasium.error.DependencyNotInstalled: if it does not work with the installed version of MuJoCo.
        """
        try:
            return gym.make(self.spec, max_episode_steps=-1, disable_env_checker=True, **kwargs)
        except AssertionError as error:
            # Fetch, Hand and Kitchen compare MuJoCo's joint types with numbers, which is never true from 3.12 on
            if str(self.spec.entry_point).startswith("gymnasium_robotics") and _mujoco_version() >= (3, 12):
                raise DependencyNotInstalled(
                    f"{self.spec.id} does not work with MuJoCo {version('mujoco')}, it needs a version below 3.12: "
                    'run `pip install "sb3_htr[robotics]"`.'
                ) from error
            raise


def _find_spec(env_id: str) -> EnvSpec:
    module, _, env_id = env_id.rpartition(":")
    missing = []
    for name in [module] if module else SUITES if env_id not in gym.registry else []:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name != name:
                raise
            missing.append(name)
    try:
        return gym.spec(env_id)
    except UnregisteredEnv as error:
        if not missing:
            raise
        packages = [f'"sb3_htr[{SUITES[name]}]"' if name in SUITES else name for name in missing]
        other = "" if module else f", or name the module that registers the env, as in 'module:{env_id}'"
        raise DependencyNotInstalled(
            f"There is no env {env_id}, and {' and '.join(missing)} cannot be imported: "
            f"run `pip install {' '.join(packages)}`{other}."
        ) from error


def _mujoco_version() -> tuple[int, ...]:
    return tuple(int(number) for number in version("mujoco").split(".")[:2])


@lru_cache(maxsize=16)
def probe(source: GoalEnvSource) -> gym.Env[Any, Any]:
    """An env to ask for spaces, goals and rewards, one for all task families of this process.

    :param source: where it comes from.
    :return: the env; what it is in the middle of means nothing.
    :raises ValueError: if it is no GoalEnv, or one of the old gym.
    """
    env = source.make()
    check_goal_env(env, source.spec.id)
    action_space = env.action_space
    if not _is_flat(action_space) or not np.issubdtype(action_space.dtype, np.floating):
        raise ValueError(f"The action space of {source.spec.id} is {action_space}, expected a one-dimensional Box of floats.")
    try:
        returned = env.reset(seed=0)
    except TypeError as error:
        if "unexpected keyword argument 'seed'" not in str(error):
            raise
        raise ValueError(_is_old(source)) from error
    if not (isinstance(returned, tuple) and len(returned) == 2):
        raise ValueError(_is_old(source))
    return env


def check_goal_env(env: gym.Env[Any, Any], name: str) -> None:
    """Check that an env has the interface of a GoalEnv.

    :param env: the env.
    :param name: of it, for the sentence.
    :raises ValueError: if it has not, or goals of two shapes.
    """
    space: Any = env.observation_space
    boxes = [space.spaces.get(key) for key in GOAL_KEYS] if isinstance(space, spaces.Dict) else [None]
    if not all(map(_is_flat, boxes)) or not env.has_wrapper_attr("compute_reward"):
        raise ValueError(
            f"{name} is no GoalEnv: its observations must be a Dict of one-dimensional boxes observation, "
            "achieved_goal and desired_goal, and it must have compute_reward(achieved_goal, desired_goal, info)."
        )
    achieved, desired = (space[key].shape for key in GOAL_KEYS[1:])
    if achieved != desired:
        raise ValueError(
            f"{name} achieves goals of shape {achieved} and desires goals of {desired}, expected the same, as each that is "
            "achieved may become one that is desired: leave out of achieved_goal what no goal asks for."
        )


def without_goal(observation: dict[str, NDArray[Any]]) -> FloatArray:
    """What is left of an observation when its goal is hidden.

    :param observation: of a GoalEnv.
    :return: ``observation``, then ``achieved_goal``, shape (obs_dim,), float32.
    """
    return np.concatenate((observation["observation"], observation["achieved_goal"]), dtype=np.float32)


def space_without_goal(env: gym.Env[Any, Any]) -> spaces.Box:
    """The space of :func:`without_goal`: no bounds, as not all envs keep theirs, and rounded to float32 they are others.

    :param env: a GoalEnv.
    :return: the space, shape (obs_dim,).
    """
    return spaces.Box(-np.inf, np.inf, without_goal(env.observation_space.sample()).shape, np.float32)


def _is_old(source: GoalEnvSource) -> str:
    return (
        f"{source.spec.id} has the interface of the old gym: reset must take seed and options and return observation and "
        "info, and step must return observation, reward, terminated, truncated and info."
    )


def _is_flat(space: spaces.Space[Any] | None) -> bool:
    return isinstance(space, spaces.Box) and len(space.shape) == 1


def goal_rewards(source: GoalEnvSource, achieved_goals: ArrayLike, goals: ArrayLike) -> FloatArray:
    """The env's own rewards.

    :param source: of the env.
    :param achieved_goals: shape (..., goal_dim).
    :param goals: shape (..., goal_dim); leading axes broadcast.
    :return: rewards, shape (...), float32.
    :raises ValueError: if the env's ``compute_reward`` does not take many goals at once.
    """
    env = probe(source)
    assert isinstance(env.observation_space, spaces.Dict)
    # float32 as in observations; then copies, which the env may write into, of rows in one piece, whatever the leading axes:
    # sums may be ordered by memory layout, and rewards must be the same bits
    both = np.broadcast_arrays(*(np.asarray(values, dtype=np.float32) for values in (achieved_goals, goals)))
    achieved, desired = (
        np.array(values.reshape(-1, values.shape[-1]), dtype=env.observation_space[key].dtype, order="C")
        for values, key in zip(both, GOAL_KEYS[1:], strict=True)
    )
    try:
        # as Stable-Baselines3's HER calls it, but for what infos hold
        rewards = np.asarray(env.get_wrapper_attr("compute_reward")(achieved, desired, np.full(len(achieved), {})))
    except Exception as error:
        raise ValueError(_not_vectorized(source, f"raised {error!r}")) from error
    if rewards.shape != achieved.shape[:1]:
        raise ValueError(_not_vectorized(source, f"returned an array {rewards.shape}"))
    return rewards.astype(np.float32).reshape(both[0].shape[:-1])


def _not_vectorized(source: GoalEnvSource, what: str) -> str:
    return (
        f"compute_reward of {source.spec.id} {what} for goals of shape (n, goal_dim) and an array of n empty infos, expected "
        "n rewards: let it take many goals at once, as HER does, and nothing from infos."
    )


class GoalSets(NamedTuple):
    """Goals of a family, all of them different, shapes (n, goal_dim), and the reward where none is reached."""

    train: FloatArray
    validation: FloatArray
    test: FloatArray
    failure_reward: float


@lru_cache(maxsize=16)
def draw_goal_sets(source: GoalEnvSource, n_train: int, n_validation: int, n_test: int, task_seed: int) -> GoalSets:
    """Have an env draw the goals of a family, and check its rewards with them.

    :param source: of the env.
    :param n_train: how many training goals.
    :param n_validation: how many validation goals.
    :param n_test: how many test goals.
    :param task_seed: seed of all three; each has a source of randomness of its own.
    :return: the goals; must not be written to.
    :raises ValueError: if the env has too few goals, draws others for the same seed, or its reward is not sparse.
    """
    first, _, again = (draw_goal(source, seed) for seed in (0, 1, 0))
    if not np.array_equal(first, again):
        raise ValueError(
            f"{source.spec.id} draws another goal for the same seed, so that each process would have other tasks: let its "
            "reset draw from self.np_random."
        )
    seen: dict[bytes, FloatArray] = {}
    for purpose, n in enumerate((n_train, n_validation, n_test)):
        # numpy never changes RandomState's stream, as it may Generator's
        random_state = np.random.RandomState([task_seed, purpose])
        wanted = len(seen) + n
        for _ in range(MAX_DRAWS * n):
            goal = draw_goal(source, int(random_state.randint(2**31 - 1)))
            seen.setdefault((goal + np.float32(0.0)).tobytes(), goal)
            if len(seen) == wanted:
                break
        else:
            raise ValueError(
                f"{source.spec.id} drew only {len(seen)} different goals, but training, validation and test tasks must "
                "differ: ask for fewer by n_train_tasks, n_validation_tasks and n_test_tasks."
            )
    goals = np.stack(list(seen.values()))
    train, validation, test = np.split(goals, [n_train, n_train + n_validation])
    return GoalSets(train, validation, test, _failure_reward(source, goals))


def draw_goal(source: GoalEnvSource, seed: int) -> FloatArray:
    """Have an env draw a goal.

    :param source: of the env.
    :param seed: of the draw.
    :return: the goal, shape (goal_dim,).
    """
    observation, _ = probe(source).reset(seed=seed)
    return np.array(observation["desired_goal"], dtype=np.float32)


def _failure_reward(source: GoalEnvSource, goals: FloatArray) -> float:
    ways = np.roll(goals, 1, axis=0) - goals

    def ask() -> FloatArray:
        return np.stack([goal_rewards(source, goals + np.float32(t) * ways, goals) for t in (0.0, *WAY)])

    told = ask()
    success, found = np.unique(told[0]), np.unique(told)
    if len(found) == 1:
        raise ValueError(
            f"compute_reward of {source.spec.id} gives {success[0]:.3g} at each goal for each other one: the goals that it "
            "draws lie so near to one another that all are reached at once, or its reward tells of no goal."
        )
    if len(success) != 1 or not np.array_equal(found, success[0] - np.array([1.0, 0.0])):
        shown = ", ".join(f"{value:.3g}" for value in found[:5])
        raise ValueError(f"compute_reward of {source.spec.id} gives {shown} ..., {SPARSE_ONLY}")
    _check_steps(source)
    if not np.array_equal(ask(), told):
        raise ValueError(
            f"compute_reward of {source.spec.id} gives other rewards for the same goals after {N_STEPS} steps: a reward must "
            "depend on achieved and desired goal alone. What else it needs, such as a speed or a contact, belongs into both."
        )
    return float(success[0]) - 1.0


def _check_steps(source: GoalEnvSource) -> None:
    env = probe(source)
    env.action_space.seed(0)
    goal = env.reset(seed=0)[0]["desired_goal"].copy()
    for _ in range(N_STEPS):
        if len(returned := env.step(env.action_space.sample())) != 5:
            raise ValueError(_is_old(source))
        observation, reward, terminated, truncated, _ = returned
        expected = float(goal_rewards(source, observation["achieved_goal"], observation["desired_goal"]))
        if float(reward) != expected:
            raise ValueError(
                f"A step of {source.spec.id} gave the reward {float(reward):.3g}, but compute_reward gives {expected:.3g} "
                "without infos: a reward must depend on achieved and desired goal alone."
            )
        if not np.array_equal(observation["desired_goal"], goal):
            raise ValueError(
                f"{source.spec.id} has a goal that moves within an episode, but a task stays: let resets alone draw it."
            )
        if terminated or truncated:
            goal = env.reset()[0]["desired_goal"].copy()
