"""HiddenGoal: GoalEnvs of others as task families."""

import copy
import importlib
import importlib.util
import pickle
import re
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import SubprocVecEnv

from helpers.drawing import skip_where_mujoco_cannot_draw
from htr_envs import HiddenGoalEnv, HiddenGoalFamily, HiddenGoalWrapper, Trajectory, check_task_env, goal_env_source, hide_goal
from htr_envs.goal_env import find_hidden
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.family_facts import family_facts
from sb3_htr.common.vec_env import make_task_vec_env

PAGE = Path(__file__).parents[2] / "docs" / "envs" / "hidden_goal.md"
EXTRAS = {"robotics": "gymnasium_robotics", "panda": "panda_gym", "metaworld": "metaworld"}
TINY: dict[str, Any] = {
    "n_tasks_per_rollout": 2,
    "n_episodes_per_task": 2,
    "learning_starts": 100,
    "gradient_steps": 3,
    "meta_batch_size": 4,
    "batch_size": 4,
    "policy_kwargs": {"net_arch": [16], "encoder_arch": [16], "latent_dim": 3},
    "seed": 0,
}


class ReachEnv(gym.Env[Any, Any]):
    """A plane whose start is kept away from the goal, as mazes do, and which ends at the goal, as panda-gym does."""

    reward_type = "sparse"

    def __init__(self, n_goals: int = 0, ends_outside: bool = False) -> None:
        plane = spaces.Box(-9.0, 9.0, (2,), np.float64)
        self.observation_space: Any = spaces.Dict(observation=plane, achieved_goal=plane, desired_goal=plane)
        self.action_space: Any = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.n_goals, self.ends_outside = n_goals, ends_outside

    def _observe(self) -> dict[str, Any]:
        return {"observation": 2.0 * self.position, "achieved_goal": self.position, "desired_goal": self.goal}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)
        if self.n_goals:
            self.goal = np.full(2, float(self.np_random.integers(self.n_goals)))
        self.position = -self.goal
        return self._observe(), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.position = np.clip(self.position + 0.1 * action, -9.0, 9.0)
        reward = float(self.compute_reward(self.position, self.goal, {}))
        at_goal = float(np.linalg.norm(self.position - self.goal)) <= 0.2
        outside = self.ends_outside and abs(self.position[0]) > 1.5
        return self._observe(), reward, bool(at_goal or outside), False, {}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        rewards = {
            "sparse": -(distance > 0.2).astype(np.float32),
            "positive": (distance <= 0.2).astype(np.float64),
            "dense": np.exp(-distance),
            "ten": 10.0 * (distance <= 0.2),
            "shaped": np.where(distance <= 0.2, 1.0 - distance, 0.0),
            "upside_down": (distance > 0.2) * 1.0,
            "one goal at a time": np.float64(np.linalg.norm(achieved_goal - desired_goal) > 0.2),
            "free": np.zeros(np.shape(distance)),
        }
        return rewards[self.reward_type]


class ChoiceEnv(ReachEnv):
    """Its reward is chosen by an argument."""

    def __init__(self, reward_type: str = "sparse") -> None:
        super().__init__()
        self.reward_type = reward_type


class CostlyEnv(ReachEnv):
    """Its steps have a cost that compute_reward does not know of."""

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward - 0.1, *rest


class InformedEnv(ReachEnv):
    """Its reward needs infos."""

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return np.array([one["reward"] for one in info])


class FragileEnv(ReachEnv):
    """Far away it pays for what breaks, which 20 steps do not see."""

    def step(self, action: Any) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward - 5.0 * (abs(self.position[0]) > 3), *rest


class SlowEnv(ReachEnv):
    """Its goals are reached where its latest action was small, of which goals tell nothing."""

    effort = 0.0

    def step(self, action: Any) -> Any:
        self.effort = float(np.abs(action).max())
        return super().step(action)

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        rewards = super().compute_reward(achieved_goal, desired_goal, info)
        return rewards if self.effort < 0.1 else np.full_like(rewards, -1.0)


