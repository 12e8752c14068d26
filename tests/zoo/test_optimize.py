"""``sb3-htr optimize``: what is searched for, and where the study is kept."""

import json
import logging
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import optuna
import pytest
import yaml

from helpers import ENV_ID, TINY
from helpers.runs import run_folder
from sb3_htr import PEARL
from sb3_htr.common.divergence import DivergedError
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands import optimize, train
from sb3_htr.zoo.run import search_space
from sb3_htr.zoo.run.algorithm import ALGORITHMS
from sb3_htr.zoo.run.manager import MetaExperimentManager
from sb3_htr.zoo.run.method import PEARLMethod, get_method, merged, methods
from sb3_htr.zoo.run.record import RECORD
from sb3_htr.zoo.run.search_manager import SearchManager
from sb3_htr.zoo.run.study import absolute, without_password
from sb3_htr.zoo.run.training_manager import TrainingManager

SMALL = ["-params", "n_tasks_per_rollout:4", "n_episodes_per_task:3", "learning_starts:240", "n_envs:4"]


def search_command(folder: Path, storage: str, *more: str, n_trials: int = 2, method: str | None = None) -> list[str]:
    arguments = ["optimize", "--env", ENV_ID, "-f", str(folder), "-n", "480", "--n-trials", str(n_trials), "--seed", "1"]
    arguments += ["--eval-episodes", "2"]
    # Near goals: trials of any seed have something to report
    arguments += [] if "--env-kwargs" in more else ["--env-kwargs", "goal_distance:0.1"]
    arguments += ["--method", method] if method else []
    return [*arguments, "--n-evaluations", "2", "--storage", storage, "--study-name", "test", "--verbose", "0", *more, *SMALL]


def search(folder: Path, storage: str, *more: str, n_trials: int = 2, method: str | None = None) -> int:
    return main(search_command(folder, storage, *more, n_trials=n_trials, method=method))


def check_search(folder: Path, storage: str, capsys: pytest.CaptureFixture[str], method: str | None = None) -> optuna.Study:
    """Two trials, then a third by another worker, then a training with what trial 0 had."""
    assert search(folder, storage, method=method) == 0
    assert search(folder, storage, n_trials=1, method=method) == 0
    study = optimize.create_study(storage, "test")
    assert [trial.number for trial in study.get_trials()] == [0, 1, 2]
    output = capsys.readouterr().out
    study_of = f"--study-name test --storage {shlex.quote(storage)}"
    say = f"sb3-htr train --env {ENV_ID}{f' --method {method}' if method else ''} {study_of}"
    given = f"--env-kwargs goal_distance:0.1 {shlex.join(SMALL)}"
    assert f"{say} --trial-id {study.best_trial.number} {given}\n" in output
    assert len(list(folder.glob("*/report_*.csv"))) >= 1 and not list(folder.glob(f"*/{ENV_ID}_*"))
    arguments = [*shlex.split(say)[1:], "-f", str(folder), "-n", "240", "--eval-freq", "-1", "--verbose", "0"]
    assert main([*arguments, "--trial-id", "0", *SMALL]) == 0
    model = PEARL.load(run_folder(folder, method or "htr-ser") / f"{ENV_ID}.zip")
    assert model.learning_rate(1.0) == study.trials[0].params["learning_rate"]  # type: ignore[operator]
    return study


