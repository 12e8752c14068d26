"""Agents found, watched, filmed, drawn and shared."""

import json
import re
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch as th
import yaml
from conftest import ENV_ID, TINY

from sb3_htr import PEARL, evaluate_adaptation, load_untrusted
from sb3_htr.adaptation.evaluation import AdaptationRecord, record_adaptation
from sb3_htr.zoo import cli, model_card, window
from sb3_htr.zoo.run.agents import RECORD, agent_at, agent_for
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands.export import push_to_hub
from sb3_htr.zoo.show.play import Moment, Player
from sb3_htr.zoo.commands.plot import check_same_settings
from sb3_htr.zoo.run.shipped import shipped

SHIPPED = shipped("trained_agents") / "htr-ser" / f"{ENV_ID}.zip"
# Finds no agent there, so that the shipped one is taken
NOWHERE = ["--env", ENV_ID, "-f", "/nowhere"]


def make_run(folder: Path, model: PEARL, number: int = 1, **record: Any) -> Path:
    """A run folder as a training leaves it, of two evaluations."""
    run = folder / "pearl" / f"{ENV_ID}_{number}"
    run.mkdir(parents=True)
    settings = {"env_id": ENV_ID, "env_kwargs": {}, "gym_packages": [], "seed": number, "n_timesteps": 960, "hyperparams": {}}
    arguments = [
        "--algo",
        "pearl",
        "-conf",
        "x.yml",
        "--num-threads",
        "1",
        "--save-freq",
        "20000",
        "-f",
        "runs",
        "--env",
        ENV_ID,
    ]
    (run / RECORD).write_text(json.dumps({**settings, "arguments": arguments, **record}))
    model.save(run / "best_model.zip")
    model.save(run / f"{ENV_ID}.zip")
    returns = np.random.default_rng(number).uniform(size=(2, 20, 4))
    np.savez(
        run / "evaluations.npz", timesteps=[480, 960], results=returns[:, :, -1], returns=returns, successes=returns > 0.5
    )
    return run


@pytest.fixture
def run(tmp_path: Path, tiny_pearl: Callable[..., PEARL]) -> Path:
    return make_run(tmp_path / "logs", tiny_pearl())


