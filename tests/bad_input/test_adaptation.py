"""What cannot be adapted to, acted on or evaluated is refused in one sentence, and a robot need not be a task env."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from helpers import ENV_ID, ROLLOUT, MakePEARL
from helpers.envs import Robot, wrapped
from htr_envs import PointRobotFamily
from sb3_htr import PEARL, AdaptedAgent, evaluate_adaptation
from sb3_htr.adaptation import Step
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.adaptation.evaluation import task_set
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.scripted import ScriptedAgent


def test_a_robot_need_not_know_the_bounds_and_types_of_its_spaces(tiny_pearl: MakePEARL) -> None:
    assert tiny_pearl().adapt(Robot(20), n_episodes=2).returns.tolist() == [1.0, 0.0]


def test_robots_without_end_are_given_up_whatever_was_loaded_with_the_model(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    trained = tiny_pearl()
    trained.save(tmp_path / "model")
    for model in (trained, PEARL.load(tmp_path / "model")):
        robot = Robot(10**9)
        with pytest.raises(ValueError, match="An episode goes on after 200 steps, 10 times what those of training had"):
            model.adapt(robot, n_episodes=1)
        assert robot.n_steps == 201


def test_a_model_that_does_not_adapt_is_refused_by_the_callback_as_by_the_function() -> None:
    with pytest.raises(ValueError, match="SAC does not adapt: pass the model of meta-training"):
        SAC("MlpPolicy", ENV_ID).learn(8, MetaEvalCallback(ENV_ID))


def test_an_episode_is_as_long_as_the_limit_of_its_env_says(tiny_pearl: MakePEARL) -> None:
    """Though it be longer than those of training ever were."""
    assert len(tiny_pearl().adapt(gym.make(ENV_ID, max_episode_steps=250), n_episodes=1).returns) == 1


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ((np.zeros(3, dtype=np.float32), 0.0), "observations must have the shape of its observation_space"),
        ((np.zeros(2, dtype=np.float32), np.zeros(2)), "an env's reward must be a number"),
        ((np.zeros(2, dtype=np.float32),), "an env's step must return observation, reward, terminated, truncated and info"),
    ],
)
def test_a_robot_that_returns_something_else(returned: Any, message: str, tiny_pearl: MakePEARL) -> None:
    robot = Robot(20)
    robot.step = lambda action: (*returned, False, False, {})  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=message):
        tiny_pearl().adapt(robot)


def test_a_robot_without_infos(tiny_pearl: MakePEARL) -> None:
    robot = Robot(20)
    robot.step = lambda action: (np.zeros(2, dtype=np.float32), 0.0, False, False, None)  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="an env's step must return observation, reward, terminated, truncated and info"):
        tiny_pearl().adapt(robot)


@pytest.mark.parametrize(
    "reset",
    [
        lambda **_: np.zeros(2, dtype=np.float32),
        lambda **_: np.zeros(3, dtype=np.float32),
        lambda: np.zeros(2, dtype=np.float32),
    ],
)
def test_a_robot_of_the_old_gym(reset: Any, tiny_pearl: MakePEARL) -> None:
    robot = Robot(20)
    robot.reset = reset  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="an env's reset must take seed and options, and return observation and info"):
        tiny_pearl().adapt(robot)


def test_what_a_wrapper_complains_of_is_said_as_it_is(tiny_pearl: MakePEARL) -> None:
    class Careful(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            raise ValueError("joint 3 is beyond its limit")

    with pytest.raises(ValueError, match=r"^joint 3 is beyond its limit$"):
        tiny_pearl().adapt(Careful(DummyVecEnv([lambda: Robot(20)])))


def test_only_the_envs_of_a_model_can_be_adapted_to(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    for other in ("CartPole-v1", "SparseTargetSpeed-v0"):
        with pytest.raises(ValueError, match=r"spaces do not match.*Wrap the env"):
            model.adapt(gym.make(other))
    goal_env = gym.make(ENV_ID)
    goal_env.observation_space = spaces.Dict(observation=spaces.Box(-1, 1, (2,)))
    with pytest.raises(ValueError, match=r"spaces do not match.*htr_envs.HiddenGoalWrapper"):
        model.adapt(goal_env)
    for agent in (model, RL2("MlpLstmPolicy", ENV_ID), ScriptedAgent(spaces.Box(-2, 2, (2,)))):
        other = ENV_ID if isinstance(agent, ScriptedAgent) else "SparseTargetSpeed-v0"
        with pytest.raises(ValueError, match="spaces do not match"):
            evaluate_adaptation(agent, other, n_episodes=1)
    with pytest.raises(ValueError, match=r"Discrete\(2\), expected a Box"):
        ScriptedAgent(spaces.Discrete(2))


@pytest.mark.parametrize("explorer", ["belief", "prior", "aggregate", "learned-prior"])
def test_nan_at_meta_test_is_refused(explorer: str, tiny_pearl: MakePEARL) -> None:
    """It would become NaN actions, or evidence."""
    model = tiny_pearl().learn(ROLLOUT)

    class Fails(gym.Wrapper[Any, Any, Any, Any]):
        what = ""

        def step(self, action: Any) -> Any:
            obs, reward, *rest = self.env.step(action)
            return (obs, np.nan, *rest) if self.what == "rewards" else (obs * np.nan, reward, *rest)

    for what in ("rewards", "observations"):
        env = Fails(gym.make(ENV_ID))
        env.what = what
        with pytest.raises(ValueError, match=rf"The (next_)?{what} of env 0 are .*nan.* expected finite numbers"):
            model.adapt(env, n_episodes=2, explorer=explorer)


@pytest.mark.filterwarnings("error")
def test_numbers_of_a_sensor_may_be_halves(tiny_pearl: MakePEARL) -> None:
    adaptation = tiny_pearl().start_adaptation(1)
    adaptation.act(np.array([[1.0, 0.0]], dtype=np.float16))
    with pytest.raises(ValueError, match=r"The observations of env 0 are \[inf  0\.\], expected finite numbers"):
        adaptation.act(np.array([[np.inf, 0.0]], dtype=np.float16))


@pytest.mark.parametrize("shape", [(2, 1), (2, 3), (2,)])
def test_observations_of_another_shape_are_refused_at_meta_test(tiny_pearl: MakePEARL, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"observations have shape {re.escape(str(shape))}, expected \(2, 2\), a row"):
        tiny_pearl().start_adaptation(2).act(np.zeros(shape, dtype=np.float32))


def test_lists_are_observations_too(tiny_pearl: MakePEARL) -> None:
    adaptation = tiny_pearl().learn(2 * ROLLOUT).start_adaptation(1, generator=th.Generator().manual_seed(0))
    assert adaptation.act([[0.0, 0.0]]).shape == (1, 2)  # type: ignore[arg-type]


def test_observations_come_without_infos(tiny_pearl: MakePEARL) -> None:
    with pytest.raises(ValueError, match=r"You have passed a tuple to the predict\(\) function"):
        tiny_pearl().predict(gym.make(ENV_ID).reset())  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_an_observation_that_is_a_tuple_is_acted_on_by_the_same_z(tiny_pearl: MakePEARL) -> None:
    agent = tiny_pearl().adapt(Robot(20), n_episodes=1)
    for obs in ([0.5, -0.5], [[0.5, -0.5], [0.1, 0.2]]):
        expected, _ = agent.predict(np.array(obs), deterministic=True)
        actions, _ = agent.predict(tuple(obs), deterministic=True)  # type: ignore[arg-type]
        np.testing.assert_array_equal(actions, expected)


def test_no_action_follows_from_nothing(tiny_pearl: MakePEARL) -> None:
    agent = tiny_pearl().adapt(Robot(20), n_episodes=1)
    with pytest.raises(ValueError, match=r"The observation is \[nan  0\.\], expected finite numbers"):
        agent.predict(np.array([np.nan, 0.0]))


def test_each_env_says_whether_its_episode_ended(tiny_pearl: MakePEARL) -> None:
    zeros = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"dones have shape \(1,\), expected \(3,\), a row for each env"):
        tiny_pearl().start_adaptation(3).observe(Step(zeros, zeros, np.zeros(3), zeros, np.ones(1, dtype=bool)))


def test_actions_in_units_of_the_robot_are_refused(tiny_pearl: MakePEARL) -> None:
    adaptation, obs, done = tiny_pearl().start_adaptation(2), np.zeros((2, 2)), np.zeros(2, dtype=bool)
    actions = np.array([[1.0, -1.0], [0.5, 1.9]])
    with pytest.raises(ValueError, match=r"The actions of env 1 are .*1\.9.* observe takes what act gave"):
        adaptation.observe(Step(obs, actions, np.zeros(2), obs, done))
    adaptation.observe(Step(obs, np.clip(actions, -1, 1), np.zeros(2), obs, done))


@pytest.mark.parametrize("z", [np.zeros(3), np.zeros((2, 4)), np.zeros((1, 3))])
def test_an_explorer_whose_z_has_another_shape(tiny_pearl: MakePEARL, z: np.ndarray) -> None:
    adaptation = tiny_pearl().start_adaptation(2, "aggregate")
    adaptation.explorer.z = z
    with pytest.raises(ValueError, match=r"The z of the explorer 'aggregate' has shape .*, expected \(2, 3\)"):
        adaptation.act(np.zeros((2, 2), dtype=np.float32))
    adaptation.explorer.z = np.zeros((2, 3))  # numpy's own float64 will do
    assert adaptation.act(np.zeros((2, 2), dtype=np.float32)).shape == (2, 2)
    with pytest.raises(ValueError, match="n_envs is 0"):
        tiny_pearl().start_adaptation(0)


def test_a_state_that_is_no_z_is_refused(tiny_pearl: MakePEARL) -> None:
    model, obs, z = tiny_pearl(), np.zeros((4, 2), dtype=np.float32), np.zeros((4, 3), dtype=np.float32)
    states: list[Any] = [z, (z[:2],), (z, z), (np.zeros((4, 2)),)]
    for state in states:
        with pytest.raises(ValueError, match=r"expected a tuple of one array, z, of shape \(4, 3\)"):
            model.predict(obs, state=state)
    assert model.predict(obs, state=(z[:1],))[0].shape == (4, 2)


def test_a_z_that_is_none_is_no_z_to_act_by(tiny_pearl: MakePEARL) -> None:
    """It would be saved, and found damaged; or give actions that are no numbers."""
    policy, none = tiny_pearl().policy, np.zeros(0)
    for z in (np.zeros((1, 3)), np.full(3, np.nan)):
        with pytest.raises(ValueError, match=r"z is .*, expected finite numbers of shape \(3,\)"):
            AdaptedAgent(policy, z, none, none.astype(bool))
    with pytest.raises(ValueError, match=r"z, the state, is .*nan.*, expected finite numbers: no action follows from it"):
        policy.predict(np.zeros(2, dtype=np.float32), (np.full((1, 3), np.nan, dtype=np.float32),))


def test_what_evaluations_are_given_by_mistake(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    with pytest.raises(ValueError, match=r"tasks is 'valid', expected one of \['test', 'validation', 'train'\]"):
        evaluate_adaptation(model, ENV_ID, tasks="valid")
    family: Any = SimpleNamespace(train_tasks=np.zeros((3, 2)))
    with pytest.raises(ValueError, match="The env's task_family has no validation_tasks: add them, or pass an array of task"):
        task_set(family, "validation")
    with pytest.raises(ValueError, match=r"tasks have shape \(\), expected \(n_tasks, task_dim\)"):
        evaluate_adaptation(model, ENV_ID, 5)
    with pytest.warns(UserWarning, match="No reward"):
        agent = model.adapt(gym.make(ENV_ID), n_episodes=1)
    with pytest.raises(ValueError, match=r"AdaptedAgent does not adapt: .*evaluate_policy"):
        evaluate_adaptation(agent, ENV_ID)  # type: ignore[arg-type]
    validation = PointRobotFamily().validation_tasks
    ours, theirs = (evaluate_adaptation(model, ENV_ID, tasks, n_episodes=1) for tasks in ("validation", validation))
    np.testing.assert_array_equal(ours, theirs)
    assert len(MetaEvalCallback(ENV_ID, tasks="train").tasks) == 80


@pytest.mark.parametrize("normalizer", [gym.wrappers.NormalizeReward, gym.wrappers.NormalizeObservation])
def test_adaptation_to_what_is_normalized_elsewhere(normalizer: Any, tiny_pearl: MakePEARL) -> None:
    with pytest.raises(ValueError, match=f"{normalizer.__name__} stands between"):
        evaluate_adaptation(tiny_pearl(), wrapped(normalizer), n_episodes=1)


def test_evaluations_that_could_not_be_made_are_refused_before_the_training(tiny_pearl: MakePEARL) -> None:
    """The first one may be at its end."""
    model = tiny_pearl()
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.learn(ROLLOUT, MetaEvalCallback("SparseTargetSpeed-v0"))
    model.knowledge.set_tells_rewards(False)
    with pytest.raises(ValueError, match="explorer 'aggregate' goes by successes"):
        MetaEvalCallback(ENV_ID, explorer="aggregate").init_callback(model)
    assert model.num_timesteps == 0


def test_an_evaluation_on_the_very_env_of_training(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    env = model.get_env()
    assert env is not None
    with pytest.raises(ValueError, match="eval_env is the env that is trained on"):
        model.learn(ROLLOUT, MetaEvalCallback(env, n_eval_episodes=1))


def test_a_callback_that_evaluates_in_the_envs_of_training_is_named(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    with pytest.raises(ValueError, match="a callback stepped the envs of training, as one that evaluates in them does"):
        model.learn(4 * ROLLOUT, EvalCallback(model.env, eval_freq=7, n_eval_episodes=4, verbose=0))  # type: ignore[arg-type]