def test_workers_with_one_command_do_not_draw_alike(quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that was killed is told of."""
    storage = f"sqlite:///{tmp_path}/study.db"
    optuna.create_study(study_name="one", storage=storage).ask()
    command = ["optimize", "--env", ENV_ID, "-n", "240", "--n-trials", "1", "-f", str(tmp_path), "--seed", "1"]
    command += ["--eval-episodes", "2", "--n-evaluations", "1"]
    command += ["--storage", storage, "--study-name", "one", "--verbose", "0", *SMALL]
    for _ in range(2):
        assert main(command) == 0
    assert "1 trials are running, or their workers were killed" in capsys.readouterr().out
    rates = [trial.params["learning_rate"] for trial in optuna.load_study(study_name="one", storage=storage).trials[1:]]
    assert len(set(rates)) == 2


def test_a_study_in_sqlite(quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = check_search(tmp_path, f"sqlite:///{tmp_path}/study.db", capsys)
    # Two evaluations of each trial, the last of them is its value
    for trial in study.get_trials(states=[optuna.trial.TrialState.COMPLETE]):
        assert list(trial.intermediate_values) == [1, 2] and trial.intermediate_values[2] == trial.value


def test_a_study_is_of_one_env_and_one_method(quick: None, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    assert search(tmp_path, storage, n_trials=1) == 0
    with pytest.raises(ValueError, match="The study 'test' is of method htr-ser, and not htr-ec: give --method as there"):
        search(tmp_path, storage, method="htr-ec")
    others = {
        r"{'n_timesteps': 480}, and not {'n_timesteps': 960}: give -conf, -params, -n and --env-kwargs": ["-n", "960"],
        r"{'env_kwargs': {'goal_distance': 0\.1}}, and not {'env_kwargs': {'goal": ["--env-kwargs", "goal_distance:9.0"],
    }
    for known, more in others.items():
        with pytest.raises(ValueError, match=f"The study 'test' is of settings {known}"):
            search(tmp_path, storage, *more)
    trained = ["train", "--env", ENV_ID, "--method", "pearl-sparse", "-f", str(tmp_path), "--storage", storage]
    with pytest.raises(ValueError, match="The study 'test' is of method htr-ser, and not pearl-sparse"):
        main([*trained, "--study-name", "test", "--trial-id", "0"])


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials train nothing."""
    monkeypatch.setattr(SearchManager, "objective", lambda *_: 1.0)


def test_a_search_that_is_interrupted_says_so_when_it_has_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing should train with the best of half a search."""

    def interrupted_at_second(_: object, trial: optuna.Trial) -> float:
        if trial.number == 1:
            raise KeyboardInterrupt
        return 1.0

    monkeypatch.setattr(MetaExperimentManager, "objective", interrupted_at_second)
    write_settings(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        join(tmp_path, "--n-trials", "3")
    assert "Best trial:" in capsys.readouterr().out and list(tmp_path.rglob("report_*.csv"))


def join(folder: Path, *more: str) -> int:
    """One worker of a study, with settings of a file."""
    arguments = ["optimize", "--env", ENV_ID, "-f", str(folder), "--n-trials", "1", "--verbose", "0"]
    return main([*arguments, "--storage", f"{folder}/study.log", "--study-name", "test", "-conf", f"{folder}/my.yml", *more])


def write_settings(folder: Path, **settings: Any) -> None:
    block = {"policy": "MlpPolicy", "n_timesteps": 480.0, "n_envs": 4, **settings}
    (folder / "my.yml").write_text(yaml.safe_dump({ENV_ID: block}))


def test_workers_share_a_study_however_its_settings_are_spelled(at_once: None, tmp_path: Path) -> None:
    """But not with other settings in the file, nor with some that others search."""
    write_settings(tmp_path, gamma=0.9)
    assert join(tmp_path, "--env-kwargs", "goal_distance:0.1", "n_test_tasks:3") == 0
    reordered = ["--env-kwargs", "n_test_tasks:3", "goal_distance:0.1"]
    assert join(tmp_path, "-n", "480", *reordered) == 0
    with pytest.raises(
        ValueError, match=r"is of settings {'not searched': \[\]}, and not {'not searched': \['gamma'\]}: give"
    ):
        join(tmp_path, *reordered, "-params", "gamma:0.9")
    write_settings(tmp_path, gamma=0.9, tau=0.1)
    with pytest.raises(ValueError, match=r"The study 'test' is of settings {}, and not {'tau': 0\.1}: give -conf"):
        join(tmp_path, *reordered)


def test_a_study_of_an_earlier_version_goes_on(at_once: None, tmp_path: Path) -> None:
    """It says its settings otherwise, and from then on as others do."""
    write_settings(tmp_path)
    study = optimize.create_study(f"{tmp_path}/study.log", "test")
    said = {"env": ENV_ID, "method": "htr-ser", "env-kwargs": "{}", "n-timesteps": "-1", "hyperparams": "{}"}
    for fact, value in said.items():
        study.set_user_attr(fact, value)
    assert join(tmp_path, "-n", "480") == 0
    with pytest.raises(ValueError, match="is of settings"):
        join(tmp_path, "-n", "960")


def test_a_mistyped_setting_leaves_the_study_to_others(at_once: None, tmp_path: Path) -> None:
    write_settings(tmp_path)
    with pytest.raises(ValueError, match="gama"):
        join(tmp_path, "-params", "gama:0.5")
    assert join(tmp_path, "-params", "gamma:0.5") == 0


@pytest.mark.parametrize("n_jobs", ["2", "-1"])
def test_one_worker_has_one_thread(n_jobs: str, at_once: None, tmp_path: Path) -> None:
    """Trials at once would draw each other's numbers."""
    write_settings(tmp_path)
    with pytest.raises(ValueError, match=rf"--n-jobs is {n_jobs}, expected 1, .*: start several workers with one --storage"):
        join(tmp_path, "--n-jobs", n_jobs)


def test_a_search_begins_with_new_networks(quick: None, tmp_path: Path) -> None:
    (tmp_path / "model.zip").touch()
    with pytest.raises(ValueError, match=r"begin with new networks: leave -i out"):
        search(tmp_path, f"sqlite:///{tmp_path}/study.db", "-i", str(tmp_path / "model.zip"))


def test_a_mistyped_env_leaves_the_name_of_the_study_free(quick: None, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    with pytest.raises(ValueError, match="did you mean SparsePointRobot-v0"):
        main(["optimize", "--env", "SparsePointRobto-v0", "--storage", storage, "--study-name", "test"])
    assert search(tmp_path, storage, n_trials=1) == 0


def test_a_study_in_a_journal(quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_search(tmp_path, f"{tmp_path}/journal/study.log", capsys, method="htr-ec")


def test_a_journal_needs_no_symbolic_links_on_windows(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def symlink(*_: Any) -> None:
        raise OSError("A required privilege is not held by the client")

    monkeypatch.setattr("os.symlink", symlink)
    monkeypatch.setattr("sb3_htr.zoo.run.study.os", SimpleNamespace(name="nt"), raising=False)
    check_search(tmp_path, f"{tmp_path}/journal/study.log", capsys)


def as_postgres(command: list[str]) -> list[str]:
    # PostgreSQL refuses to be run by root
    return ["runuser", "-u", "postgres", "--", *command] if os.geteuid() == 0 else command


@pytest.fixture(scope="module")
def postgresql() -> Iterator[str]:
    """URL of an empty database on a server that listens on a socket in a folder of its own."""
    pytest.importorskip("psycopg", reason="psycopg is not installed: pip install 'sb3_htr[postgresql]'")
    folders = [None, *sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]
    found = [(shutil.which("initdb", path=folder), shutil.which("pg_ctl", path=folder)) for folder in folders]
    initdb, pg_ctl = next((pair for pair in found if all(pair)), (None, None))
    if initdb is None or pg_ctl is None:
        pytest.skip("no PostgreSQL server here: apt-get install postgresql")
    if os.geteuid() == 0 and (shutil.which("runuser") is None or subprocess.run(["id", "-u", "postgres"]).returncode):
        pytest.skip("PostgreSQL does not run as root, and there is no user postgres to run it as")
    # Short: the path of a socket has at most 107 characters
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    if os.geteuid() == 0:
        shutil.chown(folder, "postgres")
    data, options = str(folder / "data"), f"-k {folder} -c listen_addresses= -c fsync=off"

    def control(*arguments: str) -> None:
        subprocess.run(as_postgres([pg_ctl, "-D", data, "-w", *arguments]), check=True, cwd=folder, stdout=subprocess.DEVNULL)

    try:
        subprocess.run(
            as_postgres([initdb, "-D", data, "-A", "trust", "-U", "htr", "-N"]),
            check=True,
            cwd=folder,
            stdout=subprocess.DEVNULL,
        )
        control("start", "-o", options, "-l", str(folder / "log"))
        try:
            yield f"postgresql+psycopg://htr@/postgres?host={folder}"
        finally:
            control("stop", "-m", "immediate")
    finally:
        shutil.rmtree(folder)


def test_workers_that_begin_at_once_share_a_study_in_postgresql(postgresql: str, quick: None) -> None:
    with ThreadPoolExecutor(4) as pool:
        studies = list(pool.map(lambda _: optimize.create_study(postgresql, "race"), range(4)))
    assert len({study._study_id for study in studies}) == 1


def test_no_password_is_printed() -> None:
    for storage in ("logs/study.log", "sqlite:///study.db", "postgresql+psycopg://me@/x?host=/tmp/socket"):
        assert without_password(storage) == storage
    assert without_password("postgresql+psycopg://me:secret@db/x") == "postgresql+psycopg://me:***@db/x"
    assert "secret" not in without_password("postgresql+psycopg://db/x?user=me&password=secret")


def test_a_run_of_a_trial_keeps_no_password_and_goes_on_without_the_study(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = "postgresql+psycopg://me:TOPSECRET@db/x"
    command = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "480", "--save-freq", "1", "--eval-freq", "-1"]
    command += ["--verbose", "0", "--storage", storage, "--study-name", "x", "--trial-id", "3", *SMALL]
    with monkeypatch.context() as patch:
        patch.setattr("sb3_htr.zoo.run.training_manager.check_is_of", lambda *_: None)
        patch.setattr(TrainingManager, "load_trial", lambda *_: {"gamma": 0.77})
        assert main(command) == 0
    run = run_folder(tmp_path)
    texts = [path for path in run.rglob("*") if path.is_file() and b"TOPSECRET" in path.read_bytes()]
    assert texts == [] and "me:***@db" in (run / RECORD).read_text()
    assert main(["train", "--resume", str(run), "-n", "240"]) == 0
    assert PEARL.load(run / f"{ENV_ID}.zip").gamma == 0.77


def test_a_search_pickles_no_study_that_a_storage_has(quick: None, tmp_path: Path) -> None:
    for storage, suffixes in (("", {".csv", ".pkl"}), (f"sqlite:///{tmp_path}/study.db", {".csv"})):
        folder = tmp_path / ("kept" if storage else "lost")
        of_study = ["--storage", storage, "--study-name", "x"] if storage else []
        little = ["-n", "240", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "2"]
        main(["optimize", "--env", ENV_ID, *little, "-f", str(folder), *of_study, *SMALL])
        assert {path.suffix for path in folder.rglob("report_*")} == suffixes


def test_a_password_is_not_uploaded_nor_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = "postgresql+psycopg://me:TOPSECRET@localhost:1/x"
    of_study = ["--study-name", "x", "--trial-id", "3", "-f", str(tmp_path)]
    with pytest.raises(ValueError, match="--track would upload the password in --storage"):
        main(["train", "--env", ENV_ID, "--track", "--storage", storage, *of_study])
    with pytest.raises(ValueError, match="--storage is neither") as refusal:
        main(["train", "--env", ENV_ID, "--storage", storage.replace("//", "/"), *of_study])
    assert "TOPSECRET" not in str(refusal.value)
    monkeypatch.setattr("sb3_htr.zoo.run.training_manager.check_is_of", lambda *_: None)
    monkeypatch.setattr(TrainingManager, "load_trial", lambda *_: {"policy": "evil.Policy"})
    with pytest.raises(ValueError, match=r"me:\*\*\*@localhost:1/x has policy: 'evil\.Policy', which can run any code"):
        main(["train", "--env", ENV_ID, "--storage", storage, *of_study])


def test_two_workers_search_at_once_in_postgresql(postgresql: str, tmp_path: Path) -> None:
    """As two terminals do, with one command; a training takes what one of them tried."""
    small = ["gradient_steps:2", "batch_size:4", "meta_batch_size:4", "policy_kwargs:{'net_arch':[8],'encoder_arch':[8]}"]
    command = [*search_command(tmp_path, postgresql, "--study-name", "both"), *small]
    code = f"import sys; from sb3_htr.zoo.cli import main; sys.exit(main({command}))"
    workers = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(2)]
    assert [worker.wait(120) for worker in workers] == [0, 0]
    trials = optuna.load_study(study_name="both", storage=postgresql).trials
    assert len(trials) == 4 and all(trial.state.is_finished() for trial in trials)
    assert len({trial.params["learning_rate"] for trial in trials}) == 4
    first, second = trials[:2]
    assert first.datetime_complete and second.datetime_start and second.datetime_start < first.datetime_complete, "at once"
    training = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "240", "--eval-freq", "-1", "--verbose", "0"]
    assert main([*training, "--storage", postgresql, "--study-name", "both", "--trial-id", "0", *SMALL, *small]) == 0
    model = PEARL.load(run_folder(tmp_path) / f"{ENV_ID}.zip")
    assert model.learning_rate(1.0) == trials[0].params["learning_rate"]  # type: ignore[operator]


def test_bad_storages_are_named_in_one_sentence(quick: None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--storage needs a --study-name"):
        main(["optimize", "--env", ENV_ID, "--storage", "sqlite:///x.db"])
    with pytest.raises(ValueError, match=r"--storage is neither sqlite:///FILE"):
        search(tmp_path, "study.db")
    with pytest.raises(ValueError, match=r"The storage sqlite:////nowhere/study.db cannot be used: unable to open"):
        search(tmp_path, "sqlite:////nowhere/study.db")
    with pytest.raises(ValueError, match=r"database of mysql, for which a package is missing \(.*\): install it") as refusal:
        search(tmp_path, "mysql://me:secret@host/studies")
    assert "secret" not in str(refusal.value)


def test_a_torn_journal_is_named_and_left_alone(at_once: None, tmp_path: Path) -> None:
    """As a worker leaves it that is killed while it writes, or whose disk is full."""
    write_settings(tmp_path)
    assert join(tmp_path) == 0
    journal = tmp_path / "study.log"
    whole = journal.read_bytes()
    for torn in (whole[:-5], whole[:-5] + whole[-20:], whole[:-5] + whole):
        journal.write_bytes(torn)
        with pytest.raises(ValueError, match=rf"The storage {journal} cannot be used, as its last line, .* remove that line"):
            join(tmp_path)
        assert journal.read_bytes() == torn
    journal.write_bytes(whole[: whole[:-1].rindex(b"\n") + 1])
    assert join(tmp_path) == 0


def test_a_search_that_learnt_nothing_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    monkeypatch.setattr(logging.getLogger("optuna.study.study"), "handlers", [handler])
    values = [0.0, 0.0]

    def two_trials(_: Any) -> None:
        study = optimize.create_study(f"{tmp_path}/s.log", "test")
        study.add_trials([optuna.trial.create_trial(value=value) for value in values])

    monkeypatch.setattr(train, "main", two_trials)
    assert search(tmp_path, f"{tmp_path}/s.log") == 0
    assert "No trial learnt anything: the return after adaptation is 0 in all 2" in capsys.readouterr().out
    assert not [text for text in said if "existing study" in text], "it is new"
    values[0] = 0.5
    assert search(tmp_path, f"{tmp_path}/s.log") == 0
    assert "--trial-id 2" in capsys.readouterr().out
    assert len([text for text in said if "existing study" in text]) == 1


@pytest.mark.parametrize("name", [name for name, method in methods().items() if isinstance(method, PEARLMethod)])
def test_what_is_sampled_makes_a_model_of_the_method_and_is_what_is_loaded(name: str) -> None:
    study, method = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)), get_method(name)
    assert isinstance(method, PEARLMethod)
    relabels = method.relabel_probability > 0
    space, of_others = search_space.PEARL, method.not_searched()
    sampled_probabilities = set()
    for _ in range(4):
        trial = study.ask()
        sampled = space.sample(trial, of_others)
        assert sampled == space.convert(trial.params) and 0.8 <= sampled["gamma"] < 1
        assert ("hindsight_task_strategy" in trial.params) == (method.name.split("-prior")[0] in ("htr-ser", "htr-ec"))
        assert ("temperature" in trial.params) == (method.name.split("-prior")[0] in ("htr-hfr", "htr-hipi"))
        assert sampled["learning_rate"] == f"lin_{trial.params['learning_rate']}"
        assert 0 <= sampled["learning_starts"] <= 20_000
        sampled = MetaExperimentManager._preprocess_schedules(sampled)
        model = PEARL("MlpPolicy", ENV_ID, **merged(method.hyperparams(), sampled))
        assert model.policy.latent_dim == trial.params["latent_dim"]
        assert model.policy.encoder_arch == sampled["policy_kwargs"]["encoder_arch"]
        buffer = model.replay_buffer
        assert buffer is not None and type(buffer.relabeller).__name__ == method.relabeller
        sampled_probabilities.add(buffer.relabel_probability)
    assert len(sampled_probabilities) > 1 if relabels else sampled_probabilities == {0.0}


@pytest.mark.parametrize("name", ["rl2", "sac-her"])
def test_what_is_sampled_of_a_rival_makes_a_model_of_it(name: str) -> None:
    study, algorithm = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)), get_method(name).algorithm
    space = algorithm.search_space
    assert space is not None
    for _ in range(4):
        trial = study.ask()
        sampled = space.sample(trial)
        assert sampled == space.convert(trial.params)
        model = algorithm.model_class(algorithm.model_class.DEFAULT_POLICY, ENV_ID, **sampled)
        assert (model.gamma, model.ent_coef) == (1 - trial.params["one_minus_gamma"], trial.params["ent_coef"])
        assert model.policy_kwargs["net_arch"] == sampled["policy_kwargs"]["net_arch"]
    with pytest.raises(ValueError, match=r"The trial has kl_coef 0\.1, which sb3-htr optimize does not try"):
        space.convert({"kl_coef": 0.1})


