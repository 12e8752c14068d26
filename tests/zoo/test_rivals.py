"""Rivals have the commands of PEARL."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from helpers import ENV_ID
from helpers.hub import Hub
from helpers.runs import run_folder
from sb3_htr import evaluate_adaptation
from sb3_htr.common.checks import get_max_episode_steps
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.agents import TrainedAgent, agent_at
from sb3_htr.zoo.run.algorithm import ALGORITHMS
from sb3_htr.zoo.run.method import methods
from sb3_htr.zoo.run.record import RECORD

SMALL: dict[str, list[str]] = {
    "rl2": [
        "n_episodes_per_trial:2",
        "n_epochs:1",
        "policy_kwargs:{'lstm_hidden_size':4,'net_arch':[4],'normalize_observations':True}",
    ],
    "sac-her": ["gradient_steps:2", "policy_kwargs:{'net_arch':[4]}", "n_envs:8", "buffer_size:2000"],
}
STEPS = {"rl2": 3200, "sac-her": 160}


def train(method: str, folder: Path, *arguments: str) -> None:
    n = STEPS[method]
    how_long = ["-n", str(2 * n), "--eval-freq", str(2 * n), "--save-freq", str(n), "--verbose", "0", "--seed", "1"]
    where = ["train", "--env", ENV_ID, "--method", method, "-f", str(folder)]
    assert main([*where, *how_long, *arguments, "-params", *SMALL[method]]) == 0


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for method in SMALL:
        train(method, folder, "-P")
    return folder


@pytest.mark.parametrize("method", SMALL)
def test_all_commands_take_them(method: str, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_folder(runs, method)
    assert json.loads((run / RECORD).read_text())["method"] == method
    # Without pickle, as with it
    agents = [replace(agent_at(run, "last"), trusted=trust) for trust in (False, True)]
    records = [evaluate_adaptation(agent.load(), ENV_ID, n_episodes=2) for agent in agents]
    np.testing.assert_array_equal(records[0], records[1])
    few = ["--n-episodes", "2"]
    assert main(["evaluate", str(run), "-o", str(tmp_path), *few, "--tasks", "validation"]) == 0
    assert "20 validation tasks of SparsePointRobot-v0, explorer 'own'" in capsys.readouterr().out
    assert main(["enjoy", str(run), "--no-render", "--n-tasks", "1", *few]) == 0
    assert "uncertainty of z" not in capsys.readouterr().out
    assert main(["plot", str(run), "-o", str(tmp_path / "plots"), *few, "--tasks", "validation"]) == 0
    assert {path.stem for path in (tmp_path / "plots").iterdir()} == {
        "learning_curves",
        "adaptation_curve",
        "adaptation_paths",
    }
    film = tmp_path / "film.gif"
    assert main(["record", str(run), "--n-tasks", "1", *few, "--every", "5", "-o", str(film), "--verbose", "0"]) == 0
    assert film.stat().st_size > 1000
    with pytest.raises(ValueError, match="has no explorers, but the explorer is 'prior'"):
        main(["evaluate", str(run), "--explorer", "prior"])


@pytest.mark.parametrize("method", SMALL)
def test_they_go_to_the_hub_and_come_back(method: str, runs: Path, hub: Hub) -> None:
    assert main(["export", str(runs / method), "-o", "shared", "--n-episodes", "1", "--push-to-hub", "me"]) == 0
    command = f"sb3-htr load_from_hub --env {ENV_ID} -orga me --algo {method}"
    assert f"$ {command}\n" in Path("shared/README.md").read_text()
    assert main(command.split()[1:]) == 0
    ours, theirs = (evaluate_adaptation(agent_at(at).load(), ENV_ID, n_episodes=2) for at in (runs / method, Path("logs")))
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("method", SMALL)
def test_what_is_exported_acts_the_same_and_says_how_to_use_it(
    method: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["export", str(runs / method), "-o", str(tmp_path / "agent"), "--n-episodes", "2"]) == 0
    run, file = agent_at(runs / method), tmp_path / "agent" / f"{method}-{ENV_ID}.zip"
    ours, theirs = (evaluate_adaptation(agent.load(), ENV_ID, n_episodes=2) for agent in (run, agent_at(file)))
    np.testing.assert_array_equal(ours, theirs)
    card = (file.parent / "README.md").read_text()
    assert methods()[method].about in card and ALGORITHMS[method].about in card and "prior" not in card
    assert "hindsight-task-relabelling" not in card
    assert f"--method {method}" in card and yaml.safe_load(card.split("---")[1])["model-index"][0]["name"] == method
    monkeypatch.chdir(file.parent)
    exec(re.findall(r"```python\n(.*?)```", card, re.DOTALL)[0], {})


def test_a_run_of_a_rival_goes_on(runs: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(run_folder(runs, "sac-her"), run)
    assert main(["train", "--resume", str(run), "-n", "160"]) == 0
    assert agent_at(run, "last").load().num_timesteps == 480


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "ppo"], "--algo is 'ppo', but sb3-htr trains rl2"),
        (["-params", "n_steps:20"], "RL2 has no setting 'n_steps': it follows from n_trials_per_rollout"),
        (["-params", "lstm:20"], "RL2 has no setting 'lstm'"),
    ],
)
def test_mistakes_are_answered_in_one_sentence(arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        main(["train", "--env", ENV_ID, "--method", "rl2", "-f", str(tmp_path), "--verbose", "0", *arguments])


def test_a_method_of_another_algorithm_cannot_stand_in_a_yaml_file(tmp_path: Path) -> None:
    """The file has the settings of one algorithm."""
    with pytest.raises(ValueError, match="rl2 is trained by another algorithm: choose it by --method rl2"):
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), "--verbose", "0", "-params", "method:'rl2'"])


def test_a_file_that_does_not_fit_its_record_is_refused(runs: Path) -> None:
    agent = agent_at(runs / "sac-her")
    wrongs: list[Any] = [
        {"net_arch": [5]},
        {"net_arch": "[5]"},
        {"net_arch": [10**9]},
        {"features_extractor_class": "os.system"},
    ]
    for wrong in [*wrongs, {"net_arch": [2**14] * 16}, [3], {"lstm_hidden_size": 4}]:
        record: dict[str, Any] = {**agent.record, "hyperparams": {"policy_kwargs": wrong}}
        with pytest.raises(ValueError, match=r"best_model.zip is damaged, or no SACHER with the settings"):
            TrainedAgent(agent.path, record, None).load()
    agent = agent_at(runs / "rl2")
    record = {**agent.record, "hyperparams": {**agent.record["hyperparams"], "n_episodes_per_trial": 10**9}}
    with pytest.raises(ValueError, match="RL2 with the settings of its record: it has 6400 env steps"):
        TrainedAgent(agent.path, record, None).load()


@pytest.mark.parametrize("algorithm", ["rl2", "sac-her"])
def test_every_block_of_hyperparameters_makes_a_model(algorithm: str) -> None:
    blocks = yaml.safe_load(Path(ALGORITHMS[algorithm].settings_file).read_text())
    for name, settings in blocks.items():
        env = make_task_vec_env(ENV_ID if name == "default" else name, settings.pop("n_envs"))
        n_timesteps = settings.pop("n_timesteps")
        model = ALGORITHMS[algorithm].model_class(env=env, **settings)
        assert n_timesteps >= env.num_envs * get_max_episode_steps(env) and model.policy is not None