class InPlaceEnv(ReachEnv):
    """Its compute_reward writes into the goals that it is given, which have the dtype of what is stored."""

    def __init__(self) -> None:
        super().__init__()
        plane = spaces.Box(-9.0, 9.0, (2,), np.float32)
        self.observation_space = spaces.Dict(observation=plane, achieved_goal=plane, desired_goal=plane)

    def _observe(self) -> dict[str, Any]:
        return {key: value.astype(np.float32) for key, value in super()._observe().items()}

    def step(self, action: Any) -> Any:
        self.position = np.clip(self.position + 0.1 * action, -9.0, 9.0)
        reward = float(self.compute_reward(self.position.copy(), self.goal, {}))
        return self._observe(), reward, False, False, {}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        achieved_goal -= desired_goal
        return super().compute_reward(achieved_goal, 0.0, info)


class UnseededEnv(ReachEnv):
    """Its goals are drawn from numpy's global generator."""

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        self.goal = np.random.uniform(-1.0, 1.0, 2)
        return self._observe(), {}


class ListEnv(ReachEnv):
    """Its goals are given to it."""

    def __init__(self, goals: Any) -> None:
        super().__init__()
        self.goals = goals

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.goal = np.asarray(self.goals[self.np_random.integers(len(self.goals))], dtype=np.float64)
        return self._observe(), {}


class CutEnv(ReachEnv):
    """It cuts an episode short, and then wants a reset."""

    over = True

    def reset(self, **kwargs: Any) -> Any:
        self.over = False
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        assert not self.over, "reset first"
        *others, terminated, _, info = super().step(action)
        self.over = bool(abs(self.position[0]) > 1.2)
        return *others, terminated, self.over, info


class ExactEnv(ReachEnv):
    """Its actions have bounds that float32 rounds to larger ones."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Box(-0.1, 0.1, (2,), np.float64)

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        return super().step(action)


class PlainEnv(ReachEnv):
    """Not a GoalEnv."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(-1.0, 1.0, (2,))


class HeightEnv(ReachEnv):
    """Its goals are a part of what is achieved."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Dict({**self.observation_space, "desired_goal": spaces.Box(-9.0, 9.0, (1,))})

    def _observe(self) -> dict[str, Any]:
        return {**super()._observe(), "desired_goal": self.goal[:1]}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return super().compute_reward(achieved_goal[..., :1], desired_goal[..., :1], info)


class DiscreteEnv(ReachEnv):
    """Its actions are no vectors."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Discrete(3)


class OldEnv(ReachEnv):
    """Resets as the old gym did."""

    def reset(self, **kwargs: Any) -> Any:
        return super().reset(**kwargs)[0]


class UnseededOldEnv(ReachEnv):
    """The same, without a seed."""

    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()[0]


class OldStepEnv(ReachEnv):
    """Steps as the old gym did."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info


class MovingEnv(ReachEnv):
    """Its goal moves within an episode."""

    def step(self, action: Any) -> Any:
        self.goal = self.goal + 0.01
        return super().step(action)


class Robot(ReachEnv):
    """Its goal stays where it was put, until a reset is told another."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.goal = np.asarray((options or {}).get("goal", getattr(self, "goal", [0.5, 0.5])))
        self.position = np.zeros(2)
        return self._observe(), {}


class InPlaceRobot(Robot, InPlaceEnv):
    """The same, whose compute_reward writes into its arguments."""


BAD = (
    MovingEnv,
    CostlyEnv,
    SlowEnv,
    InformedEnv,
    UnseededEnv,
    PlainEnv,
    HeightEnv,
    DiscreteEnv,
    OldEnv,
    UnseededOldEnv,
    OldStepEnv,
)
_class: Any
for _class in (ReachEnv, ChoiceEnv, ListEnv, CutEnv, ExactEnv, InPlaceEnv, FragileEnv, *BAD):
    gym.register(f"Toy{_class.__name__}-v0", entry_point=_class, max_episode_steps=30)
TOY, CHOICE = "ToyReachEnv-v0", "ToyChoiceEnv-v0"


def test_an_id_that_is_registered_again_is_another_family() -> None:
    """As in a notebook, where a class is edited: rewards would be those of the former one."""

    def register(radius: float) -> HiddenGoalFamily:
        class Edited(ReachEnv):
            def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
                return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > radius).astype(np.float32)

        made_by: Any = Edited
        gym.registry.pop("ToyEdited-v0", None)
        gym.register("ToyEdited-v0", entry_point=made_by, max_episode_steps=30)
        return HiddenGoalFamily("ToyEdited-v0")

    near, far = (register(radius).reached([0.0, 0.0], [0.2, 0.0]) for radius in (0.1, 0.3))
    assert not near and far