def test_agents_are_found_by_run_file_and_env(run: Path, tiny_pearl: Callable[..., PEARL], tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    last = make_run(logs, tiny_pearl(), number=12)
    with pytest.raises(FileNotFoundError, match=r"SparsePointRobot-v0 run 77 in .*, only runs 1 \(pearl\), 12 \(pearl\)"):
        agent_for(ENV_ID, logs, exp_id=77)
    with pytest.raises(ValueError, match=r"evaluations.npz is no model file"):
        agent_at(run / "evaluations.npz")
    unfinished = logs / "pearl" / f"{ENV_ID}_13"
    unfinished.mkdir()
    shutil.copy(last / RECORD, unfinished / RECORD)
    assert agent_at(run).path == run / "best_model.zip" and agent_at(run, "last").path == run / f"{ENV_ID}.zip"
    assert agent_at(run / f"{ENV_ID}.zip").folder == run
    assert agent_for(ENV_ID, logs).folder == last, "the latest with a model"
    assert agent_for(ENV_ID, logs, exp_id=1).folder == run
    assert agent_for(ENV_ID, tmp_path).path == SHIPPED == agent_for(ENV_ID, logs, method="htr-ser").path
    loose = tmp_path / "loose.zip"
    tiny_pearl().save(loose)
    assert agent_at(loose, env_id=ENV_ID).env_id == ENV_ID


def test_agents_that_are_not_there_are_said_to_be_so(tmp_path: Path, tiny_pearl: Callable[..., PEARL]) -> None:
    (tmp_path / "text.zip").write_text("no model")
    tiny_pearl().save(tmp_path / "loose.zip")
    for arguments, message in (
        (
            ["--env", "CartPole-v1"],
            r"no trained agent for CartPole-v1 in logs/: train one with .*SparsePointRobot-v0 \(htr-ser\)",
        ),
        (["--env", ENV_ID, "--exp-id", "7"], "no trained agent for SparsePointRobot-v0 run 7"),
        ([str(tmp_path / "text.zip")], "is no model file"),
        ([str(tmp_path / "absent")], "absent does not exist: give a run folder"),
        ([str(tmp_path / "loose.zip")], "does not say which env it was trained on: add --env ID"),
        ([*NOWHERE, "--task", "21"], "There is no test task 21: --task takes numbers from 1 to 20"),
        ([*NOWHERE, "--n-tasks", "0"], "--n-tasks is 0, expected at least 1"),
        ([*NOWHERE, "--device", "cudaa"], "The device 'cudaa' cannot be used: give cpu, cuda or cuda:N"),
        ([str(SHIPPED), "--env", "SparseAnt-v0"], "was trained on SparsePointRobot-v0, but --env is SparseAnt-v0"),
        ([*NOWHERE, "--n-episodes", "0"], "--n-episodes is 0, expected at least 1"),
        ([*NOWHERE, "--gym-packages", "no_such_module"], "The env needs the module no_such_module"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            main(["enjoy", "--no-render", *arguments])
    with pytest.raises(SystemExit):
        main(["enjoy"])


def test_enjoy_shows_an_agent_that_adapts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["enjoy", *NOWHERE, "--no-render", "--n-tasks", "50", "--n-episodes", "1"]) == 0
    assert "There are only 20 test tasks, fewer than --n-tasks 50" in capsys.readouterr().out
    assert main(["enjoy", *NOWHERE, "--no-render", "--n-tasks", "2", "--n-episodes", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    episodes = [line for line in lines if line.startswith("  episode")]
    assert len(episodes) == 12 and "explores" in episodes[6] and "adapted" in episodes[11] and "solved" in episodes[11]
    deviations = [float(line.split()[-1]) for line in episodes]
    assert deviations[11] < 0.2 * deviations[6], "z is known better once the task is"
    assert lines[-1].startswith("Solved 2 of 2 tasks")


def test_enjoy_needs_no_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["enjoy", *NOWHERE, "--task", "3", "--n-episodes", "1"]) == 0
    output = capsys.readouterr().out
    assert "Numbers only: no screen" in output and "test task 3 of 20" in output


def test_enjoy_ends_with_its_window_or_its_steps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[np.ndarray] = []

    class Window:
        def __init__(self, title: str, fps: float) -> None:
            assert ENV_ID in title and fps == 10

        def show(self, frame: np.ndarray) -> bool:
            shown.append(frame)
            return len(shown) < 30

        def close(self) -> None:
            shown.append(np.zeros(0))

    monkeypatch.setattr(window, "Window", Window)
    assert main(["enjoy", *NOWHERE]) == 0
    assert len(shown) == 31 and shown[0].shape == shown[29].shape and (shown[0] != shown[29]).any()
    assert main(["enjoy", *NOWHERE, "-n", "45", "--no-render"]) == 0
    assert capsys.readouterr().out.splitlines()[-2].startswith("  episode   2")


@pytest.mark.parametrize("explorer", ["search", "prior", "aggregate"])
def test_what_is_played_is_what_is_evaluated(explorer: str) -> None:
    model, env = PEARL.load(SHIPPED), gym.make(ENV_ID)
    tasks = env.unwrapped.task_family.test_tasks  # type: ignore[attr-defined]
    returns, successes = evaluate_adaptation(model, env, tasks[4:5], n_episodes=7, explorer=explorer, seed=3)
    moments = list(Player(model, env, lambda obs: obs, explorer, seed=3).play(tasks, 5, 7))
    np.testing.assert_allclose(moments[-1].returns, returns[0], atol=1e-5)
    assert moments[-1].successes == tuple(successes[0]) and len(moments) == 7 * 21
    before = [moment.deviation for moment in moments if moment.exploring and not moment.ended]
    assert min(before) > 0.1 and (explorer != "prior" or set(before) == {1.0})


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_record_makes_a_film(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / f"film{suffix}"
    arguments = ["--n-tasks", "1", "--n-episodes", "2", "--every", "5", "-o", str(film), "--verbose", "0"]
    assert main(["record", *NOWHERE, *arguments]) == 0
    frames = iio.imread(film)
    assert "10 frames" in capsys.readouterr().out and len(frames) >= 9
    height, width = frames.shape[1:3]
    assert width == 400 and 400 < height < 520 and height % 2 == 0
    assert (frames[0, :400] != frames[-1, :400]).any(), "the robot moves"
    assert (frames[0, 400:] != frames[-1, 400:]).any(), "and so does the caption"


def test_films_that_cannot_be_made(tmp_path: Path, tiny_pearl: Callable[..., PEARL], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"the suffix '.avi', expected one of .mp4, .gif"):
        main(["record", *NOWHERE, "-o", "film.avi"])
    with pytest.raises(ValueError, match="--every is 0"):
        main(["record", *NOWHERE, "--every", "0"])
    monkeypatch.setattr("sb3_htr.zoo.commands.record.MAX_GIF_FRAMES", 5)
    with pytest.raises(ValueError, match="A gif holds at most 5 frames"):
        main(["record", *NOWHERE, "-o", str(tmp_path / "film.gif"), "--verbose", "0"])
    assert not list(tmp_path.iterdir()), "no half of a film is left"


def test_plot_draws_all_pictures_of_an_agent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", *NOWHERE, "--n-episodes", "6", "-o", str(tmp_path)]) == 0
    names = {"adaptation_curve.png", "adaptation_paths.png", "latent_space.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert all(path.stat().st_size > 10_000 for path in tmp_path.iterdir())
    assert "No learning curves" in capsys.readouterr().out


def test_plot_draws_seeds_as_one_curve(
    tmp_path: Path, tiny_pearl: Callable[..., PEARL], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        for number in (1, 2):
            make_run(folder, tiny_pearl(seed=number), number)
    arguments = [*map(str, folders), "--n-episodes", "2", "-o", str(tmp_path / "plots")]
    assert main(["plot", *arguments]) == 0
    output = capsys.readouterr().out
    assert "learning_curves.png" in output and "adaptation_curve.png" in output and "No latent space: one found" in output
    with pytest.raises(ValueError, match="--labels needs one name of its own for each of the 2 folders"):
        main(["plot", *arguments, "-l", "same", "same"])
    with pytest.raises(ValueError, match=r"The runs in one differ in \['gamma'\]"):
        make_run(folders[0], tiny_pearl(), 3, hyperparams={"gamma": 0.5})
        main(["plot", *arguments])
    check_same_settings("none", [])


def test_export_is_small_exact_and_plain(run: Path, tmp_path: Path, tiny_pearl: Callable[..., PEARL]) -> None:
    model = tiny_pearl(tensorboard_log=str(tmp_path / "secret"))
    model.learn(500)
    model.save(run / "best_model.zip")
    file = tmp_path / "agent.zip"
    assert main(["export", str(run), "-o", str(file)]) == 0
    assert file.stat().st_size < 0.6 * (run / "best_model.zip").stat().st_size
    with zipfile.ZipFile(file) as archive:
        data = json.loads(archive.read("data"))
        optimizer = th.load(archive.open("critic.optimizer.pth"), weights_only=True)
    assert optimizer["state"] == {} and b"secret" not in file.read_bytes()
    assert not {"_last_obs", "ep_info_buffer", "_rng", "tensorboard_log", "_task_queue"} & data.keys()
    exported, untrusted = PEARL.load(file), load_untrusted(file, ENV_ID)
    expected = record_adaptation(model, ENV_ID, n_episodes=3)
    for loaded in (exported, untrusted):
        for ours, theirs in zip(expected, record_adaptation(loaded, ENV_ID, n_episodes=3), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert exported.num_timesteps == model.num_timesteps and exported.gamma == model.gamma
    # A start for a training of one's own
    exported = PEARL.load(file, env=model.env)
    exported.learn(500)


def test_a_model_of_another_version_is_said_to_be_one(tmp_path: Path, tiny_pearl: Callable[..., PEARL]) -> None:
    tiny_pearl(policy_kwargs={"net_arch": [8], "encoder_arch": [16], "latent_dim": 3}).save(tmp_path / "other.zip")
    with zipfile.ZipFile(SHIPPED) as shipped_file, zipfile.ZipFile(tmp_path / "other.zip") as other:
        with zipfile.ZipFile(tmp_path / "mixed.zip", "w") as mixed:
            for name in shipped_file.namelist():
                mixed.writestr(name, (other if name == "policy.pth" else shipped_file).read(name))
    with pytest.raises(ValueError, match=r"mixed.zip has other networks than this version makes \(it is of sb3_htr 0.1.0\)"):
        main(["enjoy", str(tmp_path / "mixed.zip"), "--no-render"])


def test_a_folder_to_share_says_how_to_use_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    uploaded = {}

    class HfApi:
        def create_repo(self, repo_id: str, private: bool, exist_ok: bool) -> Any:
            assert private and exist_ok
            return type("RepoUrl", (str,), {"repo_id": repo_id})(f"https://hub/{repo_id}")

        def upload_folder(self, repo_id: str, folder_path: Path, commit_message: str) -> None:
            uploaded[repo_id] = {path.name for path in folder_path.iterdir()}

    monkeypatch.setattr("huggingface_hub.HfApi", HfApi)
    arguments = ["export", *NOWHERE, "--n-episodes", "6", "-o", str(tmp_path), "--push-to-hub", "me/agent", "--private"]
    assert main(arguments) == 0
    assert uploaded == {"me/agent": {"README.md", f"{ENV_ID}.zip"}}
    assert "Uploaded to https://hub/me/agent" in capsys.readouterr().out
    monkeypatch.setattr(HfApi, "upload_folder", lambda *_, **__: (_ for _ in ()).throw(ConnectionError("no network")))
    with pytest.raises(OSError, match=f"The upload to me/agent failed, the files are in {tmp_path}: no network"):
        push_to_hub(tmp_path, "me/agent", private=True)
    card = (tmp_path / "README.md").read_text()
    metadata = yaml.safe_load(card.split("---")[1])
    assert metadata["library_name"] == "stable-baselines3" and ENV_ID in metadata["tags"]
    value = metadata["model-index"][0]["results"][0]["metrics"][0]["value"]
    returns, _ = evaluate_adaptation(PEARL.load(SHIPPED), ENV_ID, n_episodes=6)
    assert (
        value == f"{returns[:, -1].mean():.2f} +/- {returns[:, -1].std():.2f}" and f"| {value.replace('+/-', '±')} |" in card
    )
    assert "sb3-htr train --env SparsePointRobot-v0 --eval-freq 10000 --seed 1" in card
    # The snippet, with the download replaced by the file
    monkeypatch.setattr("huggingface_hub.hf_hub_download", lambda repo, name: str(tmp_path / name))
    exec(re.findall(r"```python\n(.*?)```", card, re.DOTALL)[0], {})
    assert main(["enjoy", str(tmp_path), "--no-render", "--n-tasks", "1", "--n-episodes", "1"]) == 0


def test_normalized_agents_are_exported_with_their_statistics(tmp_path: Path) -> None:
    settings = {key: value for key, value in TINY.items() if key != "seed"}
    block = {**settings, "policy": "MlpPolicy", "n_timesteps": 480, "n_envs": 4, "normalize": {"norm_reward": False}}
    (tmp_path / "my.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(tmp_path / "my.yml"), "--eval-freq", "-1"]
    assert main([*arguments, "--verbose", "0"]) == 0
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "agent.zip")]) == 0
    folder, file = agent_at(tmp_path / "pearl"), agent_at(tmp_path / "agent.zip")
    assert file.record["normalize"] == folder.normalize_statistics() is not None
    records = [record_adaptation(agent.load(), agent.make_vec_env(20), n_episodes=2) for agent in (folder, file)]
    np.testing.assert_array_equal(records[0].achieved, records[1].achieved)
    assert main(["enjoy", str(tmp_path / "agent.zip"), "--no-render", "--n-tasks", "1", "--n-episodes", "2"]) == 0


def test_methods_and_commands_of_records() -> None:
    buffer: dict[str, Any] = {"relabel_probability": 0.0}
    assert model_card.method({}) == "htr-ser" and model_card.method({"replay_buffer_kwargs": buffer}) == "pearl-sparse"
    assert model_card.method({"replay_buffer_kwargs": {**buffer, "rl_reward_type": "dense"}}) == "pearl-dense"
    assert model_card.method({"replay_buffer_class": "EpisodeClustering"}) == "htr-ec"
    arguments = ["--algo", "pearl", "-conf", "/home/me/pearl.yml", "--num-threads", "1", "--save-freq", "20000"]
    arguments += ["--env", ENV_ID, "-f", "/home/me/runs", "-P", "--seed", "3", "-params", "policy_kwargs:{'latent_dim': 3}"]
    command = model_card.training_command({"arguments": arguments, "seed": 3})
    assert command == f"sb3-htr train --env {ENV_ID} -params 'policy_kwargs:{{'\"'\"'latent_dim'\"'\"': 3}}' --seed 3"


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [("train", "rl_zoo3", "zoo"), ("record", "imageio_ffmpeg", "video"), ("plot", "matplotlib", "plots")],
)
def test_missing_extras_are_named_with_the_pip_command(
    command: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("sb3_htr.zoo") and name != "sb3_htr.zoo.cli"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    assert main([command, "--env", ENV_ID]) == 1
    assert f"needs {package}, which is not installed: pip install 'sb3_htr[{extra}]'" in capsys.readouterr().err


def test_the_console_answers_mistakes_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, message in (
        (["enjoy", "--env", "Nothing-v0"], "There is no trained agent for Nothing-v0"),
        (["train", "--env", ENV_ID, "--env-kwargs", "goal_dist:1"], "TypeError: .* unexpected keyword argument 'goal_dist'"),
        (["train", "--env", "SparsePointRobt-v0"], "you maybe meant SparsePointRobot-v0"),
        (["evaluate", str(SHIPPED), "--env-kwargs", "goal_distance:-1"], "goal_distance is -1, expected a number above 0"),
    ):
        monkeypatch.setattr(sys, "argv", ["sb3-htr", *arguments])
        assert cli.console() == 1
        assert re.search(message, capsys.readouterr().err)
    monkeypatch.setenv("SB3_HTR_TRACEBACK", "1")
    with pytest.raises(ValueError):
        cli.console()


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main([command, "--help"])
    output = capsys.readouterr().out
    assert exit_.value.code == 0 and f"sb3-htr {command}" in output and "examples:" in output


def test_captions_know_what_was_worst(tmp_path: Path) -> None:
    from sb3_htr.zoo.show.captions import Captioner

    captioner = Captioner()
    frame = np.zeros((101, 201, 3), dtype=np.uint8)
    first = captioner(frame, Moment(1, 20, 3, 0, (0.0,), (False,), True, 0.5, False))
    last = captioner(frame, Moment(1, 20, 3, 9, (0.0, -2.0, 5.0), (False, False, True), False, 0.05, True))
    assert first.shape == last.shape and first.shape[0] % 2 == first.shape[1] % 2 == 0
    assert (first[:101, :201] == 0).all(), "the frame itself is not touched"
    dark = [(picture[101:] < 60).all(axis=-1).sum() for picture in (first, last)]
    assert dark[1] < dark[0], "the bar of the uncertainty is shorter"


def test_tables_show_the_last_episode() -> None:
    record = AdaptationRecord(np.ones((2, 7)), np.ones((2, 7), dtype=bool), np.zeros((2, 7, 1, 1), dtype=np.float32))
    assert [line.split()[1] for line in model_card.table({"search": record}).splitlines()[2:]] == ["1", "2", "3", "5", "7"]
