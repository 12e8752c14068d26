"""The commands, as a user would call them."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import yaml
from conftest import ENV_ID, TINY
from stable_baselines3.common.vec_env import VecNormalize

from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.shipped import hyperparams_file
from sb3_htr.zoo.commands.train import MetaExperimentManager

SMALL = [
    "n_tasks_per_rollout:4",
    "n_episodes_per_task:3",
    "learning_starts:240",
    "gradient_steps:2",
    "n_envs:4",
    "policy_kwargs:{'net_arch':[16],'encoder_arch':[16]}",
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    arguments = ["train", "--env", ENV_ID, "-f", str(folder), "-n", "960", "--eval-freq", "480", "--save-freq", "480"]
    assert main([*arguments, "--seed", "1", "--verbose", "0", "-tb", str(folder / "tb"), "-params", *SMALL]) == 0
    return folder


def test_train_writes_a_run_folder(runs: Path) -> None:
    run = runs / "pearl" / f"{ENV_ID}_1"
    settings = json.loads((run / "run.json").read_text())
    assert settings["env_id"] == ENV_ID and settings["seed"] == 1 and "torch" in settings["versions"]
    assert settings["hyperparams"]["n_tasks_per_rollout"] == 4
    assert settings["hyperparams"]["n_timesteps"] == 960, "as used, not as in the YAML file"
    assert (run / ENV_ID / "config.yml").exists() and list(runs.glob("tb/**/events*"))
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [480, 960]
    assert len((run / "0.monitor.csv").read_text().splitlines()) == 2 + 960 / 20
    assert PEARL.load(run / f"{ENV_ID}.zip").num_timesteps == 960
    assert (run / "best_model.zip").exists() and list((run / "checkpoints").iterdir())


@pytest.mark.parametrize("arguments", [[], ["--model", "last", "--tasks", "validation", "--explorer", "prior"]])
def test_evaluate_prints_a_table_and_draws_pictures(
    runs: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(runs), "--n-episodes", "6", *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.strip().startswith(tuple("123456")) for line in lines) == 6
    run = runs / "pearl" / f"{ENV_ID}_1"
    record = np.load(run / "adaptation.npz")
    assert record["returns"].shape == (20, 6) and record["achieved"].shape == (20, 6, 20, 2)
    for picture in ("adaptation_curve.png", "adaptation_paths.png"):
        assert (run / picture).read_bytes().startswith(b"\x89PNG")
        assert (run / picture).stat().st_size > 10_000


def test_a_model_is_trained_on(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = runs / "pearl" / f"{ENV_ID}_1" / f"{ENV_ID}.zip"
    arguments = ["train", "--env", ENV_ID, "-f", str(runs / "more"), "-n", "240", "-i", str(model), "--eval-freq", "-1"]
    assert main([*arguments, "--verbose", "0", "-params", *SMALL]) == 0
    assert "Loading pretrained agent" in capsys.readouterr().out


def test_normalized_runs_are_evaluated_as_they_were_trained(tmp_path: Path) -> None:
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "480", "--eval-freq", "480", "--verbose", "0"]
    normalize = "normalize:{'norm_obs':True,'norm_reward':False}"
    assert main([*arguments, "--save-replay-buffer", "-params", *SMALL, normalize]) == 0
    run = tmp_path / "pearl" / f"{ENV_ID}_1"
    assert (run / "replay_buffer.pkl").exists()
    assert main(["evaluate", str(run), "--tasks", "validation"]) == 0
    # The same model, tasks and seed as in the evaluation during training
    during = np.load(run / "evaluations.npz")["returns"][0]
    np.testing.assert_allclose(np.load(run / "adaptation.npz")["returns"], during, atol=1e-4)


def test_env_kwargs_of_the_yaml_reach_the_evaluation(tmp_path: Path) -> None:
    """A zoo trap: rl_zoo3 gives them to the training env only."""
    block = {**{k: v for k, v in TINY.items() if k != "seed"}, "policy": "MlpPolicy", "n_timesteps": 240, "n_envs": 4}
    file = tmp_path / "my.yml"
    file.write_text(yaml.safe_dump({ENV_ID: {**block, "env_kwargs": {"goal_distance": 0.05}}}))
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(file), "--eval-freq", "240", "--verbose", "0"]
    assert main(arguments) == 0
    # Every goal disc of this distance holds the start, so that all adaptations find it at once
    evaluations = np.load(tmp_path / "pearl" / f"{ENV_ID}_1" / "evaluations.npz")
    assert evaluations["successes"].all(axis=(0, 1))[0]


def test_a_run_logs_its_progress_and_its_schedule_needs_no_zoo(tmp_path: Path) -> None:
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "960", "--eval-freq", "-1", "--verbose", "0"]
    env_kwargs = ["--env-kwargs", "max_episode_steps:10"]
    assert main([*arguments, *env_kwargs, "-params", *SMALL, "learning_rate:'lin_1e-3'"]) == 0
    run = tmp_path / "pearl" / f"{ENV_ID}_1"
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    assert progress["time/total_timesteps"][-1] == 960 and (progress["rollout/ep_len_mean"] == 10).all()
    trained = np.isfinite(progress["train/critic_loss"])
    assert trained.sum() > 2 and (np.diff(progress["train/learning_rate"][trained]) < 0).all()
    code = "import sys; sys.modules['rl_zoo3'] = None; from sb3_htr import PEARL; print(PEARL.load(sys.argv[1]).learning_rate)"
    command = [sys.executable, "-W", "error", "-c", code, str(run / f"{ENV_ID}.zip")]
    assert "0.001" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_episode_clustering_can_be_asked_for_by_name(tmp_path: Path) -> None:
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "240", "--eval-freq", "-1", "--verbose", "0"]
    assert main([*arguments, "-params", *SMALL, "replay_buffer_class:'EpisodeClustering'"]) == 0
    model = PEARL.load(tmp_path / "pearl" / f"{ENV_ID}_1" / f"{ENV_ID}.zip")
    assert model.replay_buffer_class is EpisodeClustering


def test_weights_and_biases_gets_what_tensorboard_gets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: dict[str, Any] = {}
    config: dict[str, Any] = {}

    class Run:
        class config:
            setdefaults = config.update

    def init(**kwargs: Any) -> type[Run]:
        begun.update(kwargs)
        return Run

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "wandb", cast(ModuleType, SimpleNamespace(init=init)))
    arguments = [
        "train",
        "--env",
        ENV_ID,
        "-f",
        "logs",
        "-n",
        "240",
        "--eval-freq",
        "240",
        "--verbose",
        "0",
        "-params",
        *SMALL,
    ]
    track = ["--track", "--wandb-project-name", "meta", "--seed", "3"]
    assert main([*arguments, *track]) == 0
    assert begun["project"] == "meta" and begun["sync_tensorboard"] and begun["name"].startswith(f"{ENV_ID}__pearl__3")
    assert config["saved_hyperparams"]["n_tasks_per_rollout"] == 4
    assert list((tmp_path / "runs" / begun["name"]).glob("**/events*"))
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match="pip install wandb"):
        main([*arguments, *track])


def test_every_hyperparameter_names_its_source() -> None:
    for file in sorted(hyperparams_file().parent.glob("*.yml")):
        for number, line in enumerate(file.read_text().splitlines(), start=1):
            if re.match(r"\s+\w+: *[^&* ]", line) and not line.strip().startswith("#"):
                assert "# " in line, f"{file.name}, line {number}: {line.strip()} has no source"


def test_help_and_mistakes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--help"]) == 0 and "evaluate" in capsys.readouterr().out
    assert main(["trian"]) == 2 and "usage: sb3-htr" in capsys.readouterr().err
    with pytest.raises(ValueError, match="--algo is 'sac', but sb3-htr trains pearl"):
        main(["train", "--env", ENV_ID, "--algo", "sac"])
    with pytest.raises(FileNotFoundError, match="There is no run in"):
        main(["evaluate", str(tmp_path)])


def blocks() -> list[tuple[str, str]]:
    files = sorted(hyperparams_file().parent.glob("*.yml"))
    return [(file.name, key) for file in files for key in yaml.safe_load(file.read_text())]


@pytest.mark.parametrize(("file", "block"), blocks())
def test_every_block_of_hyperparameters_trains(file: str, block: str) -> None:
    settings = MetaExperimentManager._preprocess_schedules(yaml.safe_load(hyperparams_file(file).read_text())[block])
    n_envs = settings.pop("n_envs")
    del settings["n_timesteps"]
    env = make_task_vec_env(ENV_ID if block == "default" else block, n_envs)
    if normalize := settings.pop("normalize", None):
        env = VecNormalize(env, **yaml.safe_load(normalize))
    # The settings as they are, but a short rollout and two updates
    model = PEARL(env=env, seed=0, **{**settings, "learning_starts": 0, "gradient_steps": 2, "n_episodes_per_task": 1})
    model.learn(1)
    assert model._n_updates == 2


def test_importing_the_library_is_light() -> None:
    """rl_zoo3 would replace gymnasium's TimeLimit for the whole process."""
    code = "import sys, sb3_htr; print([m for m in ('rl_zoo3', 'htr_envs', 'optuna') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
