"""Ids of envs that are no plain names."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest

from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.experiments.runner import run_cell
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands import train
from sb3_htr.zoo.run.agents import agent_at, agent_for
from sb3_htr.zoo.run.record import RECORD


def test_ids_with_a_namespace_name_files_as_rl_zoo3_does(tmp_path: Path) -> None:
    run = tmp_path / "htr-ser" / "Suite-Robot-v0_2"
    run.mkdir(parents=True)
    (run / RECORD).write_text(json.dumps({"env_id": "Suite/Robot-v0", "env_kwargs": {}, "gym_packages": []}))
    (run / "Suite-Robot-v0.zip").touch()
    assert agent_for("Suite/Robot-v0", tmp_path).path == run / "Suite-Robot-v0.zip"
    assert agent_at(run).stem == "Suite-Robot-v0"


MODULE = """
import gymnasium
import numpy as np
from gymnasium import spaces


class StepEnv(gymnasium.Env):
    def __init__(self):
        line = spaces.Box(-9.0, 9.0, (1,))
        self.observation_space = spaces.Dict(observation=line, achieved_goal=line, desired_goal=line)
        self.action_space = spaces.Box(-1.0, 1.0, (1,))

    def _observe(self):
        return {"observation": self.x, "achieved_goal": self.x, "desired_goal": self.goal}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.goal = np.zeros(1, np.float32), self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32)
        return self._observe(), {}

    def step(self, action):
        self.x = np.clip(self.x + 0.3 * action, -9.0, 9.0)
        return self._observe(), float(self.compute_reward(self.x, self.goal, {})), False, False, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.abs(achieved_goal - desired_goal) > 0.2)[..., 0].astype(np.float32)


gymnasium.register("StepOfTheTest-v0", entry_point=StepEnv, max_episode_steps=6)
"""
SMALL = [
    *("n_envs:4", "n_tasks_per_rollout:4", "n_episodes_per_task:2", "learning_starts:40", "gradient_steps:2"),
    *("meta_batch_size:4", "batch_size:4", "policy_kwargs:{'net_arch':[16],'encoder_arch':[16],'latent_dim':3}"),
]


def test_the_goal_env_of_a_user_is_trained_on_by_its_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "goals_of_the_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    packages = ["--gym-packages", "goals_of_the_test"]
    train = ["train", "--env", "HiddenGoal/StepOfTheTest-v0", *packages, "-f", "runs", "--verbose", "0"]
    assert main([*train, "-n", "96", "--eval-freq", "96", "--save-freq", "48", "-params", *SMALL]) == 0
    run = tmp_path / "runs" / "htr-ser" / "HiddenGoal-StepOfTheTest-v0_1"
    assert (run / "HiddenGoal-StepOfTheTest-v0.zip").exists()
    # as in another process, which knows neither id
    for env_id in ("HiddenGoal/StepOfTheTest-v0", "StepOfTheTest-v0"):
        monkeypatch.delitem(gym.registry, env_id)
    monkeypatch.delitem(sys.modules, "goals_of_the_test")
    assert main(["train", "--resume", str(run), *packages, "-n", "48"]) == 0
    assert main(["evaluate", str(run), *packages, "--n-episodes", "2"]) == 0
    assert "HiddenGoal/StepOfTheTest-v0" in capsys.readouterr().out


def test_the_goal_env_of_a_user_has_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell is run where nobody has made the id."""
    (tmp_path / "goals_of_the_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "goals_of_the_test", raising=False)
    for env_id in ("HiddenGoal/StepOfTheTest-v0", "StepOfTheTest-v0"):
        monkeypatch.delitem(gym.registry, env_id, raising=False)
    env_id, evaluations = "HiddenGoal/StepOfTheTest-v0", by(("belief",), {"disable_env_checker": True})
    (cell,) = Experiment("one", "", env_id, 96, (Variant("htr-ser"),), 1, evaluations=evaluations).cells()

    def trained(arguments: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "main", trained)
    with pytest.raises(KeyboardInterrupt):
        run_cell(replace(cell, gym_packages=("goals_of_the_test",)), tmp_path)


def test_a_goal_env_that_is_not_there_is_named() -> None:
    with pytest.raises(gym.error.Error, match=r"NoSuchEnv.* by --gym-packages MODULE"):
        main(["train", "--env", "HiddenGoal/NoSuchEnv-v0"])
