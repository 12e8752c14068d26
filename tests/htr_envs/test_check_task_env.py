"""check_task_env passes a good env and names the broken promise of each bad one."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from helpers.broken_envs import BROKEN, LineEnv, LineFamily, NoDenseReward, column
from helpers.carts import CartEnv
from htr_envs import DynamicsEnv, DynamicsVectorEnv, PointRobotEnv, PointRobotFamily, PointRobotVectorEnv, check_task_env
from htr_envs.point_robot import PointRobotDynamics

# Annotations here are wide on purpose: most of these classes break the types that they should have.


def assert_refused(env: gym.Env[Any, Any], sentence: str) -> None:
    with pytest.raises(AssertionError) as caught:
        check_task_env(env)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- a good env


def test_a_good_env_passes_wrapped_or_not() -> None:
    check_task_env(LineEnv())
    check_task_env(TimeLimit(LineEnv(), 7))


def test_an_env_without_a_time_limit_is_refused_here_as_it_is_in_training() -> None:
    assert_refused(PointRobotEnv(), "The env has no time limit: register it with max_episode_steps")
    check_task_env(TimeLimit(PointRobotEnv(), 20))


def test_the_check_leaves_no_given_task_behind() -> None:
    env = LineEnv()
    check_task_env(env)
    assert len({env.reset()[1]["task_id"] for _ in range(40)} - {-1}) == 4


# ---------------------------------------------------------------- broken attributes and infos

WRITEABLE = np.ones((1, 1), dtype=np.float32)


def test_an_env_without_tasks() -> None:
    assert_refused(gym.make("CartPole-v1"), "The env has no `task_family`")
    assert_refused("SparsePointRobot-v0", "check_task_env takes one env: pass gymnasium.make(id)")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["compute_reward", "hindsight_task", "set_task", "test_tasks", "task_space"])
def test_an_env_without(name: str) -> None:
    assert_refused(type("Bare", (LineEnv,), {name: property()})(), f"The env has no `{name}`")


@pytest.mark.parametrize("name", ["sample_tasks", "compute_reward", "is_success", "hindsight_task"])
def test_a_family_without(name: str) -> None:
    assert_refused(LineEnv(type("Bare", (LineFamily,), {name: property()})()), f"The task family has no `{name}`")


@pytest.mark.parametrize("name", ["observation_space", "action_space"])
def test_spaces_of_another_type(name: str) -> None:
    env = LineEnv()
    setattr(env, name, spaces.Box(-1, 1, (1,), np.int64))
    assert_refused(env, f"The {name} must be a one-dimensional Box of floats")


def test_spaces_of_float64_are_fine() -> None:
    class Double(LineEnv):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = spaces.Box(-5.0, 5.0, (2,), np.float64)
            self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

        def observe(self) -> Any:
            return super().observe().astype(np.float64) / 3

    env = Double()
    assert env.reset()[0].dtype == env.step(env.action_space.sample())[0].dtype == np.float64
    check_task_env(env)


def test_an_observation_is_not_cut_to_whole_numbers() -> None:
    class Ticks(LineEnv):
        def __init__(self, n_digits: int) -> None:
            super().__init__()
            self.observation_space = spaces.Box(-50, 50, (2,), np.int64)
            self.n_digits = n_digits

        def observe(self) -> Any:
            return np.round(super().observe() * 10, self.n_digits)

    assert Ticks(0).reset()[0].dtype == np.int64, "floats that are whole numbers may be given"
    with pytest.raises(ValueError, match=r"The observation \[.*\] would be cut to int64, which the observation space is of"):
        Ticks(2).reset()


# ---------------------------------------------------------------- tasks that may change anything


def test_an_env_whose_tasks_change_anything() -> None:
    check_task_env(TimeLimit(CartEnv(), 10))


class OtherTasks(LineFamily):
    """Of each env."""

    def __init__(self) -> None:
        super().__init__()
        self.train_tasks = np.random.uniform(2.1, 3.0, (4, 1)).astype(np.float32)
        self._freeze()


class Backwards(PointRobotDynamics):
    def step(self, actions: Any) -> Any:
        return super().step(-actions)


class Entangled(PointRobotDynamics):
    """All are pushed as the last one: alone, a copy is as it should be."""

    def step(self, actions: Any) -> Any:
        return super().step(np.broadcast_to(actions[-1], actions.shape))


class NoisyBatch(DynamicsVectorEnv):
    """Whose noise is drawn in another order than that of single envs, or in one that nobody looks at."""

    def __init__(self, num_envs: int, max_episode_steps: int) -> None:
        super().__init__(PointRobotFamily(), PointRobotDynamics(num_envs), max_episode_steps)

    def step(self, actions: Any) -> Any:
        self.np_random.normal()
        return super().step(actions)


class Elsewhere(PointRobotDynamics):
    """By starts that are always the same; its actions are scaled."""

    def reset(self, indices: Any, rng: Any) -> Any:
        self.states[indices] = 0.5
        return self.states[indices]

    def step(self, actions: Any) -> Any:
        return super().step(actions / 2)


class Wide(PointRobotDynamics):
    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.observation_space = spaces.Box(-99.0, 99.0, (2,), np.float32)


class Strong(PointRobotDynamics):
    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.action_space = spaces.Box(-2.0, 2.0, (2,), np.float32)


class Ending(PointRobotDynamics):
    def step(self, actions: Any) -> Any:
        states, task_free_rewards, _ = super().step(actions)
        return states, task_free_rewards, np.abs(states).max(axis=-1) > 0.15


class Inverted(PointRobotVectorEnv):
    def step(self, actions: Any) -> Any:
        *step, infos = super().step(actions)
        return *step, {**infos, "is_success": ~infos["is_success"]}


class Silent(PointRobotVectorEnv):
    def step(self, actions: Any) -> Any:
        *step, infos = super().step(actions)
        return *step, {key: value for key, value in infos.items() if key != "achieved_task"}


def batch_of(dynamics: Any) -> Any:
    return lambda num_envs, max_episode_steps: DynamicsVectorEnv(PointRobotFamily(), dynamics(num_envs), max_episode_steps)


class NowhereAtFirst(PointRobotVectorEnv):
    def _reset_state(self, indices: Any) -> Any:
        return super()._reset_state(indices) * np.nan


BATCHES: dict[str, tuple[Any, str]] = {
    "nowhere at first": (NowhereAtFirst, "The batch of the id begins with an observation that is not finite"),
    "of its own": (PointRobotVectorEnv, ""),
    "backwards": (batch_of(Backwards), "The batch of the id gives another episode than the env itself"),
    "mixed up": (batch_of(Entangled), "The batch of the id gives another episode than the env itself"),
    "elsewhere": (batch_of(Elsewhere), "The batch of the id begins elsewhere than the env itself, and not by chance"),
    "of other bounds": (batch_of(Wide), "The batch of the id has another single_observation_space, Box(-99.0"),
    "of other actions": (batch_of(Strong), "The batch of the id has another single_action_space, Box(-2.0"),
    "that ends": (batch_of(Ending), "is True in place of False"),
    "cut short": (
        lambda num_envs, max_episode_steps: PointRobotVectorEnv(num_envs, 3),
        "truncated of step 3 is True in place",
    ),
    "endless": (lambda num_envs, max_episode_steps: PointRobotVectorEnv(num_envs, None), "truncated of step 20 is False in"),
    "upside down": (Inverted, "from the same start: is_success of step 1 is True in place of False"),
    "silent": (Silent, "achieved_task of step 1 is missing in place of"),
    "noisy": (NoisyBatch, ""),
    "with other tasks": (lambda **kwargs: PointRobotVectorEnv(**kwargs, task_seed=1), "Another env of the same id has other"),
    "that cannot be made": (
        lambda num_envs: None,
        'The batch of the id cannot be made. It raised TypeError("<lambda>() got an unexpected',
    ),
}


@pytest.mark.parametrize(("batch", "sentence"), BATCHES.values(), ids=BATCHES)
def test_the_batch_of_an_id_is_another_of_the_same_envs(batch: Any, sentence: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gym.registry["SparsePointRobot-v0"], "vector_entry_point", batch)
    env = gym.make("SparsePointRobot-v0", render_mode="rgb_array")
    if sentence:
        assert_refused(env, sentence)
    else:
        check_task_env(env)


def test_a_batch_whose_episodes_do_not_end_where_those_of_the_env_do(monkeypatch: pytest.MonkeyPatch) -> None:
    single: Any = lambda: DynamicsEnv(PointRobotFamily(), Ending(1))  # noqa: E731
    monkeypatch.setattr(gym.registry["SparsePointRobot-v0"], "entry_point", single)
    assert_refused(gym.make("SparsePointRobot-v0"), "is False in place of True")
    monkeypatch.setattr(gym.registry["SparsePointRobot-v0"], "vector_entry_point", batch_of(Ending))
    check_task_env(gym.make("SparsePointRobot-v0"))


def test_an_id_whose_envs_have_other_tasks_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    entry_point: Any = lambda: LineEnv(OtherTasks())  # noqa: E731
    spec = gym.envs.registration.EnvSpec("Other-v0", entry_point, max_episode_steps=10)
    monkeypatch.setitem(gym.registry, "Other-v0", spec)
    assert_refused(gym.make("Other-v0"), "Another env of the same id has other train_tasks")


def test_an_id_whose_envs_move_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """As those do that connect to one simulation."""
    dynamics = PointRobotDynamics(1)
    shared: Any = lambda: DynamicsEnv(PointRobotFamily(), dynamics)  # noqa: E731
    monkeypatch.setattr(gym.registry["SparsePointRobot-v0"], "entry_point", shared)
    assert_refused(gym.make("SparsePointRobot-v0"), "Envs of this id share a state: a step of one of them moves another")


class TellsItsTask(CartEnv):
    def first(self) -> float:
        return float(self.task[0])


class Noisy(CartEnv):
    def push(self, action: Any) -> float:
        return super().push(action) + float(self.noise.normal())


@pytest.mark.parametrize(
    ("env_class", "sentence"),
    [
        (TellsItsTask, "The task leaks into the first observation"),
        (Noisy, "The same seed, task and actions gave another episode"),
    ],
)
def test_an_env_whose_tasks_change_what_they_must_not(env_class: type[CartEnv], sentence: str) -> None:
    assert_refused(env_class(), sentence)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("task_space", spaces.Discrete(3), "The task space must be a one-dimensional Box"),
        ("train_tasks", np.ones((2, 1)), "train_tasks must be a float32 array"),
        (
            "train_tasks",
            np.ones((0, 1), dtype=np.float32),
            "train_tasks must be a float32 array (n, 1) of at least one task, and is a",
        ),
        ("train_tasks", np.ones((2, 2), dtype=np.float32), "train_tasks must be a float32 array"),
        ("train_tasks", WRITEABLE, "train_tasks can be written to"),
        ("test_tasks", column(99.0), "test_tasks has a task that is not in the task space"),
        ("train_tasks", column(1.0, 0.5, 1.0), "train_tasks holds a task twice: the tasks of a set must differ"),
        ("test_tasks", column(-1.0), "test_tasks shares a task with another set"),
        ("validation_tasks", column(2.0), "validation_tasks shares a task with another set"),
        ("helper", lambda: None, "The task family cannot be pickled. It raised"),
    ],
)
def test_broken_attributes_of_the_family(name: str, value: Any, sentence: str) -> None:
    env = LineEnv()
    setattr(env.task_family, name, value)
    assert_refused(env, sentence)


class ChangedInfo(LineEnv):
    """Replaces one entry of the info, or takes it away."""

    def __init__(self, key: str, value: Any) -> None:
        super().__init__()
        self.key, self.value = key, value

    def alter(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
        info[self.key] = self.value
        if self.value is None:
            del info[self.key]
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("task_id", None, "The info of step lacks `task_id`"),
        ("is_success", None, "The info of step lacks `is_success`"),
        ("achieved_task", None, "The info of step lacks `achieved_task`"),
        ("task_free_reward", None, "The info of step lacks `task_free_reward`"),
        ("task_id", np.int64(0), "info['task_id'] is a int64, it must be a int"),
        ("is_success", np.bool_(False), "it must be a bool"),
        ("is_success", 0, "info['is_success'] is a int, it must be a bool"),
        ("task_free_reward", np.float32(0.0), "info['task_free_reward'] is a float32, it must be a float"),
        ("task_free_reward", float("nan"), "info['task_free_reward'] is not finite"),
        ("achieved_task", [0.0], "info['achieved_task'] is a list, it must be a ndarray"),
        (
            "achieved_task",
            np.zeros(1),
            "info['achieved_task'][None], of hindsight_task, must be a float32 array (n, 1) of at least one task, and",
        ),
        (
            "achieved_task",
            np.array([9.0], dtype=np.float32),
            "info['achieved_task'][None], of hindsight_task, has a task that is not in",
        ),
        ("achieved_task", np.zeros(1, dtype=np.float32), "info['achieved_task'] is the same memory at each step"),
        ("is_success", True, "is_success does not give the info['is_success'] that step gave"),
        ("task_id", 99, "The task changed within an episode"),
    ],
)
def test_broken_infos(key: str, value: Any, sentence: str) -> None:
    assert_refused(ChangedInfo(key, value), sentence)


# ---------------------------------------------------------------- broken behaviour


def test_a_family_needs_no_dense_proxy() -> None:
    check_task_env(LineEnv(NoDenseReward()))


@pytest.mark.parametrize(("broken", "sentence"), BROKEN)
def test_a_broken_promise_is_named(broken: Any, sentence: str) -> None:
    assert_refused(broken() if issubclass(broken, LineEnv) else LineEnv(broken()), sentence)


# ---------------------------------------------------------------- mistakes of whoever writes a family


@pytest.mark.parametrize(
    ("space", "train_tasks", "sentence"),
    [
        (spaces.Box(-3, 3, (1,)), [[0.0, 1.0]], r"train_tasks has shape \(1, 2\), expected \(n, 1\)"),
        (spaces.Box(-3, 3, (1,)), [[np.nan]], "train_tasks has NaN or infinity"),
        (spaces.Box(-3, 3, (1,)), [["a"]], "train_tasks is no array of numbers"),
        (spaces.Box(-3, 3, (1,)), [[0.0], [1.0, 2.0]], "train_tasks is no array of numbers"),
        (spaces.Box(-3, 3, (1,)), [[4.0]], "train_tasks holds a task that is not in Box"),
        (spaces.Box(-3, 3, ()), [[0.0]], r"task_space is Box\(.*\), expected a Box of one axis"),
        (spaces.Discrete(3), [[0.0]], r"task_space is Discrete\(3\), expected a Box of one axis"),
        ([-3, 3], [[0.0]], r"task_space is \[-3, 3\], expected a Box of one axis"),
    ],
)
def test_tasks_that_are_none_are_named(space: Any, train_tasks: Any, sentence: str) -> None:
    class Family(LineFamily):
        def __init__(self) -> None:
            super(LineFamily, self).__init__(space, train_tasks, [[1.5]], [[-1.5]])

    with pytest.raises(ValueError, match=sentence):
        Family()


def test_a_task_on_the_bound_of_a_space_of_float64_is_in_it() -> None:
    """Though it is float32, which rounds .1 up."""

    class Family(LineFamily):
        def __init__(self) -> None:
            super(LineFamily, self).__init__(spaces.Box(-0.1, 0.1, (1,), np.float64), [[-0.1], [0.1]], [[0.05]], [[-0.05]])

    assert Family().task_vectors([0.1], (1,)) == np.float32(0.1)


def test_hooks_that_return_nothing_are_named() -> None:
    class NoReturn(LineEnv):
        def _step_state(self, action: Any) -> Any:
            super()._step_state(action)

    env = NoReturn()
    env.reset()
    with pytest.raises(ValueError, match=r"_step_state must return .* got a NoneType"):
        env.step(env.action_space.sample())


@pytest.mark.parametrize(
    ("states", "what"), [(None, "nothing"), (np.zeros((1, 2), dtype=np.float32), r"shape \(1, 2\)")], ids=["none", "one row"]
)
def test_a_batch_that_begins_with_other_observations_is_named(states: Any, what: str) -> None:
    class OtherStarts(PointRobotVectorEnv):
        def _reset_state(self, indices: Any) -> Any:
            return states

    with pytest.raises(ValueError, match=f"_reset_state returned {what}, expected \\(3, 2\\)"):
        OtherStarts(3).reset()


def test_a_batch_whose_step_returns_nothing_is_named() -> None:
    class NoReturn(PointRobotVectorEnv):
        def _step_state(self, actions: Any) -> Any:
            super()._step_state(actions)

    env = NoReturn(3)
    env.reset()
    with pytest.raises(ValueError, match=r"_step_state returns observations, .* got a NoneType"):
        env.step(env.action_space.sample())
