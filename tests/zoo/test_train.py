"""``sb3-htr train`` and ``sb3-htr evaluate``, as a user would call them."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import rl_zoo3.train
import yaml
from gymnasium.envs.registration import EnvSpec
from rl_zoo3 import exp_manager
from stable_baselines3.common.callbacks import EvalCallback

import sb3_htr
from helpers import ENV_ID, TINY
from helpers.runs import SHIPPED, run_folder, train_arguments
from sb3_htr import PEARL
from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.common.divergence import DivergedError
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands.evaluate import table
from sb3_htr.zoo.run.callbacks import MetaTrialEvalCallback
from sb3_htr.zoo.run.manager import MetaExperimentManager
from sb3_htr.zoo.run.method import DEFAULT, get_method
from sb3_htr.zoo.run.record import RECORD, read_record
from sb3_htr.zoo.run.shipped import hyperparams_file


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    arguments = ["--save-freq", "480", "--seed", "1", "-tb", str(folder / "tb")]
    assert main(train_arguments(folder, 960, *arguments, eval_freq=480)) == 0
    return folder


def test_train_writes_a_run_folder(runs: Path) -> None:
    run = run_folder(runs)
    settings = json.loads((run / "run.json").read_text())
    assert settings["env_id"] == ENV_ID and settings["seed"] == 1 and "torch" in settings["versions"]
    assert settings["method"] == "htr-ser"
    assert settings["hyperparams"]["n_tasks_per_rollout"] == 4
    assert settings["hyperparams"]["n_timesteps"] == 960, "as used, not as in the YAML file"
    assert settings["hyperparams"]["policy_kwargs"] == {"net_arch": [16], "encoder_arch": [16]}
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
    run = run_folder(runs)
    about = "-last-validation-prior" if arguments else ""
    record, n = np.load(run / f"adaptation{about}.npz"), 20 if "validation" in arguments else 100
    of = ("last", "validation", "prior") if arguments else ("best", "test", "belief")
    assert (str(record["set"]), str(record["explorer"])) == of[1:] and ("best" in str(record["model"])) == (of[0] == "best")
    assert record["returns"].shape == (n, 6) and record["achieved"].shape == (n, 6, 20, 2)
    for picture in (f"adaptation_curve{about}.png", f"adaptation_paths{about}.png"):
        assert (run / picture).read_bytes().startswith(b"\x89PNG")
        assert (run / picture).stat().st_size > 10_000


def test_the_table_says_what_was_solved_in_an_episode_and_so_far() -> None:
    successes = np.array([[False, True, False], [False, False, False]])
    lines = table(AdaptationRecord(2.0 * successes, successes, np.zeros((2, 3, 1, 2)))).splitlines()[1:]
    assert [line.split() for line in lines] == [
        ["1", "0.00", "0.00", "..", "0.00", "0%", "0%"],
        ["2", "1.00", "0.50", "..", "1.50", "50%", "50%"],
        ["3", "0.00", "0.00", "..", "0.00", "0%", "50%"],
    ]
    untold = table(AdaptationRecord(1.0 * successes, np.zeros_like(successes), np.zeros((2, 3, 1, 2)))).splitlines()
    assert "info['is_success'] tells of none" in untold[-1], "a family may not know, and its agent is not the one that fails"


def test_evaluations_of_one_run_do_not_replace_each_other(runs: Path, tmp_path: Path) -> None:
    of = [[], ["--tasks", "validation"], ["--explorer", "prior"], ["--model", "last"], ["--tasks", "train", "--model", "last"]]
    for arguments in of:
        assert main(["evaluate", str(runs), "-o", str(tmp_path), "--n-episodes", "1", *arguments]) == 0
    names = {path.stem for path in tmp_path.glob("*.npz")}
    assert names == {f"adaptation{of}" for of in ("", "-validation", "-prior", "-last", "-last-train")}
    assert len(list(tmp_path.glob("*.png"))) == 2 * len(of)


def test_an_evaluation_is_named_after_the_model_that_a_file_is(runs: Path, tmp_path: Path) -> None:
    run = run_folder(runs)
    for file, arguments in (("best_model.zip", ["--model", "last"]), (f"{ENV_ID}.zip", [])):
        assert main(["evaluate", str(run / file), "-o", str(tmp_path), "--n-episodes", "1", *arguments]) == 0
    assert {path.stem for path in tmp_path.glob("*.npz")} == {"adaptation", "adaptation-last"}
    assert main(["evaluate", str(SHIPPED), "-o", str(tmp_path / "shipped"), "--n-episodes", "1", "--model", "last"]) == 0
    assert [path.stem for path in (tmp_path / "shipped").glob("*.npz")] == ["adaptation"]


def test_a_model_is_trained_on(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = run_folder(runs) / f"{ENV_ID}.zip"
    assert main(train_arguments(runs / "more", 240, "-i", str(model))) == 0
    assert "Loading pretrained agent" in capsys.readouterr().out
    other = [word.replace("[16]", "[8]", 1) for word in train_arguments(runs / "other", 240, "-i", str(model))]
    with pytest.warns(
        UserWarning, match=r"policy_kwargs \(net_arch\) change nothing, as the networks are those of .*\.zip: leave"
    ):
        main(other)


def test_an_id_may_have_a_dot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is behind it is no suffix of a file."""
    monkeypatch.setitem(gym.registry, "Robot1.5-v0", EnvSpec("Robot1.5-v0", "htr_envs:PointRobotEnv", max_episode_steps=20))
    arguments = [word if word != ENV_ID else "Robot1.5-v0" for word in train_arguments(tmp_path, 240)]
    assert main(arguments) == 0
    assert main(["evaluate", str(tmp_path), "--n-episodes", "1"]) == 0


