"""The examples keep the promises of task families, and the notebook runs."""

import ast
import importlib
import inspect
import json
import runpy
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from helpers import TINY, with_policy
from helpers.pages import of_a_moment
from htr_envs import check_task_env
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.rivals.scripted import ScriptedAgent

EXAMPLES = Path(__file__).parents[1] / "examples"
FAMILIES = {
    "two_link_arm": "TwoLinkArm-v0",
    "hidden_target_reacher": "HiddenTargetReacher-v0",
    "sparse_half_cheetah_velocity": "SparseHalfCheetahVelocity-v0",
    "ant_goal_disc": "AntGoalDisc-v0",
    "four_corners": "FourCorners-v0",
}


def test_floors_are_below_ceilings(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = importlib.import_module("examples.floor_and_ceiling")
    scripts = {env_id: scripts for env_id, scripts in example.SCRIPTS.items() if env_id != "SparseAnt-v0"}
    for name, value in {"N_EPISODES": 1, "SEEDS": range(1), "RANDOM_SEEDS": range(1), "SCRIPTS": scripts}.items():
        monkeypatch.setattr(example, name, value)
    example.main("validation")
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[-1] for row in rows] == [*["0.0000 |", "1.0000 |"] * 2, "0.0000 |", *["1.0000 |"] * 2]
    floor, straight, still, drive, noise, thrust, hold = (float(row[2].split()[0]) for row in rows)
    assert floor < 0.1 and straight > 13 and still < 0 and drive > 125 and noise < 0 and thrust < 3 and hold > 30


# Each worse than any robot
BROKEN: tuple[dict[str, float], ...] = (
    {"gain": 0.0},
    {"missed": 1.0},
    {"false": 0.3},
    {"reward_noise": 9.0},
    {"action_noise": 9.0},
    {"observation_noise": 9.0},
    {"delay": 20},
)