def test_a_rival_is_searched_for_and_trained_with_what_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    little = search_space.SearchSpace(ints={"n_epochs": (2, 3)}, choices={"lstm_hidden_size": (4, 8)})
    little = replace(little, within={"lstm_hidden_size": ("policy_kwargs",)})
    monkeypatch.setitem(ALGORITHMS, "rl2", replace(ALGORITHMS["rl2"], search_space=little))
    small = ["-params", "n_envs:4", "n_episodes_per_trial:2", "n_trials_per_rollout:1", "policy_kwargs:{'net_arch':[4]}"]
    storage = ["--study-name", "test", "--storage", f"sqlite:///{tmp_path}/study.db", "-f", str(tmp_path), "--verbose", "0"]
    arguments = ["--env", ENV_ID, "--method", "rl2", "--env-kwargs", "goal_distance:0.1", "-n", "320"]
    trials = ["--n-trials", "2", "--n-evaluations", "2", "--eval-episodes", "2"]
    assert main(["optimize", *arguments, *storage, *trials, *small]) == 0
    assert "Train with the best trial so far: sb3-htr train" in capsys.readouterr().out
    trial = optimize.create_study(storage[3], "test").trials[1]
    assert set(trial.params) == {"n_epochs", "lstm_hidden_size"}
    assert main(["train", *arguments, *storage, "--trial-id", "1", "--eval-freq", "-1", *small]) == 0
    record = json.loads((run_folder(tmp_path, "rl2") / RECORD).read_text())["hyperparams"]
    assert record["n_epochs"] == trial.params["n_epochs"] and record["ent_coef"] == 0.01, "the file's stays"
    assert record["policy_kwargs"] == {"net_arch": [4], "lstm_hidden_size": trial.params["lstm_hidden_size"]}