def test_wrappers_of_a_registration_are_part_of_it() -> None:
    """Envs are kept to be asked, of each source one."""
    plain = HiddenGoalEnv(TOY)
    wrapped = gym.wrappers.RescaleAction(gym.make(TOY), np.float32(-10), np.float32(10))
    assert wrapped.spec is not None
    scaled = HiddenGoalEnv(wrapped.spec)
    assert (scaled.action_space.high == 10).all() and (plain.action_space.high == 1).all()


def test_families_of_long_arguments_are_told_apart() -> None:
    """numpy leaves out most of an array of more than a thousand numbers."""
    near = np.random.default_rng(0).uniform(-1, 1, (600, 2))
    far = near.copy()
    far[100:500] += 5
    sizes = {"n_train_tasks": 40, "n_validation_tasks": 2, "n_test_tasks": 2}
    families = [HiddenGoalFamily("ToyListEnv-v0", {"goals": goals}, **sizes) for goals in (near, far)]
    assert families[0].train_tasks.max() < 1.1 < families[1].train_tasks.max()
    assert family_facts(families[0]) != family_facts(families[1])


def make(env_id: str, **kwargs: Any) -> tuple[gym.Env[Any, Any], HiddenGoalEnv]:
    env = gym.make(env_id, **kwargs)
    base = env.unwrapped
    assert isinstance(base, HiddenGoalEnv)
    return env, base


def actions_of(env: gym.Env[Any, Any], n: int, seed: int = 0) -> Any:
    # some are beyond the bounds, which clip them
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (n, *(env.action_space.shape or ()))).astype(np.float32)


def play(env: gym.Env[Any, Any], actions: Any, **reset: Any) -> tuple[Any, Any]:
    observations, rewards = [env.reset(**reset)[0]], []
    for action in actions:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


def same(first: Any, second: Any) -> bool:
    return len(first) == len(second) and all(map(np.array_equal, first, second))


# ---------------------------------------------------------------- without any other package


@pytest.mark.parametrize("reward_type", ["sparse", "positive"])
def test_a_goal_env_is_a_task_family(reward_type: str) -> None:
    check_task_env(gym.make(hide_goal(CHOICE, reward_type=reward_type)))


@pytest.mark.parametrize("reward_type", ["sparse", "positive"])
def test_both_kinds_of_sparse_reward_become_one_and_zero(reward_type: str) -> None:
    env = HiddenGoalEnv(CHOICE, {"reward_type": reward_type})
    start = env.reset(seed=0, options={"task": [5.0, 5.0]})[0][-2:]
    assert play(env, actions_of(env, 3))[1].tolist() == [0.0, 0.0, 0.0]
    assert play(env, 0 * actions_of(env, 3), seed=0, options={"task": start})[1].tolist() == [1.0, 1.0, 1.0]


def test_the_dense_reward_is_the_envs_own_or_the_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    zeros = np.zeros((1, 4), dtype=np.float32)
    traj = Trajectory(zeros, zeros, zeros, np.zeros(1, dtype=np.float32))
    own = HiddenGoalFamily(CHOICE, {"reward_type": "sparse"})
    assert own.compute_reward(traj, [3.0, 4.0], "dense") == pytest.approx(np.exp(-5.0))
    assert HiddenGoalFamily(TOY).compute_reward(traj, [3.0, 4.0], "dense") == -5.0
    # That there is a choice, the constructor tells where the registration does not
    made_by: Any = ChoiceEnv
    monkeypatch.setitem(
        gym.registry, "ToySilent-v0", gym.envs.registration.EnvSpec("ToySilent-v0", made_by, max_episode_steps=5)
    )
    assert HiddenGoalFamily("ToySilent-v0").compute_reward(traj, [3.0, 4.0], "dense") == pytest.approx(np.exp(-5.0))


def test_nothing_tells_the_hidden_goal() -> None:
    env = HiddenGoalEnv(TOY)
    actions = actions_of(env, 20)
    (seen, _), (other, _) = (play(env, actions, seed=3, options={"task": task}) for task in env.test_tasks[:2])
    assert np.array_equal(seen, other)
    # observation and achieved goal; the env's own goal, which the start does tell, is drawn apart from the task
    assert np.array_equal(seen[:, :2], 2 * seen[:, 2:])
    env.set_task(None)
    starts = np.array([np.append(env.reset()[0][-2:], env.task) for _ in range(500)])
    assert np.abs(np.corrcoef(starts.T)[:2, 2:]).max() < 0.15
    assert set(env.reset()[1]) == {"task_id"}
    assert set(env.step(actions[0])[4]) == {"task_id", "is_success", "achieved_task", "task_free_reward"}