def test_normalized_runs_are_evaluated_as_they_were_trained(tmp_path: Path) -> None:
    normalize = "policy_kwargs:{'net_arch':[16],'encoder_arch':[16]}"
    assert main([*train_arguments(tmp_path, 480, "--save-replay-buffer", eval_freq=480), normalize]) == 0
    run = run_folder(tmp_path)
    assert (run / "replay_buffer.pkl").exists()
    normalizer = PEARL.load(run / f"{ENV_ID}.zip").policy.normalizer
    assert normalizer is not None and normalizer.count > 479
    assert main(["evaluate", str(run), "--tasks", "validation", "--n-episodes", "2"]) == 0
    # The same model, tasks and seed as in the evaluation during training
    during = np.load(run / "evaluations.npz")["returns"][0]
    np.testing.assert_allclose(np.load(run / "adaptation-validation.npz")["returns"], during, atol=1e-4)


def test_rl_zoo_is_left_as_it_was(runs: Path) -> None:
    assert exp_manager.EvalCallback is EvalCallback and {"ppo", "sac"} < {*rl_zoo3.train.ALGOS}


def test_env_kwargs_of_the_yaml_reach_the_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A zoo trap: rl_zoo3 gives them to the training env only."""
    block = {**{k: v for k, v in TINY.items() if k != "seed"}, "policy": "MlpPolicy", "n_timesteps": 240, "n_envs": 4}
    file = tmp_path / "my.yml"
    file.write_text(yaml.safe_dump({ENV_ID: {**block, "env_kwargs": {"goal_distance": 0.05}}}))
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(file), "--eval-freq", "240", "--verbose", "0"]
    assert main(arguments) == 0
    assert "240 env steps, that of `learn()` for such episodes 150,000: -n 150000 takes it" in capsys.readouterr().out
    assert main([*arguments, "-n", "240"]) == 0
    assert "`learn()`" not in capsys.readouterr().out, "nobody asked"
    # Every goal disc of this distance holds the start, so that all adaptations find it at once
    evaluations = np.load(run_folder(tmp_path) / "evaluations.npz")
    assert evaluations["successes"].all(axis=(0, 1))[0]


def test_the_papers_settings_are_found_by_name_wherever_one_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of one's own of the same name comes first."""
    monkeypatch.chdir(tmp_path)
    arguments = ["train", "--env", ENV_ID, "-conf", "pearl_paper.yml", "--eval-freq", "-1", "--verbose", "0", "-n", "8"]
    tiny = ["n_envs:2", "n_tasks_per_rollout:2", "n_episodes_per_task:1", "gradient_steps:1", "learning_starts:0"]
    assert main([*arguments, "-f", "theirs", "-params", *tiny, "meta_batch_size:2"]) == 0
    assert read_record(run_folder(Path("theirs"), "htr-ser-prior") / RECORD)["hyperparams"]["tau"] == 0.005
    (tmp_path / "pearl_paper.yml").write_text(yaml.safe_dump({ENV_ID: {"policy": "MlpPolicy", "n_timesteps": 8, "tau": 0.1}}))
    assert main([*arguments, "-f", "own", "-params", *tiny, "meta_batch_size:2"]) == 0
    assert read_record(run_folder(Path("own")) / RECORD)["hyperparams"]["tau"] == 0.1


