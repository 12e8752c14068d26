"""Meta-test: the known mistakes of PEARL implementations, and agents adapted to one task."""

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from helpers import ENV_ID, PRIOR, ROLLOUT, MakePEARL
from helpers.adaptations import know_tasks
from helpers.broken_envs import LineEnv
from htr_envs import DynamicsVectorEnv, PointRobotFamily
from htr_envs.point_robot import PointRobotDynamics
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation import Adaptation, Belief, Prior, Step, evaluation
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.checkpoint_callback import CheckpointCallback
from sb3_htr.common.random_state import get_env_states
from sb3_htr.common.vec_env import BatchedTaskVecEnv, make_task_vec_env, reset_to_tasks
from sb3_htr.rivals.scripted import ScriptedAgent


def test_evaluations_and_trainings_of_consecutive_seeds_share_no_env(monkeypatch: pytest.MonkeyPatch) -> None:
    """Envs that a user made, too."""
    starts: list[np.ndarray] = []

    def remembered(env: VecEnv, tasks: np.ndarray) -> np.ndarray:
        starts.append(obs := reset_to_tasks(env, tasks))
        return obs

    monkeypatch.setattr(evaluation, "reset_to_tasks", remembered)
    env = DummyVecEnv([lambda: gym.make("SparseWheeled-v0")] * 4)
    agent = ScriptedAgent(env.action_space)
    tasks = env.get_attr("task_family")[0].test_tasks[:4]
    for seed in (1, 2):
        evaluate_adaptation(agent, env, tasks, n_episodes=1, seed=seed)
    for seed in (1, 2):
        PEARL("MlpPolicy", env, seed=seed)
        starts.append(env.reset())  # type: ignore[arg-type]
    for first, second in (starts[:2], starts[2:]):
        assert len(np.unique(np.concatenate([first, second]), axis=0)) == 8


def test_rounding_is_no_reward() -> None:
    """An env may tell what is task-free more precisely than a reward can be."""
    free = -1000.1
    nothing, rounded = np.zeros((1, 2)), np.array([free], dtype=np.float32)
    step = Step(nothing, nothing, rounded, nothing, np.zeros(1), [{"task_free_reward": free}])
    assert Adaptation._told(step) == 0
    assert Adaptation._told(step._replace(rewards=np.array([free]))) == 0


@pytest.mark.parametrize("explorer", ["prior", "aggregate", "belief", "learned-prior"])
def test_meta_evaluation_works_before_any_training(tiny_pearl: MakePEARL, explorer: str) -> None:
    returns, successes = evaluate_adaptation(tiny_pearl(), ENV_ID, n_episodes=3, explorer=explorer)
    assert returns.shape == successes.shape == (100, 3)
    assert ((returns > 0) == successes).all()


def test_an_explorer_may_be_a_name_a_name_with_settings_or_an_object(tiny_pearl: MakePEARL) -> None:
    """Wherever one is asked for, and with the same result."""
    task = PointRobotFamily().test_tasks[:2]
    given: list[Any] = [Prior(2), {"name": "prior", "n_exploration_episodes": 2}]
    results = [evaluate_adaptation(tiny_pearl(explorer=explorer), ENV_ID, task, 3)[0] for explorer in given]
    results += [evaluate_adaptation(tiny_pearl(), ENV_ID, task, 3, explorer=explorer)[0] for explorer in given]
    for returns in results[1:]:
        np.testing.assert_array_equal(returns, results[0])
    model = tiny_pearl(explorer=Belief(margin=2.0), train_explorer={"name": "prior", "n_exploration_episodes": 3})
    assert model.explorer == Belief(margin=2.0) and model.train_explorer == Prior(3)
    env = gym.make(ENV_ID, goal_distance=5.0)
    with pytest.warns(UserWarning, match="No reward"):
        agents = [model.adapt(env, 1, task[0] * 9, explorer=explorer) for explorer in given]
    np.testing.assert_array_equal(agents[0].z, agents[1].z)