@pytest.mark.filterwarnings("ignore:.*more than meta-training has taught")
def test_what_breaks_a_robot_breaks_adaptation(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = importlib.import_module("examples.imperfect_robot")
    imperfections = {"none": example.Imperfection(), **{str(what): example.Imperfection(**what) for what in BROKEN}}
    monkeypatch.setattr(example, "IMPERFECTIONS", imperfections)
    monkeypatch.setattr(example, "SEEDS", range(1))
    monkeypatch.setattr(example, "evaluate_adaptation", partial(evaluate_adaptation, n_episodes=6))
    example.main("SparsePointRobot-v0")
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert len(rows) == 8 and rows[0][1:] == ["none", rows[0][2], "1.00", "1.00"]
    assert rows[1][2:] == ["7.0", "0.00", "0.00"], "one that stands still"
    assert all(float(row[-1]) < 0.8 for row in rows[1:]), rows


def test_noise_of_actions_is_in_the_scale_of_the_env() -> None:
    example = importlib.import_module("examples.imperfect_robot")

    class Wide(gym.ActionWrapper[Any, Any, Any]):
        def __init__(self, env: gym.Env[Any, Any], times: float) -> None:
            super().__init__(env)
            self.times = np.float32(times)
            self.action_space = gym.spaces.Box(-self.times, self.times, (2,), np.float32)

        def action(self, action: Any) -> Any:
            return action / self.times

    paths = []
    for times in (1, 4):
        env = make_task_vec_env("SparsePointRobot-v0", 2, 0, wrapper=partial(Wide, times=times))
        robots = example.ImperfectRobot(env, example.Imperfection(action_noise=0.3), np.zeros(2), 0)
        robots.reset()
        paths.append([robots.step(np.full((2, 2), 0.5 * times, dtype=np.float32))[0] for _ in range(5)])
    np.testing.assert_allclose(paths[0], paths[1], rtol=1e-5)


DENSE = {
    "half_cheetah_velocity": "HalfCheetahVelocity-v0",
    "ant_direction": "AntDirection-v0",
    "dense_point_robot": "DensePointRobot-v0",
}
DEPENDENT = {**DENSE, "walker_random_params": "WalkerRandomParams-v0", "turned_controls": "TurnedControls-v0"}
OF_GYMNASIUM = (
    "hidden_target_reacher",
    "sparse_half_cheetah_velocity",
    "half_cheetah_velocity",
    "ant_direction",
    "walker_random_params",
)


def import_example(module: str) -> None:
    """With what it imports as a script, before it trains for minutes."""
    example = importlib.import_module(f"examples.{module}")
    for node in ast.walk(ast.parse(inspect.getsource(example))):
        if isinstance(node, ast.ImportFrom):
            assert all(hasattr(importlib.import_module(node.module or ""), name.name) for name in node.names), node.module


@pytest.mark.parametrize("module", FAMILIES)
def test_a_family_of_the_examples_is_one(module: str) -> None:
    import_example(module)
    env = gym.make(FAMILIES[module])
    assert env.unwrapped.render() is None
    check_task_env(env)
    kwargs = {**TINY, "policy_kwargs": with_policy(normalize_observations=True)}
    model = PEARL("MlpPolicy", env, **kwargs, train_explorer="prior").learn(1)
    assert model.replay_buffer is not None and model.replay_buffer.size() > 0


@pytest.mark.parametrize("module", DEPENDENT)
def test_an_env_of_the_examples_whose_tasks_change_anything(module: str) -> None:
    import_example(module)
    env = gym.make(DEPENDENT[module])
    assert env.unwrapped.render() is None
    check_task_env(env, n_episodes=1)
    push = np.full_like(env.action_space.sample(), 0.3)
    steps = []
    for task in (0, 1, 0):
        env.reset(seed=0, options={"task_id": task})
        steps.append([env.step(push)[:2] for _ in range(5)])
    first, other, again = ([np.append(obs, float(reward)) for obs, reward in episode] for episode in steps)
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(np.array(first)[:, -1], np.array(other)[:, -1])
    moves_alike = np.allclose(np.array(first)[:, :-1], np.array(other)[:, :-1])
    assert moves_alike == (module in DENSE)
    prior = {"name": "prior", "n_exploration_episodes": 1}
    plain = {"replay_buffer_kwargs": {"relabel_probability": 0.0}, "explorer": prior, "train_explorer": prior}
    model = PEARL("MlpPolicy", env, **{**TINY, **plain, "n_tasks_per_rollout": 1}).learn(1)
    assert model.observation_space.dtype == np.float32 and model.replay_buffer is not None and model.replay_buffer.size() > 0


@pytest.mark.parametrize("module", OF_GYMNASIUM)
def test_a_window_without_a_screen_is_refused(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    importlib.import_module(f"examples.{module}")
    env_class: Any = type(gym.make({**FAMILIES, **DEPENDENT}[module]).unwrapped)
    with pytest.raises(DependencyNotInstalled, match="needs a screen, and there is none"):
        env_class(render_mode="human")


def test_one_that_is_told_how_its_controls_are_turned_holds_its_goal() -> None:
    example = importlib.import_module("examples.turned_controls")
    env = gym.make("TurnedControls-v0", reward_type="sparse")
    returns = [
        evaluate_adaptation(ScriptedAgent(env.action_space, script), env, n_episodes=20)[0]
        for script in (None, example.turn_back)
    ]
    assert returns[0].mean() < 4 < 16 < returns[1].mean() and returns[1].min() > 9


def test_successes_of_the_dense_point_robot_are_those_of_the_sparse_one() -> None:
    importlib.import_module("examples.dense_point_robot")
    envs = [gym.make(env_id) for env_id in ("DensePointRobot-v0", "SparsePointRobot-v0")]
    told: list[list[bool]] = [[], []]
    for env, successes in zip(envs, told, strict=True):
        env.reset(seed=0, options={"task": [0.0, 1.0]})
        successes += [bool(env.step(np.array([0, 1], dtype=np.float32))[-1]["is_success"]) for _ in range(12)]
    assert told[0] == told[1] and True in told[0] and False in told[0]


def test_the_experiments_are_of_registered_envs(monkeypatch: pytest.MonkeyPatch) -> None:
    known: dict[str, Any] = {}
    monkeypatch.setattr("sb3_htr.experiments.grid.EXPERIMENTS", known)
    runpy.run_module("examples.experiments")
    assert set(known) == {*FAMILIES, "ant_goal", "half_cheetah_velocity", "dense_context", "turned_controls"}
    for experiment in known.values():
        cells = experiment.cells()
        assert len(cells) == 5 * len(experiment.variants) and cells[0].env_id in gym.registry


def test_pictures_of_the_reacher_show_its_target() -> None:
    importlib.import_module("examples.hidden_target_reacher")
    env = gym.make("HiddenTargetReacher-v0", render_mode="rgb_array")
    pictures = []
    for target in ([0.1, 0.1], [-0.1, 0.1]):
        env.reset(seed=0, options={"task": target})
        pictures.append(np.asarray(env.render()))
    env.close()
    red = [picture[..., 0] > 2.5 * picture[..., 1:].max(axis=-1) for picture in pictures]
    right, left = (np.argwhere(shown)[:, 1].mean() for shown in red)
    assert right > left + 50


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plt, "show", lambda: None)
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    (tmp_path / "notebook.py").write_text(of_a_moment("\n".join(cells)))
    assert runpy.run_path(str(tmp_path / "notebook.py"))["model"]._n_updates > 0
    plt.close("all")
    assert not any(cell.get("outputs") for cell in notebook["cells"]), "outputs are not kept: they would go out of date"


@pytest.mark.parametrize("env_id", ["SparseAnt-v0", "AntGoalDisc-v0"])
def test_a_dense_reward_does_not_pay_an_ant_for_falling(env_id: str) -> None:
    """Which ends its episode: what it earns where it starts is no cost, whichever goal is the task."""
    importlib.import_module("examples.ant_goal_disc")
    env = gym.make(env_id, reward_type="dense")
    for i in range(0, len(env.get_wrapper_attr("train_tasks")), 10):
        env.reset(seed=0, options={"task_id": i})
        _, reward, *_ = env.step(np.zeros(8, dtype=np.float32))
        assert float(reward) > -0.02, i