def test_a_run_logs_its_progress_and_its_schedule_needs_no_zoo(tmp_path: Path) -> None:
    env_kwargs = ["--env-kwargs", "max_episode_steps:10"]
    assert main([*train_arguments(tmp_path, 960, *env_kwargs), "learning_rate:'lin_1e-3'"]) == 0
    run = run_folder(tmp_path)
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    assert progress["time/total_timesteps"][-1] == 960 and (progress["rollout/ep_len_mean"] == 10).all()
    trained = np.isfinite(progress["train/critic_loss"])
    assert trained.sum() > 2 and (np.diff(progress["train/learning_rate"][trained]) < 0).all()
    code = "import sys; sys.modules['rl_zoo3'] = None; from sb3_htr import PEARL; print(PEARL.load(sys.argv[1]).learning_rate)"
    command = [sys.executable, "-W", "error", "-c", code, str(run / f"{ENV_ID}.zip")]
    assert "0.001" in subprocess.run(command, capture_output=True, text=True, check=True).stdout


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
    track = ["--track", "--wandb-project-name", "meta", "--seed", "3"]
    arguments = train_arguments(Path("logs"), 240, *track, eval_freq=240)
    assert main(arguments) == 0
    assert begun["project"] == "meta" and begun["sync_tensorboard"] and begun["name"].startswith(f"{ENV_ID}__pearl__3")
    assert config["saved_hyperparams"]["n_tasks_per_rollout"] == 4
    assert list((tmp_path / "runs" / begun["name"]).glob("**/events*"))
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match="pip install wandb"):
        main(arguments)


def test_the_command_line_names_the_last_checkpoint_of_a_run_that_diverged(tmp_path: Path) -> None:
    arguments = train_arguments(tmp_path, 960, "--save-freq", "1")
    with pytest.raises(DivergedError, match=r"at env step \d+.*The last checkpoint: .*checkpoints/\d+_steps\."):
        main([*arguments, "learning_rate:1e20", "gradient_steps:30", "learning_starts:480"])


def test_a_trial_can_be_pruned(tmp_path: Path) -> None:
    class Trial:
        def __init__(self) -> None:
            self.reported: list[tuple[float, int]] = []

        def report(self, value: float, step: int) -> None:
            self.reported.append((value, step))

        def should_prune(self) -> bool:
            return len(self.reported) == 2

    trial = Trial()
    callback = MetaTrialEvalCallback(make_task_vec_env(ENV_ID, 20), cast(Any, trial), eval_freq=20, n_eval_episodes=2)
    model = PEARL("MlpPolicy", ENV_ID, **TINY).learn(2400, callback=callback)
    assert callback.is_pruned and model.num_timesteps == 2 * 20 * 4
    assert [step for _, step in trial.reported] == [1, 2]