def test_the_number_of_envs_does_not_matter(tiny_pearl: MakePEARL) -> None:
    """Tasks are adapted to side by side or one after the other; while nothing is found, the result is the same."""
    model = tiny_pearl().learn(2 * ROLLOUT)
    know_tasks(model)
    tasks = PointRobotFamily().test_tasks[:5]
    results = [record_adaptation(model, make_task_vec_env(ENV_ID, n), tasks, n_episodes=3) for n in (1, 2, 5)]
    for result in results[1:]:
        found = results[0].successes.any(axis=1) | result.successes.any(axis=1)
        assert not found.all()
        np.testing.assert_allclose(result.returns[~found], results[0].returns[~found])
        np.testing.assert_allclose(result.achieved[~found], results[0].achieved[~found], atol=1e-5)


def test_context_comes_from_the_adaptation_alone(tiny_pearl: MakePEARL) -> None:
    """garage took it from the replay buffer: whatever is stored there must change nothing."""
    model = tiny_pearl(explorer=PRIOR).learn(2 * ROLLOUT)
    before = evaluate_adaptation(model, ENV_ID, "validation", n_episodes=4)
    assert model.replay_buffer is not None
    model.replay_buffer.episodes.rows[:] = 1e3
    after = evaluate_adaptation(model, ENV_ID, "validation", n_episodes=4)
    model.replay_buffer = None
    without = evaluate_adaptation(model, ENV_ID, "validation", n_episodes=4)
    for result in (after, without):
        for x, y in zip(before, result, strict=True):
            np.testing.assert_array_equal(x, y)


def test_tasks_do_not_share_context(tiny_pearl: MakePEARL) -> None:
    """A task's adaptation is the same whichever tasks are adapted to beside it."""
    model = tiny_pearl(explorer=PRIOR)
    tasks = PointRobotFamily().test_tasks[:3].copy()
    before = record_adaptation(model, ENV_ID, tasks, n_episodes=4)
    tasks[1:] = [[9.0, 9.0], [0.0, 0.1]]
    after = record_adaptation(model, ENV_ID, tasks, n_episodes=4)
    np.testing.assert_array_equal(before.achieved[0], after.achieved[0])
    assert (before.achieved[2] != after.achieved[2]).any(), "a rewarded task must lead elsewhere"


