"""Nothing is lost: killed and interrupted runs go on as if nothing had happened."""

import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import load_results

from helpers import ENV_ID
from helpers import parameters as model_parameters
from helpers.runs import run_folder
from sb3_htr import PEARL
from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.common.checkpoint import checkpoints, load_latest, write_checkpoint
from sb3_htr.common.checkpoint_callback import CheckpointCallback, cut_monitor_files
from sb3_htr.common.versions import named
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.shipped import hyperparams_file
from sb3_htr.zoo.run.soft_interrupt import soft_interrupt
from sb3_htr.zoo.run.training_manager import TrainingManager

# Rollouts of 4 tasks x 3 episodes x 20 steps, 10 of them, a checkpoint after each
STEPS = 2400
SMALL = ["n_envs:4", "n_tasks_per_rollout:4", "n_episodes_per_task:3", "learning_starts:240", "gradient_steps:4"]
NETS = ["meta_batch_size:8", "batch_size:4", "policy_kwargs:{'net_arch':[16],'encoder_arch':[16],'latent_dim':3}"]
ARGUMENTS = ["train", "--env", ENV_ID, "-n", str(STEPS), "--seed", "3", "--save-freq", "1"]
# Two adaptation episodes show that evaluations are the same, and 20 would take most of the time
ARGUMENTS += ["--eval-freq", "480", "--eval-episodes", "2"]
# Near goals, so that there are rewards to compare
TRAIN = [*ARGUMENTS, "--verbose", "0", "--env-kwargs", "goal_distance:0.4", "-params", *SMALL, *NETS]


def parameters(run: Path) -> dict[str, th.Tensor]:
    model = PEARL.load(run / f"{ENV_ID}.zip", device="cpu")
    tensors = model_parameters(model)
    for name in ("actor.optimizer", "critic.optimizer", "encoder.optimizer"):
        for i, state in model.get_parameters()[name]["state"].items():
            tensors |= {f"{name}.{i}.{key}": value for key, value in state.items()}
    return tensors