def test_an_end_at_the_envs_own_goal_is_none_and_any_other_is_one() -> None:
    env = HiddenGoalEnv(TOY, {"ends_outside": True})
    position = env.reset(seed=0)[0][-2:]
    own_goal, ends = -position, []
    for _ in range(25):
        observation, _, terminated, _, _ = env.step(np.clip(10 * (own_goal - position), -1, 1).astype(np.float32))
        position = observation[-2:]
        ends.append(terminated)
    assert np.allclose(position, own_goal, atol=0.01) and not any(ends)
    ends = [env.step(np.array([1.0, 0.0], dtype=np.float32))[2] for _ in range(30)]
    assert not ends[0] and ends[-1]


def test_an_episode_that_the_goal_env_cuts_short_is_truncated() -> None:
    env = gym.make(hide_goal("ToyCutEnv-v0"))
    check_task_env(env)
    env.reset(seed=0)
    ends = [env.step(np.array([1.0, 0.0], dtype=np.float32))[2:4]]
    while not any(ends[-1]):
        ends.append(env.step(np.array([1.0, 0.0], dtype=np.float32))[2:4])
    assert len(ends) < 30 and ends[-1] == (False, True)


def test_a_reward_that_no_goal_tells_of_is_named_when_it_is_paid() -> None:
    """Each other agent would be told of it, and the hidden goal's would never."""
    env = HiddenGoalEnv("ToyFragileEnv-v0")
    with pytest.raises(ValueError, match=r"A step of ToyFragileEnv-v0 gave the reward -6, but .* must depend on achieved and"):
        play(env, np.ones((50, 2), dtype=np.float32), seed=0)


def test_a_compute_reward_may_write_into_its_arguments() -> None:
    env = gym.make(hide_goal("ToyInPlaceEnv-v0"))
    check_task_env(env)
    start = env.reset(seed=0)[0]
    observations, rewards = play(env, 0 * actions_of(env, 3), seed=0, options={"task": start[-2:] + np.float32(0.1)})
    assert np.array_equal(observations, [start] * 4) and rewards.tolist() == [1.0, 1.0, 1.0]
    robot = HiddenGoalWrapper(InPlaceRobot())
    robot.reset()
    assert robot.step(np.zeros(2, dtype=np.float32))[1] == 0.0


def test_task_sets_follow_the_task_seed_alone() -> None:
    families = [HiddenGoalFamily(TOY), HiddenGoalFamily(TOY)]
    sets = [np.concatenate((family.train_tasks, family.validation_tasks, family.test_tasks)) for family in families]
    assert np.array_equal(sets[0], sets[1]) and len(np.unique(sets[0], axis=0)) == 200
    other = HiddenGoalFamily(TOY, task_seed=1, n_train_tasks=3, n_validation_tasks=2, n_test_tasks=1)
    assert [len(tasks) for tasks in (other.train_tasks, other.validation_tasks, other.test_tasks)] == [3, 2, 1]
    assert not np.isin(other.train_tasks, sets[0]).any()
    assert np.array_equal(HiddenGoalFamily(TOY, n_train_tasks=5).test_tasks, families[0].test_tasks)


def test_goals_that_repeat_are_drawn_once() -> None:
    family = HiddenGoalFamily(TOY, {"n_goals": 9}, n_train_tasks=5, n_validation_tasks=2, n_test_tasks=2)
    tasks = np.concatenate((family.train_tasks, family.validation_tasks, family.test_tasks))
    assert sorted(tasks[:, 0]) == list(range(9))


def test_a_family_pickles_without_its_env() -> None:
    family, env = HiddenGoalFamily(TOY), HiddenGoalEnv(TOY)
    pickled = pickle.dumps(family)
    assert len(pickled) < 10_000
    observations, _ = play(env, actions_of(env, 10), seed=0)
    traj = Trajectory(observations[:-1], observations[:-1], observations[1:], np.zeros(10, dtype=np.float32))
    goal_env_source.probe.cache_clear()
    twin = pickle.loads(pickled)
    assert np.array_equal(twin.compute_reward(traj, family.test_tasks), family.compute_reward(traj, family.test_tasks))
    drawn, again = (one.sample_tasks(3, np.random.default_rng(0)) for one in (twin, family))
    assert np.array_equal(drawn, again)