def test_no_test_task_enters_the_replay_buffer(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    assert model.replay_buffer is not None
    size = model.replay_buffer.size()
    evaluate_adaptation(model, ENV_ID, n_episodes=2)
    assert model.replay_buffer.size() == size
    family = model.replay_buffer.task_family
    train = {tuple(task) for task in family.train_tasks}
    assert not train & {tuple(task) for task in (*family.test_tasks, *family.validation_tasks)}
    # Had an env been given a test task, the buffer would refuse its steps
    env = gym.make(ENV_ID)
    _, info = env.reset(options={"task": family.test_tasks[0]})
    with pytest.raises(ValueError, match="only training tasks"):
        step = np.zeros((4, 2), dtype=np.float32)
        model.replay_buffer.add(step, step, step, np.zeros(4), np.zeros(4, bool), [info] * 4)


def test_achieved_tasks_are_the_path(tiny_pearl: MakePEARL) -> None:
    record = record_adaptation(tiny_pearl(), ENV_ID, n_episodes=2)
    assert record.achieved.shape == (100, 2, 20, 2) and np.isfinite(record.achieved).all()
    steps = np.abs(np.diff(record.achieved, axis=2))
    assert steps.max() <= 0.1 + 1e-6


def test_of_tasks_of_one_dimension_the_achieved_one_may_be_a_number(tiny_pearl: MakePEARL) -> None:
    """Training takes it, and then an evaluation must."""

    class Number(LineEnv):
        def alter(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
            return observation, reward, terminated, truncated, {**info, "achieved_task": float(info["achieved_task"][0])}

    records = []
    for kind in (LineEnv, Number):
        env = DummyVecEnv([kind] * 2)
        records.append(record_adaptation(tiny_pearl(env, n_tasks_per_rollout=2).learn(60), env, n_episodes=2))
    assert records[0].achieved.shape == (2, 2, 10, 1)
    np.testing.assert_array_equal(records[0].achieved, records[1].achieved)


# --- adapt()


def test_adapt_gives_an_agent_for_the_task_of_the_env(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(2 * ROLLOUT)
    env = gym.make(ENV_ID)
    env.reset(seed=0, options={"task": np.array([0.05, 0.05], dtype=np.float32)})  # the start solves it
    agent = model.adapt(env, n_episodes=3)
    assert agent.returns.shape == (3,) and agent.successes.all()
    mean, _ = evaluate_policy(agent, env, n_eval_episodes=2, warn=False)
    assert isinstance(mean, float) and mean > 0
    assert env.unwrapped.task_id == -1  # type: ignore[attr-defined]
    obs, _ = env.reset()
    action, state = agent.predict(obs, deterministic=True)
    assert action.shape == (2,) and state is None


class Plain(gym.Env[np.ndarray, np.ndarray]):
    """The real robot: spaces, steps and a reward that depends on a goal which nothing tells; infos are empty."""

    def __init__(self, goal: np.ndarray) -> None:
        self._robot = gym.make(ENV_ID)
        self._goal = {"task": goal}
        self.observation_space, self.action_space = self._robot.observation_space, self._robot.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        assert not options, "it knows of no options"
        return self._robot.reset(seed=seed, options=self._goal)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = self._robot.step(action)
        return obs, float(reward), terminated, truncated, {}


@pytest.mark.parametrize("explorer", ["belief", "aggregate", "prior", "learned-prior"])
def test_a_plain_env_without_task_family_and_infos_is_adapted_to_as_well(tiny_pearl: MakePEARL, explorer: str) -> None:
    model = tiny_pearl(make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3})).learn(4 * ROLLOUT)
    goal = np.array([0.05, 0.05], dtype=np.float32)
    ours, theirs = model.adapt(Plain(goal), 4, explorer=explorer), model.adapt(ENV_ID, 4, goal, explorer=explorer)
    np.testing.assert_array_equal(ours.z, theirs.z)
    np.testing.assert_array_equal(ours.returns, theirs.returns)
    assert ours.returns.max() > 0
    np.testing.assert_array_equal(ours.successes, ours.returns > 0)
    with pytest.raises(ValueError, match="no task family, so it takes no task"):
        model.adapt(Plain(goal), task=3)


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_an_id_of_an_env_without_tasks_will_do(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    made_by: Any = Plain
    spec = gym.envs.registration.EnvSpec("Plain-v0", made_by, kwargs={"goal": np.array([9.0, 9.0], dtype=np.float32)})
    monkeypatch.setitem(gym.registry, "Plain-v0", spec)
    assert not tiny_pearl().adapt("Plain-v0", 2).successes.any()


class SaysOne(Plain):
    """Many a GoalEnv has numbers as ``is_success``."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, {"is_success": 1.0}


def test_a_success_may_be_a_number(tiny_pearl: MakePEARL) -> None:
    with pytest.warns(UserWarning, match="No reward was found"):
        assert tiny_pearl().adapt(SaysOne(np.array([9.0, 9.0], dtype=np.float32)), 2).successes.all()


def test_adapt_says_when_nothing_was_found(tiny_pearl: MakePEARL) -> None:
    with pytest.warns(UserWarning, match="No reward was found in 2 episodes"):
        agent = tiny_pearl().adapt(ENV_ID, n_episodes=2, task=np.array([9.0, 9.0]))
    assert not agent.successes.any()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_returns_of_an_agent_are_all_that_it_was_paid(tiny_pearl: MakePEARL) -> None:
    """Not what was more than the task-free reward."""
    paid = gym.wrappers.TransformReward(gym.make(ENV_ID), lambda reward: float(reward) + 1.0)
    agent = tiny_pearl().adapt(paid, n_episodes=3, task=np.array([9.0, 9.0]))
    assert agent.returns.tolist() == [20.0] * 3


def test_adapt_keeps_one_task_when_the_env_has_none(tiny_pearl: MakePEARL) -> None:
    env = gym.make(ENV_ID, goal_distance=5.0)  # out of reach, so that no untrained policy finds it by chance
    with pytest.warns(UserWarning, match="No reward"):
        tiny_pearl().adapt(env, n_episodes=1)
    tasks = {tuple(env.reset()[0]) and tuple(env.unwrapped.task) for _ in range(5)}  # type: ignore[attr-defined]
    assert len(tasks) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.adapt(ENV_ID, n_episodes=0), "n_episodes is 0, expected a whole number of at least 1"),
        (lambda m: m.adapt(make_task_vec_env(ENV_ID, 2)), "the VecEnv has 2 envs"),
        (lambda m: m.adapt(ENV_ID), "Which task of SparsePointRobot-v0 the agent is for, nobody would know: pass task"),
        (lambda m: m.adapt(ENV_ID, task=0, explorer="x"), "explorer is 'x', expected one of"),
        (lambda m: m.adapt(ENV_ID, task=0, explorer={"name": "prior", "scale": 1}), "explorer 'prior' has no setting 'scale'"),
        (lambda m: evaluate_adaptation(m, gym.make_vec(ENV_ID, 2)), "VectorEnv"),  # type: ignore[arg-type]
        (lambda m: evaluate_adaptation(m, None), "There is no env: pass one"),  # type: ignore[arg-type]
        (lambda m: MetaEvalCallback(gym.make_vec(ENV_ID, 2)), "VectorEnv"),  # type: ignore[arg-type]
        (lambda m: evaluate_adaptation(m, ENV_ID, explorer=3), "explorer is 3, expected one of"),  # type: ignore[arg-type]
        (lambda m: evaluate_adaptation(m, ENV_ID, n_episodes=0), "n_episodes is 0"),
        (lambda m: evaluate_adaptation(m, ENV_ID, np.zeros((0, 2))), "at least one task"),
        (lambda m: evaluate_adaptation(m, ENV_ID, np.zeros(2)), r"expected \(n_tasks, task_dim\)"),
    ],
)
def test_bad_requests(tiny_pearl: MakePEARL, call: Callable[[PEARL], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(tiny_pearl())


def test_sampled_actions_leave_the_random_state_of_training_alone(tiny_pearl: MakePEARL) -> None:
    model, paths, tasks = tiny_pearl().learn(240), [], PointRobotFamily().test_tasks[:20]
    for seed, deterministic in ((3, False), (3, False), (3, True), (4, True)):
        before = th.get_rng_state()
        record = record_adaptation(model, ENV_ID, tasks, 2, explorer="prior", deterministic=deterministic, seed=seed)
        paths.append(record.achieved)
        assert (th.get_rng_state() == before).all()
        th.randn(3)
    assert (paths[0] == paths[1]).all()
    for one, other in pairwise(paths[1:]):
        assert (one != other).any(axis=(1, 2, 3)).all()


@pytest.mark.parametrize("batched", [True, False])
def test_an_evaluation_in_the_env_of_training_leaves_its_random_state_alone(tiny_pearl: MakePEARL, batched: bool) -> None:
    """Else all runs that are evaluated by the same seed would draw the same from there on."""
    env = make_task_vec_env(ENV_ID, 4, vec_env_class=None if batched else DummyVecEnv)
    model = tiny_pearl(env).learn(ROLLOUT)
    before = get_env_states(env)
    assert len({*before}) == (1 if batched else 4)
    evaluate_adaptation(model, env, "validation", n_episodes=1)
    assert get_env_states(env) == before


class OldGenerator(gym.Wrapper[Any, Any, Any, Any]):
    """Draws by numpy's generator of before."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        returned = self.env.reset(seed=seed or 0, options=options)  # which has it draw its task by a new one
        self.unwrapped.np_random = np.random.RandomState(seed)  # type: ignore[assignment]
        return returned


def test_envs_whose_generator_is_an_old_one_are_evaluated_in_as_well(tiny_pearl: MakePEARL) -> None:
    model, env, tasks = tiny_pearl(), make_task_vec_env(ENV_ID, 2, wrapper=OldGenerator), PointRobotFamily().test_tasks[:2]
    env.reset()
    ours, theirs = (evaluate_adaptation(model, each, tasks, n_episodes=2) for each in (env, make_task_vec_env(ENV_ID, 2)))
    np.testing.assert_array_equal(ours, theirs)


def test_a_training_in_them_that_could_not_go_on_is_refused_at_once(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(make_task_vec_env(ENV_ID, 2, wrapper=OldGenerator))
    with pytest.raises(ValueError, match=r"np_random is a RandomState, expected numpy's Generator, .*: leave it to gymnasium"):
        model.learn(ROLLOUT, CheckpointCallback(1, str(tmp_path)))
    assert model.num_timesteps == 0


class Dying(gym.Wrapper[Any, Any, Any, Any]):
    """Its process ends in its first step."""

    def step(self, action: Any) -> Any:
        os._exit(1)


def test_the_error_of_a_dead_env_process_is_told_as_it_is(tiny_pearl: MakePEARL) -> None:
    """And not that of putting its random state back."""
    env = make_task_vec_env(ENV_ID, 2, wrapper=Dying, vec_env_class=SubprocVecEnv)
    with pytest.raises(EOFError):
        evaluate_adaptation(tiny_pearl(), env, n_episodes=1)


def test_no_two_evaluations_share_noise(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tasks at once: the third and fourth of a seed, and the first two of a later one."""
    model, env = tiny_pearl(), make_task_vec_env(ENV_ID, 2)
    act, noise = model.policy.act, list[float]()

    def noting(*args: Any) -> np.ndarray:
        noise.append(float(th.rand(())))
        return act(*args)

    monkeypatch.setattr(model.policy, "act", noting)
    for seed in (0, 2):
        record_adaptation(model, env, PointRobotFamily().test_tasks[:4], n_episodes=1, deterministic=False, seed=seed)
    assert len(set(noise)) == len(noise) == 80


def test_tasks_have_the_same_episodes_by_name_and_as_an_array(tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_pearl()
    made: list[int] = []

    def make(env_id: str, n_envs: int = 1, seed: int | None = None) -> VecEnv:
        made.append(n_envs)
        return make_task_vec_env(env_id, n_envs, seed)

    monkeypatch.setattr(evaluation, "make_task_vec_env", make)
    tasks = PointRobotFamily().test_tasks
    by_name, as_array = (evaluate_adaptation(model, ENV_ID, x, n_episodes=2)[0] for x in ("test", tasks))
    np.testing.assert_array_equal(by_name, as_array)
    evaluate_adaptation(model, ENV_ID, tasks[:3], n_episodes=1)
    assert max(made) == 20 and made[-1] == 3, "neither 100 envs for as many tasks, nor 20 for three"


def test_tasks_of_a_later_batch_have_noise_of_their_own(tiny_pearl: MakePEARL) -> None:
    tasks = np.full((4, 2), 9.0, dtype=np.float32)
    record = record_adaptation(tiny_pearl(), make_task_vec_env(ENV_ID, 2), tasks, n_episodes=1, explorer=PRIOR)
    assert len(np.unique(record.achieved[:, 0, -1], axis=0)) == 4


class Scattered(PointRobotDynamics):
    """Point robots that begin anywhere near."""

    def reset(self, indices: Any, rng: np.random.Generator) -> Any:
        self.states[indices] = rng.uniform(-0.5, 0.5, (len(indices), 2))
        return self.states[indices]


def test_an_evaluation_of_a_seed_has_the_same_starts_whatever_was_played_before(tiny_pearl: MakePEARL) -> None:
    model, paths = tiny_pearl(), []
    for own, seed in ((5, 0), (6, 0), (6, 1)):
        env = BatchedTaskVecEnv(DynamicsVectorEnv(PointRobotFamily(), Scattered(4), max_episode_steps=20))
        env.seed(own)
        paths.append(record_adaptation(model, env, PointRobotFamily().test_tasks[:4], n_episodes=1, seed=seed).achieved)
    np.testing.assert_array_equal(paths[0], paths[1])
    assert (paths[0][:, 0, 0] != paths[2][:, 0, 0]).all()