def test_what_a_user_gives_is_not_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[PEARL] = []
    set_up = PEARL._setup_model

    def watched(model: PEARL) -> None:
        made.append(model)
        set_up(model)

    monkeypatch.setattr(PEARL, "_setup_model", watched)
    given = {key: value for key, value in TINY.items() if key != "seed"}
    given["policy_kwargs"] = {"net_arch": [16], "encoder_arch": [16]}
    params = ["-params", *(f"{key}:{value!r}" for key, value in given.items()), "n_envs:4", "gamma:0.5"]
    storage = f"sqlite:///{tmp_path}/s.db"
    arguments = ["optimize", "--env", ENV_ID, "-f", str(tmp_path), "-n", "480", "--n-trials", "1", "--n-evaluations", "1"]
    of_study = ["--eval-episodes", "2", "--storage", storage, "--study-name", "test"]
    assert main([*arguments, *of_study, "--verbose", "0", *params]) == 0
    (trial,) = optimize.create_study(storage, "test").get_trials()
    searched = {"learning_rate", "tau", "ent_coef", "kl_coef", "latent_dim", "n_steps"}
    assert set(trial.params) == {*searched, "relabel_probability", "hindsight_task_strategy"}
    (model,) = made
    assert model.lr_schedule(0.5) == pytest.approx(trial.params["learning_rate"] / 2)
    assert (model.gamma, model.gradient_steps, model.batch_size, model.meta_batch_size) == (0.5, 3, 4, 8)
    assert (model.policy.net_arch, model.policy.encoder_arch) == ([16], [16])
    assert (model.policy.latent_dim, model.tau) == (trial.params["latent_dim"], trial.params["tau"])