def test_all_randomness_is_the_envs_own_generator() -> None:
    env, other = HiddenGoalEnv(TOY), HiddenGoalEnv(TOY)
    play(env, actions_of(env, 7), seed=1)
    play(other, actions_of(other, 9), seed=5)
    other.np_random.bit_generator.state = copy.deepcopy(env.np_random.bit_generator.state)
    assert same(play(env, actions_of(env, 7)), play(other, actions_of(other, 7)))


def test_a_closed_env_goes_on() -> None:
    env = HiddenGoalEnv(TOY)
    first = play(env, actions_of(env, 7), seed=1)
    env.close()
    assert same(first, play(env, actions_of(env, 7), seed=1))


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    (CHOICE, {"reward_type": "dense"}, "a sparse reward is -1 and 0, or 0 and 1"),
    (CHOICE, {"reward_type": "ten"}, "gives 0, 10 ..., but a sparse reward"),
    (CHOICE, {"reward_type": "shaped"}, "choose it by an argument of the env, such as reward_type='sparse'"),
    (CHOICE, {"reward_type": "upside_down"}, "the larger one at the goal"),
    (CHOICE, {"reward_type": "free"}, "gives 0 at each goal for each other one"),
    (CHOICE, {"reward_type": "one goal at a time"}, "let it take many goals at once, as HER does"),
    (TOY, {"n_goals": 9}, "drew only 9 different goals"),
    ("ToyUnseededEnv-v0", {}, "draws another goal for the same seed"),
    ("ToyMovingEnv-v0", {}, "has a goal that moves within an episode"),
    ("ToyCostlyEnv-v0", {}, "must depend on achieved and desired goal alone"),
    ("ToySlowEnv-v0", {}, "gives other rewards for the same goals after 20 steps: a reward must depend on"),
    ("ToyInformedEnv-v0", {}, "raised KeyError('reward') for goals of shape (n, goal_dim)"),
    ("ToyPlainEnv-v0", {}, "ToyPlainEnv-v0 is no GoalEnv"),
    ("ToyHeightEnv-v0", {}, "ToyHeightEnv-v0 achieves goals of shape (2,) and desires goals of (1,), expected the same"),
    ("ToyDiscreteEnv-v0", {}, "expected a one-dimensional Box"),
    ("ToyOldEnv-v0", {}, "ToyOldEnv-v0 has the interface of the old gym: reset must take seed and options"),
    ("ToyUnseededOldEnv-v0", {}, "ToyUnseededOldEnv-v0 has the interface of the old gym"),
    ("ToyOldStepEnv-v0", {}, "ToyOldStepEnv-v0 has the interface of the old gym"),
    ("CartPole-v1", {}, "CartPole-v1 is no GoalEnv"),
]


@pytest.mark.parametrize(("env_id", "env_kwargs", "sentence"), REFUSED)
def test_what_cannot_be_a_family_is_refused_in_a_sentence(env_id: str, env_kwargs: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError) as caught:
        HiddenGoalEnv(env_id, env_kwargs)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("reward_type", ["sparse", "positive"])
def test_the_goal_env_itself_is_seen_as_its_family_is(reward_type: str) -> None:
    robot = Robot()
    robot.reward_type = reward_type
    env, family_env = HiddenGoalWrapper(TimeLimit(robot, 30)), HiddenGoalEnv(TOY)
    assert env.observation_space == family_env.observation_space
    assert env.reset()[0].tolist() == [0, 0, 0, 0]
    for _ in range(3):
        observation, paid, *_ = env.step(np.array([1.0, 1.0], dtype=np.float32))
        assert paid == 0 and env.observation_space.contains(observation)
    with pytest.warns(UserWarning, match="ends an episode where its goal is reached, and HiddenGoal goes on"):
        assert env.step(np.array([1.0, 1.0], dtype=np.float32))[1] == 1
    observation, paid, *_ = env.step(np.array([1.0, 1.0], dtype=np.float32))
    assert paid == 1.0
    assert observation.tolist() == pytest.approx([1, 1, 0.5, 0.5])
    model = PEARL("MlpPolicy", gym.make(hide_goal(TOY)), **TINY)
    assert len(model.adapt(env, n_episodes=2).returns) == 2
    # Another goal is another task, which is begun by whoever says so
    env.reset(options={"goal": [0.0, 0.0]})
    assert env.step(np.zeros(2, dtype=np.float32))[1] == 1.0


