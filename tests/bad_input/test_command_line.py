"""What cannot be trained is refused on the command line, too, in one sentence, and no run folder is left behind."""

from pathlib import Path

import pytest

from helpers import ENV_ID
from sb3_htr.zoo.cli import main


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", ENV_ID, "-n", "10", "-params", "kl_coeff:0.1"], r"PEARL has no setting 'kl_coeff': did you mean kl_coef\?"),
        (
            ["--env", ENV_ID, "-params", "policy_kwargs:{'latent_dimm': 3}"],
            "policy_kwargs has no setting 'latent_dimm': did you",
        ),
        (["--env", ENV_ID, "-params", "gamma:abc"], "'abc' is not defined: -params .* strings in quotes"),
        (["--env", ENV_ID, "-params", "gamma=0.9"], "-params and --env-kwargs take name:value, where a value is Python"),
        (["--env", ENV_ID, "-params", "seed:3"], "seed is no hyperparameter: give it by --seed"),
        (["--env", ENV_ID, "-params", "device:'cpu'"], "device is no hyperparameter: give it by --device"),
        (
            ["--env", ENV_ID, "-params", "learning_rate:'1e-3'"],
            r"learning_rate is the text '1e-3' \(-params\), expected a number: leave the quotes out",
        ),
        (
            ["--env", ENV_ID, "-params", "gamma:0.9", "--hyperparams", "n_envs:2"],
            "^-params is given twice, and only the last would count: give all pairs behind one",
        ),
        (["--env", ENV_ID, "--env-kwargs", "goal_distance:1", "--env-kwargs=goal_radius:1"], "^--env-kwargs is given twice"),
        (
            ["--env", ENV_ID, "--env-kwargs", "goal_distance:1.2", "-params", "env_kwargs:{'goal_radius':0.4}"],
            "-params has env_kwargs, and there is --env-kwargs: give all arguments of the env by the latter",
        ),
        (
            ["--env", ENV_ID, "-params", "learning_rate:True"],
            r"learning_rate is True \(-params\), expected a number, or a text such as 'lin_0\.001'",
        ),
        (["--env", ENV_ID, "-params", "learning_rate:None"], r"learning_rate is None \(-params\), expected a number"),
        (["--env", ENV_ID, "-params", "n_envs:0"], "n_envs is 0, expected a whole number of at least 1"),
        (["--env", ENV_ID, "-n", "0"], "n_timesteps is 0, expected a whole number of at least 1"),
        (["--env", ENV_ID, "-params", "n_timesteps:0"], "n_timesteps is 0, expected a number of at least 1"),
        (["--env", ENV_ID, "-n", "-5"], "n_timesteps is -5"),
        (["--env", "CartPole-v1"], "The env has no task_family, so there are no tasks to meta-train on"),
        (["-n", "10"], "--env is missing"),
        (
            ["--env", ENV_ID, "--trial-id", "9", "--study-name", "s", "--storage", "sqlite:///:memory:"],
            "no study 's' with a trial 9",
        ),
        (["--env", "Speed-v0", "--gym-packages", "not_there"], "The module not_there is asked for, but not found: install it"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_trained_is_refused_in_one_sentence(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, ImportError), match=message) as refusal:
        main(["train", *arguments])
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.iterdir()), "no folder of a run that there is not"


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("mine:Speed-v0", r"--env is 'mine:Speed-v0', with a module: give --gym-packages mine --env Speed-v0"),
        ("HiddenGoal/mine:Door-v0", "with a module: give --gym-packages mine --env HiddenGoal/Door-v0"),
        ("SparsePointRobo-v0", r"There is no env SparsePointRobo-v0: did you mean SparsePointRobot-v0\? An env of your own"),
        ("Xyz-v0", r"There is no env Xyz-v0: An env of your own is found once its module is imported, by --gym-packages"),
    ],
)
def test_an_unknown_id_on_the_command_line_says_how_one_is_found(env_id: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        main(["train", "--env", env_id])


@pytest.mark.parametrize("file", ["./door.py", "door.py"])
def test_a_file_is_no_module(file: str) -> None:
    with pytest.raises(ValueError, match=rf"'{file}' is no name of a module: .*--gym-packages door"):
        main(["train", "--env", ENV_ID, "--gym-packages", file])


def test_settings_in_the_wrong_place() -> None:
    with pytest.raises(ValueError, match="relabel_probability is a setting within replay_buffer_kwargs: -params"):
        main(["train", "--env", ENV_ID, "-params", "relabel_probability:0.5"])


def test_a_settings_file_that_is_not_there() -> None:
    with pytest.raises(FileNotFoundError, match=r"There is no file pearl_pior\.yml: did you mean pearl_prior\.yml\?"):
        main(["train", "--env", ENV_ID, "-conf", "pearl_pior.yml"])


def test_a_settings_file_that_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "speed.py").write_text("speed = 3")
    for folder in (str(tmp_path / "runs"), "./runs"):
        with pytest.raises(ValueError, match="runs is a folder, expected a file of hyperparameters"):
            main(["train", "--env", ENV_ID, "-conf", folder])
    for file, named in (("runs", "runs"), ("speed.py", r".*speed\.py")):
        sentence = f"^{named} is no file of hyperparameters: expected ids of envs, with settings, in a dict named hyperparams"
        with pytest.raises(ValueError, match=sentence):
            main(["train", "--env", ENV_ID, "-conf", file])
    (tmp_path / "other.yml").write_text("Other-v0:\n  n_timesteps: 100\n")
    with pytest.raises(ValueError, match=rf"other\.yml has no block {ENV_ID}, and none named default"):
        main(["train", "--env", ENV_ID, "-conf", "other.yml"])
    with pytest.raises(FileNotFoundError, match=r"There is no file nothing\.py: expected a file of yours"):
        main(["train", "--env", ENV_ID, "-conf", "nothing.py"])


@pytest.mark.parametrize("trial", [["--trial-id", "0"], ["--storage", "x.log", "--study-name", "x"]])
def test_half_a_trial_is_refused(trial: list[str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="A trial is named by --storage, --study-name, --trial-id, from 0 on: add --"):
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), *trial])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-n", "0"], "--n-timesteps is 0, expected a whole number of at least 1"),
        (["--n-timesteps", "-5"], "--n-timesteps is -5, expected a whole number of at least 1"),
        (["--fps", "0"], r"--fps is 0\.0, expected a number of at least 0\.1"),
        (["--fps", "-3"], r"--fps is -3\.0, expected a number of at least 0\.1"),
        (["--fps", "inf"], "--fps is inf, expected a finite number of at least"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_cannot_be_shown_is_refused_before_it_begins(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("enjoy", "record"):
        if (command, arguments[0]) != ("record", "--fps"):
            with pytest.raises(ValueError, match=message):
                main([command, "--env", ENV_ID, "-f", "nowhere", *arguments])
    assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["goal_distance:1.2", "--env-kwargs", "goal_radius:0.4"], "--env-kwargs is given twice, and only the last would"),
        (
            ["flag:false"],
            "has 'flag:false', which would be a text: expected True, False or None, or flag:\"'false'\" for the text",
        ),
    ],
)
def test_an_argument_of_the_env_is_not_lost(given: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "--env", ENV_ID, "--env-kwargs", *given])
    assert message in capsys.readouterr().err
