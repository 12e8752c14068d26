"""Files from strangers, made to run code, to take memory or to confuse: each is answered in one sentence, and runs nothing."""

import base64
import hashlib
import io
import json
import pickle
import re
import sqlite3
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch as th
import yaml
from stable_baselines3.common.utils import LinearSchedule

from helpers import ENV_ID, MakePEARL
from helpers.bombs import Bomb, bombs
from helpers.runs import make_run
from sb3_htr import load_untrusted
from sb3_htr.common.checkpoint import MANIFEST, DamagedCheckpoint, checkpoints, read_checkpoint, write_checkpoint
from sb3_htr.common.safe_load import load_plain
from sb3_htr.zoo.cli import console, main
from sb3_htr.zoo.commands.optimize import create_study
from sb3_htr.zoo.run.agents import agent_at, find_runs
from sb3_htr.zoo.run.callbacks import ProgressCallback
from sb3_htr.zoo.run.record import RECORD, arguments_to_go_on
from sb3_htr.zoo.run.trust import check_arguments, plain_settings


@pytest.fixture
def fuse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that appears if code of a stranger runs: of the module ``evil``, of :func:`code`, or of a pickle."""
    (tmp_path / "evil.py").write_text(f"from pathlib import Path\nPath({str(tmp_path / 'fuse')!r}).touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    return tmp_path / "fuse"


def code(fuse: Path) -> str:
    return f"__import__('pathlib').Path({str(fuse)!r}).touch()"


# --- run.json, the record of a run

# What a stranger's record may change, as a function of the code that it would like to run
RECORDS: dict[str, Callable[[str], dict[str, Any]]] = {
    "its settings are Python": lambda code: {"arguments": ["-params", f"gamma:{code}"]},
    "its settings are a string that is Python": lambda code: {"arguments": ["-params", f"policy_kwargs:{code!r}"]},
    "its settings name a wrapper": lambda code: {"arguments": ["-params", "env_wrapper:'evil.X'"]},
    "its settings name a callback": lambda code: {"arguments": ["-params", "callback:'evil.X'"]},
    "its settings name a policy": lambda code: {"arguments": ["-params", "policy:'evil.X'"]},
    "its env's arguments are Python": lambda code: {"arguments": ["--env-kwargs", f"goal_distance:{code}"]},
    "an abbreviated option": lambda code: {"arguments": ["--hyperp", f"gamma:{code}"]},
    "an abbreviated option with one dash": lambda code: {"arguments": ["-par", f"gamma:{code}"]},
    "an option and its value in one word": lambda code: {"arguments": [f"--hyperparams=gamma:{code}"]},
    "its settings are a module": lambda code: {"arguments": ["-conf", "evil"]},
    "its settings are a module that looks like a file": lambda code: {"arguments": ["-conf", "evil.yml/"]},
    "a model to begin with that there is not": lambda code: {"arguments": ["-i", "evil.zip"]},
    "an env within the arguments": lambda code: {"arguments": ["--env-kwargs", "env_id:'evil:Env-v0'"]},
    "an upload": lambda code: {"arguments": ["--track"]},
    "a search": lambda code: {"arguments": ["-optimize"]},
    "packages among the arguments": lambda code: {"arguments": ["--gym-packages", "evil"]},
    "packages": lambda code: {"gym_packages": ["evil"]},
    "packages that are no list": lambda code: {"gym_packages": "evil"},
    "arguments that are no list": lambda code: {"arguments": "-params"},
    "arguments that are no text": lambda code: {"arguments": [1, None]},
    "deep brackets": lambda code: {"arguments": ["-params", "gamma:" + "[" * 100_000]},
    "deep signs": lambda code: {"arguments": ["-params", "gamma:" + "-" * 100_000 + "1"]},
    "no number of steps": lambda code: {"n_timesteps": "many"},
    "no method": lambda code: {"method": None},
    "no seed": lambda code: {"seed": [1]},
    "no hyperparameters": lambda code: {"hyperparams": None},
    "an env of a module": lambda code: {"env_id": "evil:Env-v0", "arguments": ["--env", "evil:Env-v0"]},
    "no env": lambda code: {"env_id": None},
    "an env that there is not": lambda code: {"arguments": ["--env", "../../evil"]},
}


@pytest.mark.parametrize("change", RECORDS.values(), ids=RECORDS)
def test_records(change: Callable[[str], dict[str, Any]], fuse: Path, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    run = make_run(tmp_path / "logs", tiny_pearl())
    write_checkpoint(run / "checkpoints" / "240_steps", {})
    record = json.loads((run / RECORD).read_text())
    changed = change(code(fuse))
    if isinstance(changed.get("arguments"), list):
        changed["arguments"] = ["--env", ENV_ID, *changed["arguments"]]
    (run / RECORD).write_text(json.dumps({**record, **changed}))
    # The second stops at a task that there is not, once it has done all that a record can ask for
    for command in (["train", "--resume", str(run)], ["enjoy", str(run), "--no-render", "--task", "0"]):
        with pytest.raises((ValueError, OSError)) as refusal:
            main(command)
        assert "\n" not in str(refusal.value)
        assert not fuse.exists(), f"sb3-htr {command[0]} ran it"


def test_a_record_connects_to_no_database(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    """Which would be told passwords of this machine, or get tables."""
    database = tmp_path / "places.sqlite"
    sqlite3.connect(database).close()
    run = make_run(tmp_path / "logs", tiny_pearl())
    write_checkpoint(run / "checkpoints" / "240_steps", {})
    record = json.loads((run / RECORD).read_text())
    study = ["--storage", f"sqlite:///{database}", "--study-name=x", "--trial-id", "0"]
    record["arguments"] = ["--env", ENV_ID, *study]
    (run / RECORD).write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"has the argument '--storage', whose database may be told passwords .* add --trust"):
        main(["train", "--resume", str(run)])
    assert database.read_bytes() == b""
    assert arguments_to_go_on({**record, "trial": {}}) == ["--env", ENV_ID], "its settings are in the record"


def test_an_env_within_the_env_of_a_record(fuse: Path, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    inner: dict[str, Any] = {"env_id": "HiddenFetchReach-v0", "env_kwargs": {"env_id": "evil:Env-v0"}}
    run = make_run(tmp_path / "logs", tiny_pearl(), **inner)
    for command in (["enjoy", str(run), "--no-render"], ["evaluate", str(run)], ["export", str(run)]):
        with pytest.raises(ValueError, match="has 'evil:Env-v0' among its settings, which can run any code"):
            main(command)
    assert not fuse.exists()


def test_an_env_within_the_env_of_settings_is_fine_once_the_user_names_its_module(fuse: Path) -> None:
    settings = {"env_kwargs": {"env_id": "evil:Env-v0"}}
    arguments = ["--env-kwargs", "env_id:'evil:Env-v0'"]
    assert plain_settings(settings, "my.yml", False, ["evil"]) == settings
    check_arguments(arguments, [], "run.json", False, ["evil"])
    with pytest.raises(ValueError, match=r"my\.yml has 'evil:Env-v0' among its settings"):
        plain_settings(settings, "my.yml", False, ["good"])
    with pytest.raises(ValueError, match=r"run\.json has 'evil:Env-v0' among its settings"):
        check_arguments(arguments, [], "run.json", False)
    assert not fuse.exists()


def test_modules_that_a_record_asks_for_are_imported_if_the_user_names_them(
    fuse: Path, tmp_path: Path, tiny_pearl: MakePEARL
) -> None:
    run = make_run(tmp_path / "logs", tiny_pearl(), gym_packages=["evil"])
    look = ["enjoy", str(run), "--no-render", "--n-episodes", "1", "--n-tasks", "1"]
    with pytest.raises(
        ValueError, match=r"best_model\.zip asks for the module 'evil'.* add --gym-packages evil if you know it"
    ):
        main(look)
    assert not fuse.exists()
    for said in (["--gym-packages", "evil"], ["--trust"]):
        sys.modules.pop("evil", None)
        assert main([*look, *said]) == 0
        assert fuse.exists()
        fuse.unlink()


# --- YAML files

BLOCK: dict[str, Any] = {"policy": "MlpPolicy", "n_timesteps": 100, "n_envs": 2}
YAMLS: dict[str, Callable[[str], Any]] = {
    "a callback with arguments": lambda code: {"callback": [{"subprocess.Popen": {"args": ["touch", "x"]}}]},
    "a callback": lambda code: {"callback": "evil.X"},
    "a wrapper": lambda code: {"env_wrapper": [{"evil.X": {}}]},
    "a wrapper of the batch": lambda code: {"vec_env_wrapper": "evil.X"},
    "a class of replay buffers": lambda code: {"replay_buffer_class": "evil.X"},
    "a policy": lambda code: {"policy": "evil.X"},
    "Python for the policy": lambda code: {"policy_kwargs": f"dict(x={code})"},
    "Python for the replay buffer": lambda code: {"replay_buffer_kwargs": f"dict(x={code})"},
    "Python for the monitor": lambda code: {"monitor_kwargs": code},
    "Python to normalize by": lambda code: {"normalize": code},
    "Python as a number": lambda code: {"gamma": code},
    "Python as a schedule": lambda code: {"learning_rate": f"lin_{code}"},
    "Python for the env": lambda code: {"env_kwargs": code},
    "an env within an env": lambda code: {"env_kwargs": {"env_kwargs": ["evil:Env-v0"]}},
    "a class as text": lambda code: {"policy_kwargs": {"encoder_class": "evil.X"}},
    "deep signs": lambda code: {"policy_kwargs": "-" * 100_000 + "1"},
    "no settings": lambda code: [1, 2],
    "a setting that is no text": lambda code: {1: 2},
    "no number of envs": lambda code: {"n_envs": "many"},
}


# Settings whose values are named to be imported
IMPORTED = {"callback", "env_wrapper", "vec_env_wrapper", "replay_buffer_class", "policy"}


@pytest.mark.parametrize("change", YAMLS.values(), ids=YAMLS)
def test_yaml_files(change: Callable[[str], Any], fuse: Path, tmp_path: Path) -> None:
    changed = change(code(fuse))
    block = {**BLOCK, **changed} if isinstance(changed, dict) else changed
    (tmp_path / "hostile.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    with pytest.raises((ValueError, TypeError)) as refusal:
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(tmp_path / "hostile.yml")])
    assert "\n" not in str(refusal.value)
    if IMPORTED & {*changed}:
        assert re.search(r"hostile\.yml has \w+: .*, which can run any code: add --trust", str(refusal.value))
    assert not fuse.exists()


def test_objects_in_yaml_files(fuse: Path, tmp_path: Path) -> None:
    (tmp_path / "hostile.yml").write_text(f"{ENV_ID}: !!python/object/apply:os.system ['touch {fuse}']")
    with pytest.raises(ValueError, match=r"hostile\.yml cannot be read"):
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), "-conf", str(tmp_path / "hostile.yml")])
    assert not fuse.exists()


@pytest.mark.parametrize("name", ["policy_kwargs", "env_wrapper", "callback", "net_arch"])
def test_trials(name: str, fuse: Path, tmp_path: Path) -> None:
    study = create_study(f"{tmp_path}/study.log", "hostile")
    study.enqueue_trial({name: code(fuse)})
    asked = study.ask()
    asked.suggest_categorical(name, [code(fuse), "evil.X"])
    study.tell(asked, 1.0)
    trial = ["--study-name", "hostile", "--storage", f"{tmp_path}/study.log", "--trial-id", "0"]
    with pytest.raises(ValueError, match=f"has .*{name}") as refusal:
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), *trial])
    assert "\n" not in str(refusal.value)
    assert not fuse.exists()


# --- model files


def plain(value: Any) -> bytes:
    """As ``PEARL.save`` writes tensors."""
    file = io.BytesIO()
    th.save(value, file)
    return file.getvalue()


def expanded(weights: dict[str, Any]) -> dict[str, Any]:
    """One number of the file for each tensor, of which torch makes as many as it likes."""
    return {name: th.zeros(()).expand(tensor.shape) for name, tensor in weights.items()}


def with_data(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], dict[str, bytes]]:
    return lambda data, weights: {"data": json.dumps({**data, key: value}).encode()}


# Of the data and the weights of a model file, what a stranger may make
MODELS: dict[str, Callable[[dict[str, Any], dict[str, Any]], dict[str, bytes]]] = {
    **{
        f"{i}, its {key} is {value!r:.20}": with_data(key, value)
        for i, (key, value) in enumerate(
            (
                ("policy_kwargs", {"net_arch": [10**9]}),
                ("policy_kwargs", {"net_arch": [2**14] * 10**4}),
                ("policy_kwargs", {"net_arch": "evil"}),
                ("policy_kwargs", {"latent_dim": -1}),
                ("policy_kwargs", {"latent_dim": True}),
                ("policy_kwargs", {"encoder_class": "evil.X"}),
                ("policy_kwargs", [1]),
                ("context_size", 10**8),
                ("explorer", "evil.X"),
                ("explorer", {"name": "evil.X"}),
                ("explorer", {"name": "prior", "n_exploration_episodes": "evil"}),
                ("explorer", None),
                ("gamma", 7),
                ("tau", -1),
                ("learning_rate", {":type:": str(LinearSchedule), "start": "evil", "end": 0, "end_fraction": 1}),
                ("learning_rate", {":type:": str(LinearSchedule)}),
                ("meta_batch_size", 0.5),
                ("replay_buffer_kwargs", {"relabeller": "evil.X"}),
            )
        )
    },
    "its data are no JSON": lambda data, weights: {"data": b"evil"},
    "its data are a list": lambda data, weights: {"data": b"[]"},
    "its data are deep brackets": lambda data, weights: {"data": b"[" * 100_000},
    "its weights are no tensors": lambda data, weights: {"policy.pth": plain({name: "evil" for name in weights})},
    "its weights are a list": lambda data, weights: {"policy.pth": plain([1])},
    "its weights are named by numbers": lambda data, weights: {"policy.pth": plain(dict(enumerate(weights.values())))},
    "its weights have other shapes": lambda data, weights: {
        "policy.pth": plain({name: tensor.flatten()[:1] for name, tensor in weights.items()})
    },
    "its weights are larger than its file": lambda data, weights: {"policy.pth": plain(expanded(weights))},
    "its knowledge is empty": lambda data, weights: {"knowledge.pth": plain({})},
    "its knowledge is damaged": lambda data, weights: {"knowledge.pth": b"evil"},
}


@pytest.mark.parametrize("change", MODELS.values(), ids=MODELS)
def test_model_files(
    change: Callable[[dict[str, Any], dict[str, Any]], dict[str, bytes]], tmp_path: Path, tiny_pearl: MakePEARL
) -> None:
    tiny_pearl().save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as source, zipfile.ZipFile(tmp_path / "hostile.zip", "w") as hostile:
        data, weights = json.loads(source.read("data")), th.load(io.BytesIO(source.read("policy.pth")), weights_only=True)
        changed = change(data, weights)
        for name in source.namelist():
            hostile.writestr(name, changed.get(name, source.read(name)))
    with pytest.raises(ValueError) as refusal:
        load_untrusted(tmp_path / "hostile.zip", ENV_ID)
    assert "\n" not in str(refusal.value)


def test_a_model_to_begin_with(fuse: Path, tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    """Its weights are taken, and its pickles are not."""
    model, hostile = tiny_pearl(), tmp_path / "hostile.zip"
    model.save(tmp_path / "model.zip")
    pickled = base64.b64encode(pickle.dumps(Bomb(fuse))).decode()
    with zipfile.ZipFile(tmp_path / "model.zip") as source, zipfile.ZipFile(hostile, "w") as archive:
        for name in source.namelist():
            content = source.read(name)
            if name == "data":
                content = json.dumps({**json.loads(content), "x": {":type:": "x", ":serialized:": pickled}}).encode()
            archive.writestr(name, content)
    settings = ["learning_starts:10_000", "n_envs:4", "gradient_steps:1"]
    arguments = ["--env", ENV_ID, "-n", "240", "--eval-freq", "-1", "--verbose", "0", "-params", *settings]
    assert main(["train", "-i", str(hostile), "-f", str(tmp_path / "logs"), *arguments]) == 0
    assert not fuse.exists()
    trained, given = agent_at(tmp_path / "logs", "last").load().policy.state_dict(), model.policy.state_dict()
    assert all(th.equal(trained[name], given[name]) for name in given if not name.startswith("normalizer"))
    # A run goes on as it began
    (run,) = find_runs(tmp_path / "logs")
    assert main(["train", "--resume", str(run), "-n", "240"]) == 0 and not fuse.exists()
    with pytest.raises(ValueError, match="is unpickled to be trained on, which can run any code: add --trust"):
        main(["train", "--method", "sac-her", "-i", str(hostile), "-f", str(tmp_path / "logs"), *arguments[:-1]])


def test_calls_that_take_memory(tmp_path: Path) -> None:
    """torch would let them through."""

    class Large:
        def __reduce__(self) -> Any:
            return bytearray, (10**6,)

    for name in ("data.pkl", "DATA.PKL"):
        with zipfile.ZipFile(tmp_path / "large.pt", "w") as archive:
            archive.writestr(f"archive/{name}", pickle.dumps({"x": Large()}, protocol=2))
            archive.writestr("archive/version", "3")
        with pytest.raises(ValueError, match="it calls what no tensor needs"):
            load_plain(tmp_path / "large.pt")
    # Something that torch reads, and behind it a zip that is harmless
    harmless = io.BytesIO()
    th.save({"x": th.zeros(1)}, harmless)
    th.save({"x": Large()}, tmp_path / "large.pt", _use_new_zipfile_serialization=False)
    with (tmp_path / "large.pt").open("ab") as file:
        file.write(harmless.getvalue())
    with pytest.raises(ValueError, match="it does not begin as a file of torch"):
        load_plain(tmp_path / "large.pt")


def test_a_link_in_the_place_of_a_file_of_a_run(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """A checkpoint says what is written there."""
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "progress.csv").symlink_to("mine")
    progress = ProgressCallback(tmp_path / "progress.csv")
    progress.load_state_dict({"keys": [], "text": "code"})
    tiny_pearl().learn(1, progress)
    assert (tmp_path / "mine").read_text() == "mine" and not (tmp_path / "progress.csv").is_symlink()


def test_modules_of_the_working_folder_wait_for_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "of_my_own.py").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [path for path in sys.path if path not in ("", str(tmp_path))])
    look = ["enjoy", "--env", ENV_ID, "--no-render", "--n-episodes", "1", "--n-tasks", "1"]
    monkeypatch.setattr("sys.argv", ["sb3-htr", *look])
    assert console() == 0 and str(tmp_path) not in sys.path
    monkeypatch.setattr("sys.argv", ["sb3-htr", *look, "--gym-packages", "of_my_own"])
    assert console() == 0 and "of_my_own" in sys.modules


# --- checkpoints


def test_checkpoints(fuse: Path, tmp_path: Path) -> None:
    for bomb in bombs(fuse):
        folder = tmp_path / "1_steps"
        write_checkpoint(folder, {})
        (folder / "state.pt").write_bytes(bomb)
        manifest = json.loads((folder / MANIFEST).read_text())
        manifest["sha256"]["state.pt"] = hashlib.sha256(bomb).hexdigest()
        (folder / MANIFEST).write_text(json.dumps(manifest))
        with pytest.raises(DamagedCheckpoint, match=r"1_steps.* is not what sb3-htr writes, and may run code"):
            read_checkpoint(folder)
    assert not fuse.exists()


def test_names_that_are_no_numbers_are_no_checkpoints(tmp_path: Path) -> None:
    for name in ("²_steps", "½_steps", "-1_steps", "x_steps", "_steps", "240_steps"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    assert [folder.name for folder in checkpoints(tmp_path)] == ["240_steps"]


def test_manifests_of_brackets_are_damaged(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "1_steps", {})
    (tmp_path / "1_steps" / MANIFEST).write_text("[" * 100_000)
    with pytest.raises(DamagedCheckpoint, match=r"1_steps has no readable manifest.json"):
        read_checkpoint(tmp_path / "1_steps")


OF_OTHER_CODE = '{"env_id": "a", "env_kwargs": {}, "gym_packages": [], "resumed_by": [1]}'
OF_NO_MACHINE = '{"env_id": "a", "env_kwargs": {}, "gym_packages": [], "hardware": [1]}'
DAMAGED = ("", "{", "[]", "null", '{"env_id": 1}', OF_OTHER_CODE, OF_NO_MACHINE, "[" * 100_000, "\x00\xff")


@pytest.mark.parametrize("content", DAMAGED)
def test_damaged_records_are_named(content: str, tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(ValueError, match=r"run\.json is damaged, or no record of a run"):
        agent_at(tmp_path)
