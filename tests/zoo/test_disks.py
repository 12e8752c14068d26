"""A disk that fills up ends no training, and what was lost for want of it comes back."""

import errno
import re
import shutil
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import load_results

from helpers import ENV_ID, ROLLOUT, TINY, MakePEARL
from helpers import parameters as parameters_of
from helpers.disks import disk
from helpers.runs import run_folder, train_arguments
from sb3_htr import PEARL
from sb3_htr.common.checkpoint import checkpoints, load_latest
from sb3_htr.common.checkpoint_callback import CheckpointCallback
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.callbacks import PatientCSV, ProgressCallback

SETTINGS = ["--seed", "3", "--save-freq", "1", "--env-kwargs", "goal_distance:0.4", "n_validation_tasks:1"]


def full(*_: Any, **__: Any) -> None:
    """In the place of what writes."""
    raise OSError(errno.ENOSPC, "No space left on device")


def parameters(folder: Path) -> dict[str, th.Tensor]:
    return parameters_of(PEARL.load(run_folder(folder) / f"{ENV_ID}.zip"))


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, th.Tensor]:
    """What is learnt on a disk that is large enough."""
    folder = tmp_path_factory.mktemp("unbroken")
    assert main(train_arguments(folder, 960, *SETTINGS, eval_freq=480)) == 0
    return parameters(folder)


@pytest.mark.parametrize(
    ("kilobytes", "lost"), [(20, "progress.csv"), (64, "best_model.zip"), (3000, "480_steps"), (8000, "720_steps")]
)
def test_a_disk_of_any_size(kilobytes: int, lost: str, unbroken: dict[str, th.Tensor], tmp_path: Path) -> None:
    with disk(tmp_path, kilobytes) as folder, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            assert main(train_arguments(folder, 960, *SETTINGS, eval_freq=480)) == 0
            refused = ""
        except OSError as error:
            refused = str(error)
        assert any(lost in str(warning.message) and "Training goes on" in str(warning.message) for warning in said)
        run = run_folder(folder)
        if refused:
            assert re.search(rf"{run}/?\S* could not be written", refused)
            assert (f"--resume {run}" if checkpoints(run) else "train again") in refused
        if checkpoints(run):
            subprocess.run(["mount", "-o", "remount,size=40000k", str(folder)], check=True)
            (run / f"{ENV_ID}.zip").unlink(missing_ok=True)
            assert main(["train", "--resume", str(run)]) == 0
            for name, values in parameters(folder).items():
                assert th.equal(values, unbroken[name]), name
            for name in ("best_model.zip", "evaluations.npz", "progress.csv", "checkpoints/960_steps"):
                assert (run / name).exists(), name