# --- hyperparameters


def test_every_hyperparameter_names_its_source() -> None:
    for file in sorted(set(hyperparams_file("pearl.yml").parent.glob("*.yml")) - {hyperparams_file("methods.yml")}):
        for number, line in enumerate(file.read_text().splitlines(), start=1):
            if re.match(r"\s+\w+: *[^&* ]", line) and not line.strip().startswith("#"):
                assert "# " in line, f"{file.name}, line {number}: {line.strip()} has no source"
    # Of methods, the first that has a value
    with_source: set[str] = set()
    for line in hyperparams_file("methods.yml").read_text().splitlines():
        setting, _, source = line.strip().partition("# ")
        if re.match(r"\s+\w+: ", line) and not setting.startswith(("label", "about")):
            assert source or setting.strip() in with_source, f"methods.yml: {setting} has no source"
            with_source.add(setting.strip())


def blocks() -> list[tuple[str, str]]:
    files = sorted(hyperparams_file("pearl.yml").parent.glob("pearl*.yml"))
    return [(file.name, key) for file in files for key in yaml.safe_load(file.read_text())]


@pytest.mark.parametrize(("file", "block"), blocks())
def test_every_block_of_hyperparameters_trains(file: str, block: str) -> None:
    settings = yaml.safe_load(hyperparams_file(file).read_text())[block]
    settings = get_method(settings.pop("method", DEFAULT)).settings(settings)
    settings = MetaExperimentManager._preprocess_schedules(settings)
    env = make_task_vec_env(ENV_ID if block == "default" else block, settings.pop("n_envs"))
    del settings["n_timesteps"]
    # The settings as they are, but a short rollout and two updates
    model = PEARL(env=env, seed=0, **{**settings, "learning_starts": 0, "gradient_steps": 2, "n_episodes_per_task": 1})
    model.learn(1)
    assert model._n_updates == 2
    assert (model.policy.normalizer is None) == (file == "pearl_paper.yml"), "normalized, but not in the papers"


# --- what stays outside


def test_importing_the_library_is_light() -> None:
    """rl_zoo3 would replace gymnasium's TimeLimit for the whole process."""
    heavy = ("rl_zoo3", "htr_envs", "optuna", "matplotlib")
    code = f"import sys, sb3_htr; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_a_training_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    before = list(sys.argv)
    with pytest.raises(ValueError, match="did you mean kl_coef"):
        main([*train_arguments(tmp_path), "kl_coeff:1"])
    assert main([*train_arguments(tmp_path), f"policy_kwargs:{TINY['policy_kwargs']}"]) == 0
    assert sys.argv == before


def test_help_and_mistakes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--help"]) == 0 and "evaluate" in capsys.readouterr().out
    assert main([]) == 2 and "usage: sb3-htr" in capsys.readouterr().err
    assert main(["trian"]) == 2 and "no command 'trian', did you mean train?" in capsys.readouterr().err
    assert main(["--version"]) == 0 and f"sb3_htr {sb3_htr.__version__}" in capsys.readouterr().out
    for command, other in (("train", "optimize"), ("optimize", "train")):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        output = capsys.readouterr().out
        assert output.startswith(f"sb3-htr {command}: ") and f"usage: sb3-htr {command} " in output
        assert f"sb3-htr {other}: " not in output and "--algo {pearl}" in output
    with pytest.raises(SystemExit):
        main(["train", "--env", ENV_ID, "--see", "9"])
    assert "unrecognized arguments: --see 9" in capsys.readouterr().err
    with pytest.raises(ValueError, match="There is no option -par: those with one dash are"):
        main(["train", "--env", ENV_ID, "-par", "gamma:0.9"])
    with pytest.raises(ValueError, match="--algo is 'sac', but sb3-htr trains pearl"):
        main(["train", "--env", ENV_ID, "--algo", "sac"])
    with pytest.raises(FileNotFoundError, match="There is no run in"):
        main(["evaluate", str(tmp_path)])