def test_a_trial_joins_the_settings_of_the_file(tmp_path: Path) -> None:
    """rl_zoo3 replaces the dicts of the file, and takes trial 0 for none."""
    storage = f"sqlite:///{tmp_path}/study.db"
    study = optimize.create_study(storage, "test")
    study.enqueue_trial({"learning_rate": 0.002, "relabel_probability": 0.3})
    asked = study.ask()
    search_space.PEARL.sample(asked, get_method("htr-ser").not_searched())
    study.tell(asked, 1.0)
    block: dict[str, Any] = {key: value for key, value in TINY.items() if key != "seed"}
    block |= {"policy": "MlpPolicy", "n_timesteps": 240, "n_envs": 4}
    relabeller = {"name": "SingleEpisodeRelabelling", "rl_batch_source": "task"}
    block["replay_buffer_kwargs"] = {"relabeller": relabeller, "relabel_probability": 0.9}
    (tmp_path / "my.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    arguments = ["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(tmp_path / "my.yml"), "--eval-freq", "-1"]
    trial = ["--storage", storage, "--study-name", "test", "--trial-id", "0", "-params", "gradient_steps:2"]
    assert main([*arguments, "--verbose", "0", *trial]) == 0
    model = PEARL.load(run_folder(tmp_path) / f"{ENV_ID}.zip")
    strategy = asked.params["hindsight_task_strategy"]
    expected = {"relabel_probability": 0.3, "rl_reward_type": "sparse"}
    assert model.replay_buffer_kwargs == {**expected, "relabeller": {**relabeller, "hindsight_task_strategy": strategy}}
    assert model.gradient_steps == 2, "-params wins over the trial"
    # The rate falls to 0, as PEARL's default does
    rates = [model.learning_rate(remaining) for remaining in (1.0, 0.5, 0.0)]  # type: ignore[operator]
    assert rates == pytest.approx([0.002, 0.001, 0.0])


