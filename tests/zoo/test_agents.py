"""Agents found and shared, and what the commands say to mistakes."""

import ast
import json
import math
import re
import shlex
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.utils import LinearSchedule

import sb3_htr
from helpers import ENV_ID, TINY, MakePEARL
from helpers.runs import NOWHERE, SHIPPED, make_run, run_folder
from sb3_htr import PEARL, load_untrusted
from sb3_htr.adaptation.evaluation import AdaptationRecord, record_adaptation
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.experiments.grid import Variant
from sb3_htr.zoo import cli
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run import model_card
from sb3_htr.zoo.run.agents import agent_at, agent_for, find_runs
from sb3_htr.zoo.run.method import get_method
from sb3_htr.zoo.run.record import RECORD, arguments_to_go_on, command_to_go_on, read_record
from sb3_htr.zoo.run.shipped import hyperparams_file, shipped
from sb3_htr.zoo.run.train_arguments import training_facts


@pytest.fixture
def run(tmp_path: Path, tiny_pearl: MakePEARL) -> Path:
    return make_run(tmp_path / "logs", tiny_pearl())


def test_agents_are_found_by_run_file_and_env(
    run: Path, tiny_pearl: MakePEARL, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    last = make_run(logs, tiny_pearl(), number=12)
    with pytest.raises(FileNotFoundError, match=r"SparsePointRobot-v0 run 77 in .*, only runs 1 \(htr-ser\), 12 \(htr-ser\)"):
        agent_for(ENV_ID, logs, exp_id=77)
    with pytest.raises(ValueError, match=r"evaluations.npz is no model file"):
        agent_at(run / "evaluations.npz")
    unfinished = run_folder(logs, number=13)
    unfinished.mkdir()
    shutil.copy(last / RECORD, unfinished / RECORD)
    assert agent_at(run).path == run / "best_model.zip" and agent_at(run, "last").path == run / f"{ENV_ID}.zip"
    assert agent_at(run / f"{ENV_ID}.zip").folder == run
    assert agent_for(ENV_ID, logs).folder == last, "the latest with a model"
    assert agent_for(ENV_ID, logs, exp_id=1).folder == run
    assert not capsys.readouterr().err
    assert agent_for(ENV_ID, tmp_path).path == SHIPPED
    assert f"{tmp_path}/ has no trained agent for {ENV_ID}, so this one comes with the package" in capsys.readouterr().err
    assert agent_for(ENV_ID, logs, method="htr-ec").path == shipped("trained_agents") / "htr-ec" / f"{ENV_ID}.zip"
    assert f"for {ENV_ID} by htr-ec, so this one" in capsys.readouterr().err, "there are runs, by another method"
    loose = tmp_path / "loose.zip"
    tiny_pearl().save(loose)
    assert agent_at(loose, env_id=ENV_ID).env_id == ENV_ID


def test_a_run_without_a_model_is_left_out(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As one that was killed before its first evaluation."""
    unfinished = run_folder(tmp_path / "logs", number=2)
    unfinished.mkdir()
    shutil.copy(run / RECORD, unfinished / RECORD)
    with pytest.raises(FileNotFoundError, match=r"_2 has no model yet, .*: train anew, as it has no checkpoint either"):
        agent_at(unfinished)
    assert agent_at(tmp_path / "logs").folder == run
    assert f"{unfinished} has no model yet, and is left out." in capsys.readouterr().err


def test_runs_may_be_links_and_count_once(run: Path, tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    other = make_run(tmp_path / "logs", tiny_pearl(), number=2)
    chosen = tmp_path / "chosen"
    chosen.mkdir()
    for name, target in {"one": run, "another": other, "latest": other, "all": chosen}.items():
        (chosen / name).symlink_to(target)
    assert {path.resolve() for path in find_runs(chosen)} == {run, other} and len(find_runs(chosen)) == 2
    (tmp_path / "logs" / "a_link").symlink_to(run)
    assert {*find_runs(tmp_path / "logs")} == {run, other}, "by the names that they have of their own"


def test_the_newest_run_is_the_one_that_was_begun_last(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Also of a copy, whose files were written in another order."""
    for number, started in ((2, "2026-03-01T10:00:00+00:00"), (1, "2026-01-01T10:00:00+00:00")):
        make_run(tmp_path / "copy", tiny_pearl(), number, started=started)
    assert agent_at(tmp_path / "copy").folder == run_folder(tmp_path / "copy", number=2)
    # One that does not say when, as an agent of the Hub, is as new as its file; and a damaged one is not passed over
    pulled = make_run(tmp_path / "copy", tiny_pearl(), 3)
    assert agent_at(tmp_path / "copy").folder == pulled
    (pulled / RECORD).write_text("{")
    with pytest.raises(ValueError, match="is damaged, or no record of a run"):
        agent_at(tmp_path / "copy")


def test_a_folder_of_seeds_is_one_curve_whatever_else_is_in_it(
    run: Path, tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = dict[str, Any]()
    monkeypatch.setattr("sb3_htr.zoo.commands.plot.plot_curves", lambda curves, *_: drawn.update(curves))
    other = make_run(tmp_path / "logs", tiny_pearl(), number=2)
    returns = np.arange(2.0)[:, None, None] * np.ones((2, 20, 4))
    for folder in (run, other):
        np.savez(folder / "evaluations.npz", timesteps=[480, 960], returns=returns, successes=returns > 0.5)
    shutil.copy(run / "best_model.zip", tmp_path / "logs" / "backup.zip")
    assert main(["plot", str(tmp_path / "logs"), "--only", "learning", "-o", str(tmp_path / "plots")]) == 0
    (curve,) = drawn.values()
    assert curve.returns.tolist() == [[0, 1], [0, 1]], "both runs, at both evaluations"


@pytest.mark.parametrize("more", [["--exp-id", "7"], ["--method", "rl2"]])
def test_what_chooses_nothing_is_refused(run: Path, more: list[str]) -> None:
    with pytest.raises(ValueError, match="says which agent, so --exp-id and --method choose nothing"):
        main(["evaluate", str(run), *more])


def test_an_export_replaces_no_model_of_a_run(run: Path) -> None:
    with pytest.raises(ValueError, match=r"best_model\.zip is a model of a run, which needs all of it"):
        main(["export", str(run), "-o", str(run / "best_model.zip")])


def test_what_a_killed_export_left_is_no_second_agent(run: Path, tmp_path: Path) -> None:
    assert main(["export", str(run), "-o", str(tmp_path / "exported"), "--n-episodes", "1"]) == 0
    (file,) = (tmp_path / "exported").glob("*.zip")
    shutil.copy(file, file.with_name(".half.tmp.zip"))
    assert agent_at(tmp_path / "exported").path == file


def test_what_cannot_be_written_is_said_before_the_work(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("was begun")

    monkeypatch.setattr("sb3_htr.zoo.commands.evaluate.record_adaptation", work)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="This is a file, expected a folder"):
        main(["evaluate", str(run), "-o", str(tmp_path / "file")])


def test_agents_that_are_not_there_are_said_to_be_so(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
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
        ([*NOWHERE, "--task", "101"], "There is no test task 101: --task takes numbers from 1 to 100"),
        ([*NOWHERE, "--n-tasks", "0"], "--n-tasks is 0, expected a whole number of at least 1"),
        ([*NOWHERE, "--device", "cudaa"], "The device 'cudaa' cannot be used: give cpu, cuda or cuda:N"),
        ([str(SHIPPED), "--env", "SparseAnt-v0"], "was trained on SparsePointRobot-v0, but --env is SparseAnt-v0"),
        ([*NOWHERE, "--n-episodes", "0"], "--n-episodes is 0, expected a whole number of at least 1"),
        ([*NOWHERE, "--gym-packages", "no_such_module"], "The module no_such_module is asked for, but not found"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            main(["enjoy", "--no-render", *arguments])
    with pytest.raises(SystemExit):
        main(["enjoy"])


def test_export_is_small_exact_and_plain(run: Path, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    schedule, replay = (
        LinearSchedule(1e-3, 0.0, 1.0),
        {"relabel_probability": 0.3, "relabeller": {"name": "EpisodeClustering"}},
    )
    model = tiny_pearl(tensorboard_log=str(tmp_path / "secret"), learning_rate=schedule, replay_buffer_kwargs=replay)
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
    expected = record_adaptation(model, ENV_ID, "validation", n_episodes=3)
    for loaded in (exported, untrusted):
        for ours, theirs in zip(expected, record_adaptation(loaded, ENV_ID, "validation", n_episodes=3), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert exported.num_timesteps == model.num_timesteps and exported.gamma == model.gamma
    for loaded in (exported, untrusted):
        assert str(loaded.learning_rate) == str(schedule) and loaded.replay_buffer_kwargs == replay
    # A start for a training of one's own
    exported = PEARL.load(file, env=model.env)
    exported.learn(500)


def test_what_is_told_of_an_agent_is_of_its_training_wherever_it_is_evaluated(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    easy, few = ["--env-kwargs", "goal_radius:0.6"], ["--n-episodes", "1"]
    scores = []
    for more in ([], easy):
        assert main(["evaluate", str(run), *few, *more, *["--stochastic"] * bool(more)]) == 0
        with np.load(run / "adaptation.npz") as raw:
            scores.append(raw["returns"].mean())
            assert json.loads(str(raw["env_kwargs"])) == ({"goal_radius": 0.6} if more else {})
            assert raw["deterministic"] == (not more)
    assert scores[0] != scores[1]
    with pytest.raises(ValueError, match="--env-kwargs would make a card of another env than that of the training"):
        main(["export", str(run), "-o", str(tmp_path / "agent"), *few, *easy])
    other = run_folder(run.parents[1], number=2)
    shutil.copytree(run, other)
    record = {**json.loads((other / RECORD).read_text()), "env_kwargs": {"goal_radius": 0.6}}
    (other / RECORD).write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"differ in \['env_kwargs'\]"):
        main(["plot", str(run.parent), "--only", "learning", "-o", str(tmp_path), *easy])


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        ("env_wrapper", "gymnasium.wrappers.RecordEpisodeStatistics"),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecCheckNan"),
    ],
)
def test_an_agent_is_tested_in_the_wrappers_of_its_training(
    setting: str, name: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = json.loads((run / RECORD).read_text())
    (run / RECORD).write_text(json.dumps({**record, "hyperparams": {setting: name}}))
    few = ["--n-episodes", "1"]
    with pytest.raises(ValueError, match=f"has {setting}: '{name}', which can run any code: add --trust"):
        main(["evaluate", str(run), *few])
    module, _, of_class = name.rpartition(".")
    made: list[Any] = []
    monkeypatch.setattr(sys.modules[module], of_class, lambda env: made.append(env) or env)  # type: ignore[func-returns-value]
    for arguments in (["evaluate", str(run)], ["export", str(run), "-o", str(tmp_path / "agent")], ["enjoy", str(run)]):
        made.clear()
        more = ["--no-render", "--n-tasks", "1"] if arguments[0] == "enjoy" else []
        assert main([*arguments, *more, *few, "--trust"]) == 0
        assert made, arguments
    with pytest.raises(ValueError, match=f"An experiment has no {setting}"):
        Variant("htr-ser", settings={setting: name})


def test_a_model_of_another_version_is_said_to_be_one(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    tiny_pearl(policy_kwargs={"net_arch": [8], "encoder_arch": [16], "latent_dim": 3}).save(tmp_path / "other.zip")
    with zipfile.ZipFile(SHIPPED) as shipped_file, zipfile.ZipFile(tmp_path / "other.zip") as other:
        with zipfile.ZipFile(tmp_path / "mixed.zip", "w") as mixed:
            for name in shipped_file.namelist():
                mixed.writestr(name, (other if name == "policy.pth" else shipped_file).read(name))
    with pytest.raises(ValueError, match=r"weights in .*mixed.zip do not fit .*: actor.latent_pi.0.weight has shape \(8, 5\)"):
        main(["enjoy", str(tmp_path / "mixed.zip"), "--no-render"])
    with pytest.raises(ValueError, match=r"mixed.zip has other networks than this version makes \(it is of sb3_htr 0.1.0\)"):
        main(["enjoy", str(tmp_path / "mixed.zip"), "--no-render", "--trust"])


def test_an_exported_agent_is_exported_again_in_place(
    tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the scores of its own explorer: one episode of its prior, in place of five."""
    monkeypatch.chdir(tmp_path)
    explorer = {"name": "prior", "n_exploration_episodes": 1}
    make_run(tmp_path / "logs", tiny_pearl(explorer=explorer).learn(480))
    export = ["export", "--n-episodes", "3"]
    assert main([*export, "logs"]) == 0
    folder = tmp_path / "exported" / ENV_ID
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    model = agent_at(folder).load()
    assert isinstance(model, PEARL) and getattr(model.explorer, "n_exploration_episodes", 0) == 1
    assert main([*export, str(folder)]) == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()}.keys() == before.keys()
    env = make_task_vec_env(ENV_ID, 20)
    returns = record_adaptation(model, env, get_task_family(env).test_tasks, 3).returns
    assert f"{returns[:, -1].mean():.2f}" in (folder / "README.md").read_text()
    assert main(["evaluate", str(folder), "--n-episodes", "3", "-o", str(tmp_path)]) == 0
    np.testing.assert_allclose(np.load(tmp_path / "adaptation.npz")["returns"], returns, atol=1e-5)


@pytest.mark.parametrize("explorer", ["belief", {"name": "belief", "margin": 2.0}])
def test_an_explorer_named_by_its_record_is_the_agents_own(explorer: Any, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    """As a word or with settings; and `--explorer` with its name alone is the same in every command."""
    run = make_run(tmp_path / "logs", tiny_pearl(explorer=explorer).learn(480), hyperparams={"explorer": explorer})
    agent = agent_at(run)
    assert agent.explorer == "belief"
    model = agent.load()
    assert isinstance(model, PEARL)
    assert model.start_adaptation(1, "belief").explorer.margin == model.explorer.margin  # type: ignore[attr-defined]
    assert main(["plot", str(run), str(run), "-l", "A", "B", "-o", str(tmp_path / "plots"), "--n-episodes", "2"]) == 0


@pytest.mark.parametrize("defaults", [["--save-freq", "20000"], ["--save-freq", "20000", "--eval-episodes", "20"]])
def test_the_command_of_a_record_is_that_of_any_machine(defaults: list[str]) -> None:
    """What the trained agent was trained by, without local folders and settings, and with the seed that was drawn."""
    arguments = ["--algo", "pearl", "-conf", "/home/me/pearl.yml", "--num-threads", "1", *defaults]
    study = ["--storage", "postgresql://me:secret@db/x", "--study-name=x", "--tensorboard-log=/home/me/tb"]
    arguments += [*study, "-i", "/home/me/agent.zip"]
    arguments += ["--env", ENV_ID, "-f", "/home/me/runs", "-P", "--seed", "3", "-params", "policy_kwargs:{'latent_dim': 3}"]
    command = model_card.training_command({"arguments": arguments, "seed": 4, "method": "htr-ec"})
    params = "-params 'policy_kwargs:{'\"'\"'latent_dim'\"'\"': 3}'"
    assert command == f"sb3-htr train -i agent.zip --env {ENV_ID} {params} --method htr-ec --seed 4"


def test_joined_arguments_keep_folders_to_themselves() -> None:
    """rl_zoo3 takes an option and its value in one word, too."""
    arguments = [f"--env={ENV_ID}", "-f/home/me/runs", "-tb=/home/me/tb", "-i/home/me/agent.zip"]
    command = model_card.training_command({"arguments": [*arguments, "--seed=3"], "seed": 4, "method": "htr-ec"})
    assert command == f"sb3-htr train --env {ENV_ID} -i agent.zip --method htr-ec --seed 4"
    assert training_facts({}, arguments) == training_facts({}, ["-i", "/home/me/agent.zip"])


def test_a_command_to_go_on_names_what_it_needs() -> None:
    record = {"gym_packages": ["mine", "htr_envs"]}
    command = command_to_go_on(Path("runs/a b"), record, trust=True)
    assert command == "sb3-htr train --resume 'runs/a b' --gym-packages mine --trust"


def test_a_command_of_a_model_file_is_a_training_that_runs_no_other_code_or_none() -> None:
    """It is a stranger's, and goes into the card of whoever exports the model again."""

    def shown(command: str) -> str:
        return model_card.training_command({"command": command, "gym_packages": []})

    command = f"sb3-htr train --env {ENV_ID} -params \"policy_kwargs:{{'latent_dim':3}}\" --method htr-ec --seed 3"
    assert shlex.split(shown(command)) == shlex.split(command)
    for other in ("curl https://example.com/x | sh", "sb3-htr optimize", "sb3-htr train 'open", ""):
        assert shown(other) == ""
    for other in ("-params gamma:open('x')", "--gym-packages evil", "--trust", "'a\n```\n$ rm x'", "-f '`rm x`'"):
        assert shown(f"sb3-htr train --env X {other}") == ""
    joined = shown("sb3-htr train --env X; rm -r x\nrm y")
    assert "\n" not in joined and joined in ("", "sb3-htr train --env 'X;' rm -r x rm y")


def test_a_record_may_end_with_an_option() -> None:
    command = model_card.training_command({"arguments": ["-f"], "seed": 4, "method": "htr-ec"})
    assert command == "sb3-htr train --method htr-ec --seed 4"


@pytest.mark.parametrize("file", ["pearl_prior.yml", str(hyperparams_file("pearl_prior.yml").resolve())])
@pytest.mark.parametrize("option", ["-conf", "--conf-file"])
def test_the_command_of_a_record_names_settings_that_everybody_has(file: str, option: str) -> None:
    arguments = ["--env", ENV_ID, option, file]
    command = model_card.training_command({"arguments": arguments, "seed": 4, "method": "htr-ser-prior"})
    assert command == f"sb3-htr train --env {ENV_ID} {option} pearl_prior.yml --method htr-ser-prior --seed 4"


def test_the_command_of_a_run_by_a_file_of_ones_own_trains_the_same_agent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though its name be that of the package's."""
    monkeypatch.chdir(tmp_path)
    block: dict[str, Any] = {key: value for key, value in TINY.items() if key not in ("seed", "gradient_steps")}
    block |= {"policy": "MlpPolicy", "n_timesteps": 480, "n_envs": 4, "env_kwargs": {"goal_distance": 0.3}}
    Path("hyperparams").mkdir()
    Path("hyperparams/pearl.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    arguments = ["train", "--env", ENV_ID, "--eval-freq", "-1", "--seed", "3", "-conf", "hyperparams/pearl.yml"]
    assert main([*arguments, "-params", "gradient_steps:2", "explorer:'prior'"]) == 0
    record = read_record(run_folder(Path("logs")) / RECORD)
    command = model_card.training_command(record)
    shutil.rmtree("hyperparams")
    assert main([*shlex.split(command)[1:], "-f", "again"]) == 0
    assert read_record(run_folder(Path("again")) / RECORD)["hyperparams"] == record["hyperparams"]
    first, second = (PEARL.load(run_folder(Path(folder)) / f"{ENV_ID}.zip") for folder in ("logs", "again"))
    assert all(th.equal(a, b) for a, b in zip(first.policy.parameters(), second.policy.parameters(), strict=True))


def settings_of_package() -> dict[str, Any]:
    block = yaml.safe_load(hyperparams_file("pearl.yml").read_text())["default"]
    return get_method("htr-ser").settings(block)


def test_the_command_of_a_trial_has_what_the_trial_had() -> None:
    """Whoever has the study. What -params gave is among it."""
    arguments = ["--env", ENV_ID, "-params", "gamma:0.9", "n_envs:20", "-n", "480", "--storage", "x.log", "--study-name", "x"]
    found = {"n_timesteps": 480, "learning_rate": "lin_0.002", "gamma": 0.9, "policy_kwargs": {"latent_dim": 3}}
    record: dict[str, Any] = {"arguments": [*arguments, "--trial-id", "7"], "seed": 4, "method": "htr-ser", "env_id": ENV_ID}
    command = model_card.training_command({**record, "hyperparams": {**settings_of_package(), **found}})
    params = ["learning_rate:'lin_0.002'", "gamma:0.9", "policy_kwargs:{'latent_dim': 3}"]
    expected = ["sb3-htr", "train", "--env", ENV_ID, "-n", "480", "--method", "htr-ser", "-params", *params, "--seed", "4"]
    assert shlex.split(command) == expected
    # As one that was trained further, which needs the study no more
    record |= {"arguments": arguments_to_go_on({**record, "trial": found}), "trial": found}
    assert "--trial-id" not in record["arguments"]
    command = model_card.training_command({**record, "hyperparams": {**settings_of_package(), **found}})
    assert shlex.split(command) == expected


@pytest.mark.parametrize(
    "otherwise",
    [
        {"policy_kwargs": {"activation_fn": str(th.nn.Tanh)}},
        {"replay_buffer_kwargs": {"relabel_probability": math.inf}},
        {"n_envs": None},
    ],
)
def test_settings_that_no_command_has_are_in_the_card_alone(otherwise: dict[str, Any]) -> None:
    """A class of one's own, a number without a literal, and a setting of the package's file that one's own leaves out."""
    hyperparams = {**settings_of_package(), **otherwise}
    hyperparams = {key: value for key, value in hyperparams.items() if value is not None}
    record = {"env_id": ENV_ID, "env_kwargs": {}, "gym_packages": [], "num_timesteps": 240, "model": "last", "seed": 4}
    record |= {"arguments": ["--env", ENV_ID, "-conf", "/home/me/pearl.yml"], "method": "htr-ser", "hyperparams": hyperparams}
    record["command"] = model_card.training_command(record)
    assert record["command"] == ""
    adapted = AdaptationRecord(np.ones((2, 3)), np.ones((2, 3), dtype=bool), np.zeros((2, 3, 1, 1), dtype=np.float32))
    card = model_card.model_card(record, {"belief": adapted})
    assert "## Training\n\nThe model after 240 env steps (last)." in card and "sb3-htr train" not in card


def test_a_card_names_all_modules_of_ones_own_at_once() -> None:
    """Of an option that is given twice, the second one counts."""
    packages = ["mine", "metaworld", "yours"]
    record = {"env_id": "Mine-v0", "env_kwargs": {}, "gym_packages": packages, "num_timesteps": 240, "model": "last"}
    adapted = AdaptationRecord(np.ones((2, 3)), np.ones((2, 3), dtype=bool), np.zeros((2, 3, 1, 1), dtype=np.float32))
    for repo_id in (None, "me/pearl-Mine-v0"):
        card = model_card.model_card(record, {"belief": adapted}, repo_id)
        assert " --gym-packages mine yours\n```" in card and card.count("import htr_envs") == 1, "its env may be the package's"


def test_a_run_behind_the_modules_is_no_module(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python would import its folder, and the command say that there is no agent."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"--gym-packages took 'logs' for a module, and it is a folder"):
        main(["enjoy", "--no-render", "--gym-packages", "htr_envs", "logs"])
    assert main(["enjoy", "--gym-packages", "htr_envs", "--no-render", "logs", "--n-tasks", "1", "--n-episodes", "1"]) == 0


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [("train", "rl_zoo3", "zoo"), ("record", "imageio_ffmpeg", "video"), ("plot", "matplotlib", "zoo")],
)
def test_missing_extras_are_named_with_the_pip_command(
    command: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # What is imported anew is not what others have imported
    monkeypatch.setattr(sb3_htr, "zoo", sb3_htr.zoo)
    for name in [name for name in sys.modules if name.startswith("sb3_htr.zoo") and name != "sb3_htr.zoo.cli"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    few = [] if command == "train" else ["--n-episodes", "1"]
    assert main([command, "--env", ENV_ID, *few]) == 1
    assert f"needs {package}, which is not installed: pip install 'sb3_htr[{extra}]'" in capsys.readouterr().err


def test_a_package_that_is_too_old_is_not_said_to_be_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was, with a command that installs nothing, as the package is there."""
    monkeypatch.setattr(sb3_htr, "zoo", sb3_htr.zoo)
    for name in [name for name in sys.modules if name.startswith("sb3_htr.zoo") and name != "sb3_htr.zoo.cli"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "optuna.storages.journal", None)
    assert main(["train", "--env", ENV_ID]) == 1
    said = capsys.readouterr().err
    assert "needs optuna.storages.journal, which another version of optuna has: pip install --upgrade 'sb3_htr[zoo]'" in said


def test_every_package_that_a_command_may_miss_has_its_extra() -> None:
    """A bare ``sb3-htr export`` once said that there is no yaml."""
    installed = {"gymnasium", "numpy", "torch", "stable_baselines3", "sb3_htr", "htr_envs", "tqdm", *sys.stdlib_module_names}
    for file in Path(cli.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for package in {name.split(".")[0] for name in names} - installed:
                assert package in cli.EXTRAS, f"{file.name} imports {package}"


def test_the_console_answers_mistakes_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, message in (
        (["enjoy", "--env", "Nothing-v0"], "There is no trained agent for Nothing-v0"),
        (["enjoy", "--env", ENV_ID, "--algo", "ppo"], "--algo ppo chooses nothing here"),
        (["evaluate", "--env", "SparsePointRobt-v0"], "no such env: did you mean SparsePointRobot-v0"),
        (
            ["train", "--env", ENV_ID, "--env-kwargs", "goal_dist:1"],
            "SparsePointRobot-v0 takes no argument 'goal_dist': leave it out",
        ),
        (["train", "--env", "SparsePointRobt-v0"], "did you mean SparsePointRobot-v0"),
        (["evaluate", str(SHIPPED), "--env-kwargs", "goal_distance:-1"], "goal_distance is -1, expected a number above 0"),
    ):
        monkeypatch.setattr(sys, "argv", ["sb3-htr", *arguments])
        assert cli.console() == 1
        assert re.search(message, capsys.readouterr().err)
    monkeypatch.setenv("SB3_HTR_TRACEBACK", "1")
    with pytest.raises(ValueError, match="goal_distance is -1"):
        cli.console()
    monkeypatch.delenv("SB3_HTR_TRACEBACK")

    def broken(argv: object = None) -> int:
        raise BrokenPipeError("of another process, and not of who reads the output")

    monkeypatch.setattr(cli, "main", broken)
    assert cli.console() == 1 and "sb3-htr: of another process" in capsys.readouterr().err

    def interrupt(argv: object = None) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "main", interrupt)
    assert cli.console() == 130 and "stopped" in capsys.readouterr().err


BUGGY = """
import gymnasium
import htr_envs
import numpy as np

class Buggy(htr_envs.PointRobotEnv):
    def __init__(self, bug=0):
        super().__init__()
        self.bug = bug

    def _step_state(self, action):
        if self.bug == 2:
            raise OSError("No robot")
        return self.sped if self.bug else np.zeros(3) + np.zeros(2)

gymnasium.register("Buggy-v0", Buggy, max_episode_steps=20)
"""


def test_the_console_says_where_an_env_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It may show up after hours, and a second run for a traceback would take as long."""
    (tmp_path / "buggy.py").write_text(BUGGY)
    monkeypatch.chdir(tmp_path)
    for bug, message in (
        (0, r"could not be broadcast .* \(.*buggy\.py, line 14, in _step_state\)\n"),
        (1, r"AttributeError: .*'sped' \(.*buggy\.py, line 14, in _step_state\)\n"),
        (2, r": No robot \(.*buggy\.py, line 13, in _step_state\)\n"),
    ):
        given = ["--env", "Buggy-v0", "--gym-packages", "buggy", "--env-kwargs", f"bug:{bug}"]
        monkeypatch.setattr(sys, "argv", ["sb3-htr", "train", *given])
        assert cli.console() == 1
        assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main([command, "--help"])
    output = capsys.readouterr().out
    assert exit_.value.code == 0 and f"sb3-htr {command}" in output and "examples:" in output


def test_tables_show_the_last_episode() -> None:
    record = AdaptationRecord(np.ones((2, 7)), np.ones((2, 7), dtype=bool), np.zeros((2, 7, 1, 1), dtype=np.float32))
    assert [line.split()[1] for line in model_card.table({"belief": record}).splitlines()[2:]] == ["1", "2", "3", "5", "7"]
    untold = record._replace(successes=~record.successes)
    assert "none known" in model_card.table({"belief": untold}) and "0%" not in model_card.table({"belief": untold})