def test_a_goal_that_does_not_stay_is_named() -> None:
    model = PEARL("MlpPolicy", gym.make(hide_goal(TOY)), **TINY)
    with pytest.raises(ValueError, match=r"ToyReachEnv-v0 was at another goal, .* HiddenGoal/ToyReachEnv-v0"):
        model.adapt(HiddenGoalWrapper(gym.make(TOY)), n_episodes=3)
    env = HiddenGoalWrapper(MovingEnv())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="MovingEnv was at another goal"):
        env.step(np.zeros(2, dtype=np.float32))


def test_a_robot_whose_rewards_are_not_sparse_or_whose_goal_is_none_is_refused() -> None:
    robot = Robot()
    robot.reward_type = "one goal at a time"
    env = HiddenGoalWrapper(robot)
    env.reset()
    with pytest.raises(ValueError, match="Robot pays 1, but a sparse reward is"):  # as much as beside its goal
        env.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"The desired_goal of Robot is \[nan  0.\], expected finite"):
        HiddenGoalWrapper(robot).reset(options={"goal": [np.nan, 0.0]})
    dense = HiddenGoalWrapper(gym.make(CHOICE, reward_type="dense"))
    dense.reset()
    with pytest.raises(ValueError, match=r"pays 0\.\d+, but a sparse reward is"):
        dense.step(np.ones(2, dtype=np.float32))
    with pytest.raises(ValueError, match="ToyPlainEnv-v0 is no GoalEnv"):
        HiddenGoalWrapper(gym.make("ToyPlainEnv-v0"))


@pytest.mark.parametrize(
    ("name", "value"),
    [("n_test_tasks", 0), ("n_train_tasks", 80.0), ("task_seed", None), ("task_seed", 1.5), ("task_seed", -1)],
)
def test_no_tasks_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}.* (is|are) .* whole number"):
        HiddenGoalFamily(TOY, **{name: value})


def test_a_picture_that_the_goal_env_does_not_draw_is_refused() -> None:
    for mode in ("human", "rgb_array"):
        with pytest.raises(ValueError, match=rf"render_mode is '{mode}', expected None or one of \[\]"):
            HiddenGoalEnv(TOY, render_mode=mode)


def test_actions_are_in_the_goal_envs_own_space() -> None:
    env = HiddenGoalEnv("ToyExactEnv-v0")
    for action in (env.action_space.low, env.action_space.high, np.ones(2, dtype=np.float32)):
        env.reset()
        env.step(action)


def test_any_id_is_registered_with_its_time_limit() -> None:
    assert hide_goal(TOY) == hide_goal(TOY) == f"HiddenGoal/{TOY}"
    env, base = make(hide_goal(TOY), n_train_tasks=4)
    assert env.spec is not None and env.spec.max_episode_steps == 30
    assert len(base.train_tasks) == 4


