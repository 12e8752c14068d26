"""A task that is none is refused, and so is an env that is on another task than the one that it was asked for."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from helpers import ENV_ID, ROLLOUT, MakePEARL
from helpers.envs import DropsOptions
from htr_envs import PointRobotFamily
from sb3_htr import evaluate_adaptation
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checks import check_tasks, get_task_family
from sb3_htr.common.vec_env import make_task_vec_env


def test_an_env_that_is_on_other_tasks_than_asked_for_is_refused(tiny_pearl: MakePEARL) -> None:
    """Else its experience would be that of other tasks, and its scores those of training tasks."""
    env = DropsOptions(gym.make(ENV_ID))
    model = tiny_pearl().learn(ROLLOUT)
    test = get_task_family(make_task_vec_env(ENV_ID)).test_tasks
    for act in (
        lambda: tiny_pearl(env).learn(ROLLOUT),
        lambda: evaluate_adaptation(model, env, n_episodes=1),
        lambda: model.adapt(env, n_episodes=1, task=test[0]),
        lambda: model.adapt(env, n_episodes=1, task=41),
    ):
        with pytest.raises(ValueError, match=r"(The env|Env 0) was asked for the task.* must hand on options"):
            act()


class Redraws(gym.Wrapper[Any, Any, Any, Any]):
    """A task that is given holds for one episode, as in many envs."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if not options:
            self.get_wrapper_attr("set_task")(None)
        return self.env.reset(seed=seed, options=options)


def test_an_env_that_goes_on_to_another_task_is_refused(tiny_pearl: MakePEARL) -> None:
    """Else one adaptation would be to the tasks of all its episodes."""
    env = Redraws(gym.make(ENV_ID))
    model = tiny_pearl().learn(ROLLOUT)
    task = get_task_family(make_task_vec_env(ENV_ID)).test_tasks[0]
    for act in (
        lambda: tiny_pearl(env).learn(ROLLOUT),
        lambda: evaluate_adaptation(model, env, n_episodes=2),
        lambda: model.adapt(env, n_episodes=2, task=task),
    ):
        with pytest.raises(
            ValueError, match=r"Between two episodes env 0 went from task .* by itself: a reset without options"
        ):
            act()


def test_the_env_that_is_on_another_task_is_named() -> None:
    env = make_task_vec_env(ENV_ID, 2)
    tasks = np.array([[1.0, 0.0], [0.0, 1.0]], dtype=np.float32)
    env.set_options([{"task": task} for task in tasks])
    env.reset()
    with pytest.raises(ValueError, match=r"Env 1 was asked for the task \[1. 0.\], and is on \[0. 1.\]"):
        check_tasks(env, tasks[[0, 0]])


def test_an_env_that_names_its_task_by_the_index_alone(tiny_pearl: MakePEARL) -> None:
    """More is not in the contract."""

    class Bare(gym.Env[Any, Any]):
        max_episode_steps = 20

        def __init__(self) -> None:
            self.within = gym.make(ENV_ID)
            self.task_family = PointRobotFamily()
            self.observation_space, self.action_space = self.within.observation_space, self.within.action_space

        def reset(self, **kwargs: Any) -> Any:
            return self.within.reset(**kwargs)

        def step(self, action: Any) -> Any:
            return self.within.step(action)

    env = Bare()
    env.reset(options={"task_id": 7})
    assert len(tiny_pearl().adapt(env, n_episodes=2).returns) == 2
    assert env.reset()[1]["task_id"] == 7


def test_a_task_that_is_none_costs_no_reset(tiny_pearl: MakePEARL) -> None:
    """Whoever mends a slip goes on with the same env."""
    model, env = tiny_pearl(), gym.make(ENV_ID)
    with pytest.raises(ValueError, match=r"The task has shape \(3,\), expected \(2,\)"):
        model.adapt(env, n_episodes=1, task=np.zeros(3))
    with pytest.raises(ValueError, match="task id 80 is out of range"):
        model.adapt(env, n_episodes=1, task=80)
    model.adapt(env, n_episodes=1, task=np.array([0.0, 1.0]))


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        (np.zeros((2, 3)), "tasks have 3 numbers each, expected 2"),
        ([[50.0, 50.0]], r"The task \[\[50.0, 50.0\]\] is not in Box"),
    ],
)
def test_tasks_that_are_none_are_refused_before_the_training(tasks: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MetaEvalCallback(ENV_ID, tasks=tasks)