def test_hyperparameters_that_diverge_are_pruned(quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(*_: Any, **__: Any) -> None:
        raise DivergedError("critic_loss is nan")

    monkeypatch.setattr(PEARL, "learn", diverge)
    assert search(tmp_path, f"{tmp_path}/study.log", n_trials=1) == 0
    study = optimize.create_study(f"{tmp_path}/study.log", "test")
    assert [trial.state for trial in study.get_trials()] == [optuna.trial.TrialState.PRUNED]


def test_the_objective_is_the_return_after_adaptation(quick: None, tmp_path: Path) -> None:
    log = tmp_path / "trials"
    arguments = ["optimize", "--env", ENV_ID, "-f", str(tmp_path), "-n", "480", "--n-trials", "1", "--n-evaluations", "1"]
    storage = ["--storage", f"{tmp_path}/s.log", "--study-name", "test", "--optimization-log-path", str(log)]
    # Every goal disc of this distance holds the start, so that there are rewards
    near = ["--env-kwargs", "goal_distance:0.05"]
    assert main([*arguments, *storage, "--eval-episodes", "2", "--verbose", "0", *near, *SMALL]) == 0
    evaluations = np.load(log / "trial_0" / "evaluations.npz")
    value = optimize.create_study(f"{tmp_path}/s.log", "test").best_value
    assert value == pytest.approx(evaluations["returns"][-1, :, -1].mean()) and value > 0


def test_a_search_without_a_finished_trial_says_so(
    quick: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*args: Any) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(SearchManager, "objective", stop)
    assert search(tmp_path, f"sqlite:///{tmp_path}/study.db") == 0
    assert "no trial was finished. The same command goes on" in capsys.readouterr().out


def test_where_the_report_cannot_go_is_said_before_the_search(quick: None, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        search(tmp_path / "file", f"sqlite:///{tmp_path}/study.db")
    assert not optuna.load_study(study_name="test", storage=f"sqlite:///{tmp_path}/study.db").trials


def test_a_study_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    for storage in ("sqlite:///study.db", "sqlite:///study.db?timeout=60", "journals/study.log"):
        whole = absolute(storage)
        assert whole.endswith(f"{tmp_path}/{storage.removeprefix('sqlite:///')}") and absolute(whole) == whole
    for storage in ("sqlite:///:memory:", "sqlite://", "postgresql+psycopg://user:secret@host/database"):
        assert absolute(storage) == storage
    with pytest.raises(ValueError, match=r"there is no file .*study\.db: give that of `sb3-htr optimize`"):
        main(["train", "--env", ENV_ID, "--storage=sqlite:///study.db", "--study-name", "test", "--trial-id", "0"])
    assert not Path("study.db").exists()
    optimize.create_study("sqlite:///study.db?timeout=60", "test")
    with pytest.raises(ValueError, match=r"study\.db\?timeout=60 has no study 'test' with a trial 0"):
        main(["train", "--env", ENV_ID, "--storage=sqlite:///study.db?timeout=60", "--study-name", "test", "--trial-id", "0"])