def test_an_id_that_is_registered_again_with_another_time_limit_has_that(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in (20, 50):
        spec = gym.envs.registration.EnvSpec("ToyLimit-v0", gym.spec(TOY).entry_point, max_episode_steps=limit)
        monkeypatch.setitem(gym.registry, "ToyLimit-v0", spec)
        assert gym.spec(hide_goal("ToyLimit-v0")).max_episode_steps == limit


def test_ids_that_are_spelt_are_registered() -> None:
    find_hidden("HiddenGoal/ToyChoiceEnv-v0")
    assert "HiddenGoal/ToyChoiceEnv-v0" in gym.registry
    find_hidden("HiddenGoal/no_such_module:Env-v0")  # a file may name no module
    find_hidden("SparsePointRobot-v0")


def test_an_id_with_a_namespace_is_found_by_that_of_its_family(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "my/Toy-v0", gym.envs.registration.EnvSpec("my/Toy-v0", gym.spec(TOY).entry_point))
    find_hidden("HiddenGoal/my-Toy-v0")
    assert gym.registry["HiddenGoal/my-Toy-v0"].kwargs["env_id"].id == "my/Toy-v0"


def test_arguments_may_be_arrays() -> None:
    assert hide_goal(CHOICE, place=np.zeros(3)) == hide_goal(CHOICE, place=np.zeros(3))


@pytest.mark.parametrize(
    ("env_id", "sentence"),
    [
        ("gymnasium_robotics:FetchReach-v4", 'run `pip install "sb3_htr[robotics]"`'),
        ("panda_gym:PandaReach-v3", 'run `pip install "sb3_htr[panda]"`'),
        ("no_such_module:Env-v0", "no_such_module cannot be imported: run `pip install no_such_module`"),
        ("NoSuchEnv-v0", "or name the module that registers the env, as in 'module:NoSuchEnv-v0'"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, env_id: str, sentence: str) -> None:
    for name in EXTRAS.values():
        monkeypatch.setitem(sys.modules, name, None)
    for known in [known for known in gym.registry if known.startswith(("Fetch", "Panda"))]:
        monkeypatch.delitem(gym.registry, known)
    with pytest.raises(DependencyNotInstalled) as caught:
        hide_goal(env_id)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


def test_mujoco_that_is_too_new_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise AssertionError

    module: Any = types.ModuleType("gymnasium_robotics_of_the_test")
    module.Env = fail
    monkeypatch.setitem(sys.modules, module.__name__, module)
    spec = gym.envs.registration.EnvSpec("ToyFetch-v0", entry_point=f"{module.__name__}:Env")
    monkeypatch.setattr(goal_env_source, "version", lambda name: "3.12.1")
    with pytest.raises(
        DependencyNotInstalled, match=re.escape('3.12.1, it needs a version below 3.12: run `pip install "sb3')
    ):
        HiddenGoalFamily(spec)
    monkeypatch.setattr(goal_env_source, "version", lambda name: "3.11.0")
    with pytest.raises(AssertionError):
        HiddenGoalFamily(spec)


def test_importing_htr_envs_imports_none_of_the_packages() -> None:
    names = (*EXTRAS.values(), "mujoco", "pybullet")
    code = f"import sys, htr_envs; sys.exit(any(name in sys.modules for name in {names}))"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_lines_of_the_manual_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use, module = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL)
    (tmp_path / "my_envs.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    names: dict[str, Any] = {}
    exec(use, names)
    assert names["env"].spec.id == "HiddenGoal/MyReach-v0"
    assert isinstance(names["model"], PEARL)
    calls = re.findall(r"`([^`\n]*hide_goal\(\"MyReach[^`\n]*)`", PAGE.read_text())
    assert len(calls) == 2
    for call in calls:
        made = eval(call, {**names, "hide_goal": hide_goal})
        (gym.make(made) if isinstance(made, str) else made).reset()


# ---------------------------------------------------------------- with gymnasium-robotics, panda-gym and Meta-World


def of_extra(env_id: str, extra: str) -> Any:
    missing = importlib.util.find_spec(EXTRAS[extra]) is None
    skip = pytest.mark.skipif(missing, reason=f"{EXTRAS[extra]} is not installed: pip install 'sb3_htr[{extra}]'")
    return pytest.param(env_id, marks=[skip])


FETCH = [of_extra(f"HiddenFetch{name}-v0", "robotics") for name in ("Reach", "Push", "Slide", "PickAndPlace")]
MAZES = [of_extra(f"Hidden{name}-v0", "robotics") for name in ("PointMazeUMaze", "PointMazeMedium", "AntMazeUMaze")]
PANDA = [of_extra("HiddenPandaReach-v0", "panda")]
META_WORLD = [of_extra(f"HiddenMetaWorld{name}-v0", "metaworld") for name in ("Reach", "Push")]

all_suites = pytest.mark.parametrize("env_id", [*FETCH, *MAZES, *PANDA, *META_WORLD])
fetch_reach = pytest.mark.parametrize("env_id", FETCH[:1])


@all_suites
def test_check_task_env(env_id: str) -> None:
    """All for as long as an episode of Fetch is: what hides a goal does the same at each step."""
    check_task_env(make(env_id, max_episode_steps=50)[0])


@all_suites
def test_the_time_limit_is_the_goal_envs(env_id: str) -> None:
    env, base = make(env_id)
    family = base.task_family
    assert isinstance(family, HiddenGoalFamily) and env.spec is not None
    assert env.spec.max_episode_steps == family.source.spec.max_episode_steps


@all_suites
def test_seeded_episodes_are_the_same_bits_whatever_came_before(env_id: str) -> None:
    env, _ = make(env_id)
    actions = actions_of(env, 40)
    first = play(env, actions, seed=4)
    play(env, actions_of(env, 40, seed=1), seed=8)
    assert same(first, play(env, actions, seed=4))
    assert same(first, play(make(env_id)[0], actions, seed=4))


@all_suites
def test_nothing_tells_the_hidden_goal_of_a_suite(env_id: str) -> None:
    env, base = make(env_id)
    actions = actions_of(env, 40)
    episodes = [play(env, actions, seed=2, options={"task": task})[0] for task in (base.test_tasks[0], base.train_tasks[1])]
    assert np.array_equal(*episodes)


@all_suites
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"])
def test_a_copy_goes_on_alike(env_id: str, copied: Any) -> None:
    env, _ = make(env_id)
    actions = actions_of(env, 40)
    play(env, actions[:20], seed=0)
    twin = copied(env)
    for action in actions[20:]:
        first, second = env.step(action), twin.step(action)
        assert same(first[:4], second[:4])
        assert same(first[4].values(), second[4].values())
    assert same(play(env, actions[:5]), play(twin, actions[:5]))


@all_suites
def test_rewards_are_the_same_bits_for_any_batch_shape(env_id: str) -> None:
    env, base = make(env_id)
    observations, _ = play(env, actions_of(env, 30), seed=0)
    traj = Trajectory(observations[:-1], observations[:-1], observations[1:], np.zeros(30, dtype=np.float32))
    step = Trajectory(*(rows[[7]] for rows in traj))
    tasks = np.concatenate((base.train_tasks, observations[::7, -base.train_tasks.shape[1] :]))
    for reward_type in ("sparse", "dense"):
        together = base.compute_reward(traj, tasks, reward_type)
        assert np.array_equal(together, [base.compute_reward(traj, task, reward_type) for task in tasks])
        assert np.array_equal(together[:, 7], [base.compute_reward(step, task, reward_type)[0] for task in tasks])


@pytest.mark.parametrize("env_id", [FETCH[0], MAZES[0], PANDA[0]])
def test_processes_of_their_own_play_the_same(env_id: str) -> None:
    def episode(**kwargs: Any) -> list[Any]:
        venv = make_task_vec_env(env_id, 2, seed=3, **kwargs)
        parts: list[Any] = [venv.reset()]
        for seed in range(3):
            actions = np.random.default_rng(seed).uniform(-1, 1, (2, *(venv.action_space.shape or ())))
            parts += venv.step(actions.astype(np.float32))[:3]
        venv.close()
        return parts

    assert same(episode(), episode(vec_env_class=SubprocVecEnv))


@fetch_reach
def test_pictures_have_the_hidden_goal_and_change_nothing(env_id: str) -> None:
    skip_where_mujoco_cannot_draw()
    env, base = make(env_id, render_mode="rgb_array")
    env.reset()
    env.render()
    plain, actions, last = make(env_id)[0], actions_of(env, 10), []
    for task in base.test_tasks[:2]:
        expected, _ = play(plain, actions, seed=0, options={"task": task})
        env.reset(seed=0, options={"task": task})
        for action, observation in zip(actions, expected[1:], strict=True):
            assert np.array_equal(env.step(action)[0], observation)
            picture: Any = env.render()
        last.append(picture)
    assert last[0].dtype == np.uint8 and last[0].ndim == 3 and last[0].any()
    assert not np.array_equal(*last)
    env.close()


@fetch_reach
@pytest.mark.filterwarnings("ignore:No reward was found")
def test_pearl_learns_on_it_and_adapts(env_id: str) -> None:
    model = PEARL("MlpPolicy", env_id, **TINY)
    model.learn(400)
    assert model._n_updates >= 3
    tasks = make(env_id)[1].test_tasks[:3]
    returns, successes = evaluate_adaptation(model, env_id, tasks, n_episodes=2)
    assert returns.shape == successes.shape == (3, 2)


@pytest.mark.parametrize("env_id", META_WORLD)
def test_meta_world_calls_the_same_a_success(env_id: str) -> None:
    env = gym.make(env_id.removeprefix("Hidden"))
    assert env.unwrapped.render() is None
    n_solved = 0
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        for action in actions_of(env, 60, seed):
            way = 20.0 * (observation["desired_goal"] - observation["observation"][:3])
            observation, reward, _, _, info = env.step(np.append(np.clip(way, -1.0, 1.0), action[3]).astype(np.float32))
            assert reward == info["success"]
            n_solved += bool(reward)
    assert n_solved > 0 or "Push" in env_id


@pytest.mark.parametrize("env_id", META_WORLD[:1])
def test_other_tasks_of_meta_world_are_refused(env_id: str) -> None:
    with pytest.raises(ValueError, match="task is 'fly', expected one of"):
        gym.make(env_id.removeprefix("Hidden"), task="fly")