def assert_same_run(run: Path, unbroken: Path) -> None:
    ours, theirs = parameters(run), parameters(unbroken)
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert th.equal(ours[name], theirs[name]), name
    a, b = np.load(run / "evaluations.npz"), np.load(unbroken / "evaluations.npz")
    for name in b.files:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    progress = [np.genfromtxt(r / "progress.csv", delimiter=",", names=True, deletechars="") for r in (run, unbroken)]
    assert progress[0].dtype.names is not None
    for name in progress[0].dtype.names:
        if name not in ("time/fps", "time/time_elapsed"):
            np.testing.assert_array_equal(progress[0][name], progress[1][name], err_msg=name)
    seconds = progress[0]["time/time_elapsed"]
    assert (np.diff(seconds[~np.isnan(seconds)]) >= 0).all(), "the clock goes on"
    # The episodes of all monitor files together, each once
    episodes = [load_results(str(r)).sort_values("t") for r in (run, unbroken)]
    assert len(episodes[0]) == len(episodes[1]) == STEPS // 20
    assert sorted(episodes[0]["r"]) == sorted(episodes[1]["r"])


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing happened to."""
    folder = tmp_path_factory.mktemp("unbroken")
    assert main([*TRAIN, "-f", str(folder)]) == 0
    return run_folder(folder)


def cut_off(run: Path, folder: Path) -> Path:
    """A copy of a run as if it had been killed in its last rollout, with all the files of the future still lying around."""
    copy = run_folder(folder / "cut")
    shutil.copytree(run, copy)
    (copy / f"{ENV_ID}.zip").unlink()
    shutil.rmtree(copy / "checkpoints" / f"{STEPS}_steps")
    return copy


def test_a_run_goes_on_exactly(unbroken: Path, tmp_path: Path) -> None:
    """Also once more."""
    run = unbroken
    for which in ("first", "second"):
        run = cut_off(run, tmp_path / which)
        (kept,) = checkpoints(run)
        assert kept.name == "2160_steps"
        assert main(["train", "--resume", str(run)]) == 0
        assert_same_run(run, unbroken)


def test_a_finished_run_says_so(unbroken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}
    assert main(["train", "--resume", str(unbroken)]) == 0
    assert f"{unbroken} is finished, after 2,400 env steps" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in unbroken.rglob("*")}


def test_a_finished_run_without_its_checkpoints_says_so(
    unbroken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_folder(tmp_path)
    shutil.copytree(unbroken, run)
    shutil.rmtree(run / "checkpoints")
    assert main(["train", "--resume", str(run)]) == 0
    assert f"{run} is finished, after 2,400 env steps. Its checkpoints were removed" in capsys.readouterr().out


def test_an_older_checkpoint_has_its_own_episodes(tmp_path: Path) -> None:
    """It went on from a later one, which was found damaged afterwards."""
    first, second = (tmp_path / f"{i}.monitor.csv" for i in range(2))
    first.write_text("123456789")
    cut_monitor_files([first], {first.name: 6})
    second.write_text("abcdefghi")
    cut_monitor_files([first, second], {first.name: 3})
    assert [*tmp_path.iterdir()] == [first] and first.read_text() == "123"


def test_a_run_whose_model_could_not_be_written_is_not_finished(unbroken: Path, tmp_path: Path) -> None:
    """There is a model, of when it was interrupted, and the last checkpoint."""
    run = tmp_path / "run"
    shutil.copytree(unbroken, run)
    model = run / f"{ENV_ID}.zip"
    whole = PEARL.load(model)
    whole.num_timesteps = 240
    whole.save(model)
    assert main(["train", "--resume", str(run)]) == 0
    assert PEARL.load(model).num_timesteps == 2400


def test_a_run_whose_model_is_damaged_is_not_finished(unbroken: Path, tmp_path: Path) -> None:
    """It can be made from the last checkpoint."""
    run = run_folder(tmp_path)
    shutil.copytree(unbroken, run)
    model = run / f"{ENV_ID}.zip"
    content = bytearray(model.read_bytes())
    content[len(content) // 2] ^= 1
    model.write_bytes(content)
    assert main(["train", "--resume", str(run)]) == 0
    assert_same_run(run, unbroken)


def test_training_further_is_as_if_it_had_been_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, planned in (("at_once", "960"), ("further", "480")):
        arguments = [word if word != str(STEPS) else planned for word in TRAIN]
        assert main([*arguments, "learning_rate:1e-3", "-f", str(tmp_path / folder)]) == 0
    at_once, run = (run_folder(tmp_path / folder) for folder in ("at_once", "further"))
    assert main(["train", "--resume", str(run), "-n", "480"]) == 0
    ours, theirs = parameters(run), parameters(at_once)
    assert all(th.equal(ours[name], theirs[name]) for name in theirs)
    record = json.loads((run / "run.json").read_text())
    assert record["n_timesteps"] == record["hyperparams"]["n_timesteps"] == 960
    capsys.readouterr()
    assert main(["train", "--resume", str(run)]) == 0
    output = capsys.readouterr().out
    assert f"{run} is finished, after 960 env steps." in output and f"sb3-htr train --resume {run} -n 1" in output


def test_the_evaluation_at_the_end_of_a_short_training_is_in_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training further, it would be forgotten, and a worse model be the best one."""
    arguments = [word if word != str(STEPS) else "480" for word in TRAIN]
    assert main([*arguments, "--eval-freq", "960", "-f", str(tmp_path)]) == 0
    run = run_folder(tmp_path)
    with np.load(run / "evaluations.npz") as file:
        first = dict(file)
    (returns,), (successes,) = first["returns"], first["successes"]
    worse = AdaptationRecord(returns - 1, successes, np.zeros((*returns.shape, 1, 2)))
    monkeypatch.setattr("sb3_htr.adaptation.callbacks.record_adaptation", lambda *_, **__: worse)
    assert main(["train", "--resume", str(run), "-n", "480"]) == 0
    with np.load(run / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [480, 960]
        np.testing.assert_array_equal(file["returns"], [returns, returns - 1])
    _, state = load_latest(run)
    (of_evaluations,) = (of["state"] for of in state["callbacks"] if "best_mean_reward" in (of["state"] or {}))
    assert of_evaluations["best_mean_reward"] == pytest.approx(first["results"].mean())
    assert PEARL.load(run / "best_model.zip").num_timesteps == 480
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    assert progress["time/total_timesteps"][np.isfinite(progress["eval/mean_reward"])].tolist() == [480, 960]


def test_a_learning_rate_decays_anew_when_training_further(tmp_path: Path) -> None:
    arguments = [word if word != str(STEPS) else "720" for word in TRAIN]
    assert main([*arguments, "learning_rate:'lin_1e-3'", "-f", str(tmp_path)]) == 0
    run = run_folder(tmp_path)
    assert main(["train", "--resume", str(run), "-n", "720"]) == 0
    progress = np.genfromtxt(run / "progress.csv", delimiter=",", names=True, deletechars="")
    steps, rates = progress["time/total_timesteps"], progress["train/learning_rate"]
    # A row is logged before the updates of its rollout, and has the rate of those of the rollout before, that of its beginning
    begun, rates = steps[np.isfinite(rates)] - 2 * 240, rates[np.isfinite(rates)]
    assert len(rates) >= 4
    np.testing.assert_allclose(rates, 1e-3 * (1 - begun / np.where(begun < 720, 720, 1440)), rtol=1e-6)


@pytest.mark.parametrize(
    "settings",
    [
        ["replay_buffer_kwargs:{'relabeller':'EpisodeClustering'}"],
        [NETS[-1].replace("}", ",'normalize_observations':True}"), "ent_coef:'auto'", "learning_rate:'lin_1e-3'"],
        ["train_explorer:'belief'", "explorer:{'name':'prior','n_exploration_episodes':1}"],
        ["env_wrapper:'gymnasium.wrappers.OrderEnforcing'"],  # single envs instead of a batch
        ["policy_kwargs:dict(net_arch=[8],encoder_arch=[8],activation_fn=nn.Tanh)"],  # what JSON has not
    ],
)
def test_runs_of_all_kinds_go_on_exactly(settings: list[str], tmp_path: Path) -> None:
    assert main([*TRAIN, *settings, "-f", str(tmp_path)]) == 0
    run = run_folder(tmp_path)
    copy = cut_off(run, tmp_path)
    assert main(["train", "--resume", str(copy), "--trust"]) == 0  # for the wrapper that is imported
    assert_same_run(copy, run)


def test_tensorboard_shows_each_point_once(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

    def points(name: str) -> list[tuple[int, float]]:
        folder = next((tmp_path / "tb").rglob("events*")).parent
        events = accumulator.EventAccumulator(str(folder))
        events.Reload()
        return [(event.step, event.value) for event in events.Scalars(name)]

    assert main([*TRAIN, "-f", str(tmp_path), "-tb", str(tmp_path / "tb")]) == 0
    names = ["train/critic_loss", "rollout/ep_rew_mean", "eval/mean_reward"]
    before = [points(name) for name in names]
    run = run_folder(tmp_path)
    (run / f"{ENV_ID}.zip").unlink()
    shutil.rmtree(checkpoints(run)[0])
    assert main(["train", "--resume", str(run)]) == 0
    assert [points(name) for name in names] == before


def test_a_run_goes_on_from_another_folder_than_it_was_begun_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    shutil.copy(hyperparams_file("pearl.yml"), "my.yml")
    arguments = [word if word != str(STEPS) else "480" for word in TRAIN]
    assert main([*arguments, "-conf", "my.yml", "-f", "runs", "-tb", "tb"]) == 0
    run = run_folder(Path("runs").resolve())
    (run / f"{ENV_ID}.zip").unlink()
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--resume", str(run)]) == 0
    assert (run / f"{ENV_ID}.zip").exists() and list(Path("there/tb").iterdir()) and not Path("tb").exists()


def test_a_run_goes_on_where_the_package_lies_elsewhere(unbroken: Path, tmp_path: Path) -> None:
    """On another node, or after an update."""
    run = cut_off(unbroken, tmp_path)
    record = json.loads((run / "run.json").read_text())
    record["arguments"] = [str(tmp_path / "gone.yml") if word.endswith("pearl.yml") else word for word in record["arguments"]]
    assert str(tmp_path / "gone.yml") in record["arguments"]
    (run / "run.json").write_text(json.dumps(record))
    assert main(["train", "--resume", str(run)]) == 0
    assert_same_run(run, unbroken)


def test_other_settings_are_refused_again_and_again(unbroken: Path, tmp_path: Path) -> None:
    run = cut_off(unbroken, tmp_path)
    record = json.loads((run / "run.json").read_text())
    # As if the YAML file had been changed since
    record["hyperparams"]["gamma"] = 0.123
    (run / "run.json").write_text(json.dumps(record))
    episodes = (run / "0.monitor.csv").read_bytes()
    for _ in range(2):
        with pytest.raises(ValueError, match=r"The hyperparameters \['gamma'\] have changed"):
            main(["train", "--resume", str(run), "-n", "240"])
        assert json.loads((run / "run.json").read_text()) == record
        assert (run / "0.monitor.csv").read_bytes() == episodes, "older files of these settings may go on from them"
    del record["hyperparams"]["gamma"], record["hyperparams"]["n_timesteps"]
    (run / "run.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"The hyperparameters \['n_timesteps'\] have changed"):
        main(["train", "--resume", str(run)])


def test_the_last_one_cleans_up(unbroken: Path, tmp_path: Path) -> None:
    """Killed after the last checkpoint was written and before older ones were removed, and while writing one."""
    run = cut_off(unbroken, tmp_path)
    shutil.copytree(checkpoints(run)[-1], run / "checkpoints" / "1_steps")
    (run / "checkpoints" / ".240_steps.1.tmp").mkdir()
    assert main(["train", "--resume", str(run)]) == 0
    assert sorted((run / "checkpoints").iterdir()) == sorted(checkpoints(run)) and len(checkpoints(run)) == 2


def test_kills_at_random_moments_change_nothing(unbroken: Path, tmp_path: Path) -> None:
    """SIGKILL of a real process, again and again."""
    n_kills = int(os.environ.get("SB3_HTR_KILLS", 2))
    moments = random.Random(n_kills)
    command = [sys.executable, "-m", "sb3_htr.zoo.cli"]
    run = run_folder(tmp_path)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    kills = 0
    while kills < n_kills:
        again = bool(checkpoints(run))
        if not again:
            shutil.rmtree(run.parent, ignore_errors=True)
        arguments = ["train", "--resume", str(run)] if again else [*TRAIN, "-f", str(tmp_path)]
        process = subprocess.Popen(
            [*command, *arguments], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        # Training proper takes about a second after the imports, so wait for its first sign
        before = {path.name for path in checkpoints(run)}
        while process.poll() is None and {path.name for path in checkpoints(run)} == before:
            time.sleep(0.005)
        time.sleep(moments.uniform(0, 0.15))
        process.kill()
        if process.wait() == -signal.SIGKILL:
            kills += 1
        else:  # it was faster, and is done
            assert_same_run(run, unbroken)
            shutil.rmtree(run.parent)
    (run / f"{ENV_ID}.zip").unlink(missing_ok=True)
    (run / "checkpoints" / ".240_steps.1.tmp").mkdir()  # as a kill while writing leaves it
    assert main(["train", "--resume", str(run)]) == 0
    assert_same_run(run, unbroken)
    assert len(list((run / "checkpoints").iterdir())) == 2


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_with_a_checkpoint_and_says_how_to_go_on(kind: int, unbroken: Path, tmp_path: Path) -> None:
    """As a terminal sends it, and a scheduler, to all processes of the command."""
    command = [sys.executable, "-u", "-m", "sb3_htr.zoo.cli", *TRAIN, "-f", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)
    run = run_folder(tmp_path)
    while process.poll() is None and not checkpoints(run):
        time.sleep(0.005)
    os.killpg(process.pid, kind)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 130, output
    assert f"sb3-htr train --resume {run}" in output
    assert "Press Ctrl-C again" in output
    assert main(["train", "--resume", str(run)]) == 0
    assert_same_run(run, unbroken)


def test_a_second_interrupt_stops_at_once_also_in_a_script_s_background() -> None:
    """Shells start the background commands of scripts with Ctrl-C ignored; who sends it to one of them means it."""

    class Checkpointing:
        stopped = 0

        def stop(self) -> None:
            self.stopped += 1

    checkpointing = Checkpointing()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with soft_interrupt(cast(CheckpointCallback, checkpointing)):
            signal.raise_signal(signal.SIGINT)
            assert checkpointing.stopped == 1
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


FRAGILE = """
import os
import gymnasium
import htr_envs

class Fragile(type(gymnasium.make("SparsePointRobot-v0").unwrapped)):
    n_steps = 0

    def step(self, action):
        self.n_steps += 1
        if self.n_steps == 50:
            os._exit(1)
        return super().step(action)

gymnasium.register("Fragile-v0", Fragile, max_episode_steps=20)
"""


def test_a_dead_env_process_is_named_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fragile.py").write_text(FRAGILE)
    monkeypatch.chdir(tmp_path)
    arguments = ["train", "--env", "Fragile-v0", "--gym-packages", "fragile", "--vec-env", "subproc", "--eval-freq", "-1"]
    with pytest.raises(RuntimeError, match="process of an env died"):
        main([*arguments, "-n", "1000", "-f", "logs", "-params", "n_envs:1", "gradient_steps:1"])


def test_a_full_disk_stops_no_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sb3_htr.common.checkpoint_callback as module

    calls = []

    def write(folder: Path, state: dict[str, Any]) -> None:
        calls.append(folder)
        if len(calls) in (2, 3):
            raise OSError(28, "No space left on device")
        write_checkpoint(folder, state)

    monkeypatch.setattr(module, "write_checkpoint", write)
    with pytest.warns(UserWarning, match="No space left on device.*Training goes on"):
        assert main([*TRAIN, "--eval-freq", "-1", "-n", "1440", "-f", str(tmp_path)]) == 0
    steps = [int(folder.name.split("_")[0]) for folder in calls]
    assert np.diff(steps).tolist() == [240] * (len(steps) - 1), "the next rollout tries again"
    assert len(checkpoints(run_folder(tmp_path))) == 2


def test_extra_arguments_are_refused(unbroken: Path, tmp_path: Path) -> None:
    run = cut_off(unbroken, tmp_path)
    with pytest.raises(ValueError, match=r"own arguments: leave --seed 5 out"):
        main(["train", "--resume", str(run), "--seed", "5"])
    with pytest.raises(ValueError, match=r"own arguments: leave --method out"):
        main(["train", "--resume", str(run), "--method", "htr-ec"])
    with pytest.raises(ValueError, match=r"own arguments: leave --algo out"):
        main(["train", "--resume", str(run), "--algo", "rl2"])
    with pytest.raises(ValueError, match="-n is -240, expected"):
        main(["train", "--resume", str(run), "-n", "-240"])


def test_a_run_that_goes_on_with_other_code_says_so(unbroken: Path, tmp_path: Path) -> None:
    """Defaults are of the code. And what is told of the run tells of both, however often it goes on."""
    run = cut_off(unbroken, tmp_path)
    record = json.loads((run / "run.json").read_text())
    code = {"commit": "0123456789", "clean": True, "versions": {**record["versions"], "torch": "1.0"}}
    before = {**record, **code, "hardware": ["a GPU"]}
    (run / "run.json").write_text(json.dumps(before))
    with pytest.warns(UserWarning, match=r"other code .*torch 1\.0 -> .*commit 0123456789 -> "):
        assert main(["train", "--resume", str(run)]) == 0
    (resumed,) = json.loads((run / "run.json").read_text())["resumed_by"]
    assert resumed["from"] == 2160
    assert resumed["versions"] == record["versions"]
    again = cut_off(run, tmp_path / "again")
    assert main(["train", "--resume", str(again)]) == 0
    after = json.loads((again / "run.json").read_text())
    assert after == {**before, "hardware": ["a GPU", *record["hardware"]], "resumed_by": [resumed]}
    assert named(after) == f"{named(before)}, then {named(record)}"


def test_a_run_that_goes_on_with_other_changes_says_so(
    unbroken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one commit, where it says as little as that there are some."""
    run = cut_off(unbroken, tmp_path)
    record = json.loads((run / "run.json").read_text())
    digest = record["code"]
    (run / "run.json").write_text(json.dumps({**record, "code": "0123456789abcdef"}))
    with pytest.warns(UserWarning, match=rf"goes on with other code \(code 0123456789 -> {digest[:10]}\)"):
        assert main(["train", "--resume", str(run)]) == 0
    (resumed,) = json.loads((run / "run.json").read_text())["resumed_by"]
    assert resumed["code"] == digest
    older = cut_off(unbroken, tmp_path / "older")
    without = {key: value for key, value in record.items() if key != "code"}
    (older / "run.json").write_text(json.dumps(without))
    assert main(["train", "--resume", str(older)]) == 0
    assert json.loads((older / "run.json").read_text()) == without


class InterruptsOnce(BaseCallback):
    """As Ctrl-C does, in the second rollout, unless it did so before."""

    done = False

    def _on_step(self) -> bool:
        if not InterruptsOnce.done and self.num_timesteps > 300:
            InterruptsOnce.done = True
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize(("given", "trust"), [(["-n720"], False), (["-n", "720"], True)])
def test_the_command_that_is_printed_to_go_on_is_taken(
    given: list[str], trust: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user may have said what a file, which may come from a stranger, may not."""
    monkeypatch.setattr(InterruptsOnce, "done", False)
    if trust:
        settings = [f"callback:'{__name__}.InterruptsOnce'"]
    else:
        settings = []
        learn = TrainingManager.learn

        def interrupted(manager: Any, model: Any) -> None:
            manager.callbacks.append(InterruptsOnce())
            learn(manager, model)

        monkeypatch.setattr(TrainingManager, "learn", interrupted)
    few = ["train", "--env", ENV_ID, "-f", str(tmp_path), "--save-freq", "1", "--eval-freq", "-1", "--verbose", "0"]
    with pytest.raises(KeyboardInterrupt):
        main([*few, *given, "-params", *SMALL, *NETS, *settings])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("To go on: "))
    assert ("--trust" in line) == trust
    assert main(shlex.split(line)[4:]) == 0
    assert PEARL.load(run_folder(tmp_path) / f"{ENV_ID}.zip").num_timesteps == 720


def test_an_empty_folder_is_the_working_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a variable that is not set; and not the root of the disk."""
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--env", ENV_ID, "-n", "1", "-f", "", "--eval-freq", "-1", "--verbose", "0", "-params", *SMALL]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["htr-ser"]


def test_a_run_that_may_not_go_on_has_the_plan_that_it_had(
    unbroken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked for again, it would train as much longer as it was refused."""

    def refuse(*_: Any) -> None:
        raise ValueError("The env has other rewards.")

    run = run_folder(tmp_path)
    shutil.copytree(unbroken, run)
    with monkeypatch.context() as context:
        context.setattr("sb3_htr.zoo.run.training_manager.CheckpointCallback.restore", refuse)
        with pytest.raises(ValueError, match="other rewards"):
            main(["train", "--resume", str(run), "-n", "240"])
    assert json.loads((run / "run.json").read_text()) == json.loads((unbroken / "run.json").read_text())