@pytest.mark.parametrize(
    ("writer", "lost"),
    [
        ("numpy.savez_compressed", "evaluations.npz"),
        ("sb3_htr.PEARL.save_replay_buffer", "replay_buffer.pkl"),
        ("sb3_htr.PEARL.save", f"{ENV_ID}.zip"),
        ("sb3_htr.zoo.run.callbacks.PatientCSV.save", "progress.csv"),
    ],
)
def test_what_had_no_room_at_the_end_is_said_and_comes_back(
    writer: str, lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without it is not finished."""
    arguments = train_arguments(tmp_path, 480, *SETTINGS, "--save-replay-buffer", eval_freq=240)
    run = run_folder(tmp_path)

    with monkeypatch.context() as patch, warnings.catch_warnings(record=True):
        patch.setattr(writer, full)
        with pytest.raises(
            OSError, match=rf"^{run / lost} could not be written \(No space .* and `sb3-htr train --resume {run}` goes on"
        ):
            main(arguments)
    assert not (run / lost).exists()
    assert main(["train", "--resume", str(run)]) == 0
    assert (run / lost).exists() and (run / f"{ENV_ID}.zip").exists()


def test_what_no_checkpoint_has_is_written_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PEARL, "save_replay_buffer", full)
    with pytest.raises(OSError, match=r"replay_buffer\.pkl could not be written .* there is no checkpoint"):
        main(train_arguments(tmp_path, 480, "--save-freq", "-1", "--save-replay-buffer"))
    assert (run_folder(tmp_path) / f"{ENV_ID}.zip").exists()


def test_a_run_that_was_removed_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save, run = PEARL.save, run_folder(tmp_path)

    def removed(*args: Any) -> None:
        shutil.rmtree(run)
        save(*args)

    monkeypatch.setattr(PEARL, "save", removed)
    with pytest.raises(OSError, match=rf"{run} was removed during the training: .* last model"):
        main(train_arguments(tmp_path, 480))


def test_a_disk_that_is_full_before_the_training_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_htr.zoo.run.training_manager.write_record", full)
    with pytest.raises(OSError, match=rf"No space left on device: '{run_folder(tmp_path)}'"):
        main(train_arguments(tmp_path, 480))


class Then(BaseCallback):
    """Does something when so many env steps are done."""

    def __init__(self, steps: int, action: Callable[[], object]) -> None:
        super().__init__()
        self.steps, self.action = steps, action

    def _on_step(self) -> bool:
        if self.num_timesteps == self.steps:
            self.action()
        return True


def test_a_monitor_file_without_room_ends_no_training(tmp_path: Path) -> None:
    with disk(tmp_path, 8) as folder:
        (folder / "filler").write_bytes(bytes(4096))
        env = make_task_vec_env(ENV_ID, 4, monitor_dir=str(folder), env_kwargs={"max_episode_steps": 2})
        free = Then(1200, (folder / "filler").unlink)
        with pytest.warns(
            UserWarning, match=r"monitor.csv could not be written \(No space left on device\). Training goes on"
        ):
            model = PEARL("MlpPolicy", env, **{**TINY, "gradient_steps": 1, "n_episodes_per_task": 50}).learn(
                1600, callback=free
            )
        env.close()
        assert model.num_timesteps == 1600
        assert len(load_results(str(folder))) > 100


def test_tensorboard_without_room_ends_no_training(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its writer repeats an error for ever."""
    tensorboard = pytest.importorskip("torch.utils.tensorboard")
    flush = tensorboard.SummaryWriter.flush
    broken: list[object] = []

    def fill_up(writer: object) -> None:
        if not broken:
            broken.append(writer)
        if writer in broken:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(writer)

    monkeypatch.setattr(tensorboard.SummaryWriter, "flush", fill_up)
    model = tiny_pearl(tensorboard_log=str(tmp_path / "tb"))
    with pytest.warns(
        UserWarning, match=r"TensorBoard's .*tb.* could not be written \(No space .*\)\. Training goes on"
    ) as said:
        model.learn(3 * ROLLOUT, ProgressCallback(tmp_path / "progress.csv"))
    assert len([warning for warning in said if "TensorBoard's" in str(warning.message)]) == 1
    assert model.num_timesteps == 3 * ROLLOUT and len([*(tmp_path / "tb").rglob("events*")]) == 2


def test_a_log_that_had_no_room_is_whole_once_there_is_some(tmp_path: Path) -> None:
    """Also where the row that had none was the first with a column."""
    rows: list[dict[str, Any]] = [{"a": 1.0}, {"a": 2.0, "b": "x" * 5000}, {"a": 3.0, "b": "y"}, {"a": 4.0}]
    with disk(tmp_path, 24) as folder:
        log = PatientCSV(folder / "progress.csv")
        for i, row in enumerate(rows):
            if i == 1:
                (folder / "filler").write_bytes(bytes(20480))
                with pytest.warns(UserWarning, match=r"progress\.csv could not be written \(No space left.*Training goes on"):
                    log.write(row, dict.fromkeys(row, ()))
                assert (folder / "progress.csv").read_text() == "a\n1.0\n", "what was there is not touched"
                (folder / "filler").unlink()
            else:
                log.write(row, dict.fromkeys(row, ()))
        log.close()
        lines = (folder / "progress.csv").read_text().splitlines()
    assert lines == ["a,b", "1.0,", f'2.0,"{"x" * 5000}"', '3.0,"y"', "4.0,"]


def test_a_lost_progress_file_is_written_anew(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    progress = ProgressCallback(path)
    checkpointing = CheckpointCallback(1, str(tmp_path), companions=[progress])
    tiny_pearl().learn(5 * 240, callback=[checkpointing, progress, Then(600, path.unlink)])
    rows = path.read_text().splitlines()
    assert rows[0].count("time/total_timesteps") == 1
    column = rows[0].split(",").index("time/total_timesteps")
    assert [int(row.split(",")[column]) for row in rows[1:]] == [240, 480, 720, 960, 1200], "nothing of it is lost"
    assert [folder.name for folder in checkpoints(tmp_path)] == ["1200_steps", "960_steps"]
    _, state = load_latest(tmp_path)
    with pytest.raises(ValueError, match=r"begun with 1 callbacks beside its CheckpointCallback, .* and goes on with 0"):
        CheckpointCallback(1, str(tmp_path)).restore(tiny_pearl(), state)


def test_an_old_checkpoint_that_cannot_be_removed_ends_no_training(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sb3_htr.common.checkpoint_callback as module

    def refuse(path: Path) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    monkeypatch.setattr(module.shutil, "rmtree", refuse)
    with pytest.warns(UserWarning, match=r"old checkpoint .*240_steps could not be removed \(Operation not permitted\)"):
        tiny_pearl().learn(4 * 240, callback=CheckpointCallback(1, str(tmp_path)))
    assert len(checkpoints(tmp_path)) == 4


@pytest.mark.parametrize("seconds", [0, 5e9], ids=["1970", "2128"])
def test_a_wrong_clock_ends_no_training(seconds: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SB3's model files are zip files, which know no such time; checkpoints know none at all."""
    with (
        monkeypatch.context() as wrong,
        pytest.warns(UserWarning, match=r"best_model.zip could not be written .*Training goes on"),
    ):
        wrong.setattr("time.time", lambda: seconds)
        with pytest.raises(OSError, match=rf"{ENV_ID}\.zip could not be written .*: mend that, and `sb3-htr train --resume"):
            main(train_arguments(tmp_path, 480, *SETTINGS, eval_freq=240))
    run = run_folder(tmp_path)
    assert [folder.name for folder in checkpoints(run)] == ["480_steps", "240_steps"]
    assert main(["train", "--resume", str(run)]) == 0
    assert PEARL.load(run / f"{ENV_ID}.zip").num_timesteps == 480


def test_checkpoints_of_a_training_that_went_further_are_not_removed(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Of a script that was started anew with the same folder; a training may itself go on."""
    model = tiny_pearl()
    for n, again in ((2 * ROLLOUT, True), (ROLLOUT, False)):
        model.learn(n, CheckpointCallback(1, str(tmp_path)), reset_num_timesteps=again)
    kept = checkpoints(tmp_path)
    assert kept[0].name == f"{3 * ROLLOUT}_steps"
    with pytest.raises(ValueError, match=rf"{3 * ROLLOUT}_steps is a checkpoint of another training, which went further"):
        tiny_pearl().learn(ROLLOUT, CheckpointCallback(1, str(tmp_path)))
    model, callback = tiny_pearl(), CheckpointCallback(1, str(tmp_path))
    callback.restore(model, load_latest(tmp_path)[1])
    with pytest.raises(ValueError, match=rf"begins at 0 env steps, and its checkpoint is of {3 * ROLLOUT}: call learn\(rem"):
        model.learn(ROLLOUT, callback)
    assert checkpoints(tmp_path) == kept
