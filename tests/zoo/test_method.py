"""A method is one name, from the command line to the model card."""

import copy
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID, TINY, MakePEARL
from helpers.runs import make_run, run_folder, train_arguments
from sb3_htr import PEARL
from sb3_htr.adaptation import Belief, Prior
from sb3_htr.adaptation.explorers import to_explorer
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.agents import agent_for
from sb3_htr.zoo.run.method import PEARLMethod, get_method, merged, methods, register_method
from sb3_htr.zoo.run.record import RECORD
from sb3_htr.zoo.run.shipped import block_of, hyperparams_file

OWN = ["htr-ser", "htr-ec", "pearl-dense", "pearl-sparse", "htr-hfr", "htr-hipi"]
OTHERS = ["rl2", "sac-her"]


def of_pearl(name: str) -> PEARLMethod:
    method = get_method(name)
    assert isinstance(method, PEARLMethod)
    return method


def test_what_the_methods_are() -> None:
    assert list(methods()) == [*OWN, *OTHERS, *(f"{name}-prior" for name in OWN)]
    pearls = {name: method for name, method in methods().items() if isinstance(method, PEARLMethod)}
    assert [name for name in methods() if name not in pearls] == OTHERS
    relabelling = {name: method.relabel_probability > 0 for name, method in pearls.items()}
    dense = {name for name, method in pearls.items() if method.rl_reward_type == "dense"}
    assert relabelling == {name: name.startswith("htr") for name in pearls}
    assert dense == {"pearl-dense", "pearl-dense-prior"}
    for name in OWN:
        method, prior = of_pearl(name), of_pearl(f"{name}-prior")
        assert (method.train_explorer, method.explorer) == ("aggregate", "belief"), "methods differ in one thing at a time"
        assert (prior.train_explorer, prior.explorer) == ("prior", "prior")
        assert merged(prior.hyperparams(), {key: method.hyperparams()[key] for key in ("explorer", "train_explorer")}) == (
            method.hyperparams()
        )
    with pytest.raises(ValueError, match=r"The method is 'htr', expected one of htr-ser, htr-ec, .*htr-hipi-prior\."):
        get_method("htr")


@pytest.mark.parametrize("name", [*OWN, *(f"{name}-prior" for name in OWN[:4])])
def test_every_method_trains_as_what_it_says(name: str) -> None:
    method = of_pearl(name)
    model = PEARL("MlpPolicy", ENV_ID, **merged(TINY, method.hyperparams())).learn(480)
    assert model.replay_buffer is not None
    assert type(model.replay_buffer.relabeller).__name__ == method.relabeller
    assert model.replay_buffer.relabel_probability == method.relabel_probability
    assert model.replay_buffer.rl_reward_type == method.rl_reward_type
    assert (model.train_explorer.name, model.explorer.name) == (method.train_explorer, method.explorer)


# --- nested settings are joined

nested = st.recursive(st.integers(), lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3), max_leaves=8)
trees = st.dictionaries(st.sampled_from("abc"), nested, max_size=3)


def paths(tree: Any) -> dict[tuple[str, ...], Any]:
    """Every setting by its path."""
    if not isinstance(tree, dict) or not tree:
        return {(): tree}
    return {(key, *path): value for key, inner in tree.items() for path, value in paths(inner).items()}


@given(trees, trees)
def test_the_second_wins_and_nothing_else_of_the_first_is_lost(first: dict[str, Any], second: dict[str, Any]) -> None:
    before = copy.deepcopy((first, second))
    result = paths(merged(first, second))
    ours, theirs = paths(first), paths(second)
    leaves = {path: value for path, value in theirs.items() if value != {}}
    assert all(result[path] == value for path, value in leaves.items())
    for path, value in ours.items():
        hidden = any(path[: len(other)] == other or other[: len(path)] == path for other in theirs)
        assert hidden or result[path] == value
    assert result.keys() <= {*ours, *theirs, ()}
    assert (first, second) == before, "neither is changed"


@pytest.mark.parametrize("env_id", ["SparsePointRobot-v0", "SparseWheeled-v0", "SparseAnt-v0"])
def test_settings_of_an_explorer_are_for_it_alone(env_id: str) -> None:
    """`pearl_paper.yml` has some of `prior` for the robots, which other methods' explorers have not."""
    blocks = yaml.safe_load(hyperparams_file("pearl_paper.yml").read_text())
    of_env = blocks.get(env_id, blocks["default"])
    for name in ("htr-ser", "htr-ser-prior"):
        settings = get_method(name).settings(of_env)
        assert to_explorer(settings["train_explorer"]).name == ("prior" if name.endswith("prior") else "aggregate")
    with pytest.raises(ValueError, match="has no setting 'n_exploration_episode'"):
        to_explorer(get_method("htr-ser-prior").settings({"explorer": {"n_exploration_episode": 2}})["explorer"])


def test_a_name_and_settings_of_what_it_names_are_joined() -> None:
    settings = {"relabeller": "EpisodeClustering", "n": 1}
    joined = merged(settings, {"relabeller": {"cell_size": 0.2}})
    assert joined == {"relabeller": {"name": "EpisodeClustering", "cell_size": 0.2}, "n": 1}
    assert merged(joined, {"relabeller": {"name": "SingleEpisodeRelabelling"}})["relabeller"]["name"] == (
        "SingleEpisodeRelabelling"
    )
    assert merged(joined, {"relabeller": "SingleEpisodeRelabelling"}) == {"relabeller": "SingleEpisodeRelabelling", "n": 1}


def by_file(folder: Path, **settings: Any) -> list[str]:
    """A training by a file of its own, which has these settings."""
    block = {key: value for key, value in TINY.items() if key != "seed"}
    block |= {"policy": "MlpPolicy", "n_timesteps": 240, "n_envs": 4, **settings}
    (folder / "my.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    where = ["train", "--env", ENV_ID, "-f", str(folder), "-conf", str(folder / "my.yml")]
    return [*where, "--eval-freq", "-1", "--verbose", "0"]


def test_settings_of_file_method_and_command_line_are_joined_in_this_order(tmp_path: Path) -> None:
    replay = {
        "relabeller": {"name": "SingleEpisodeRelabelling", "hindsight_task_strategy": "final"},
        "relabel_probability": 0.1,
        "context_episodes": 3,
    }
    arguments = by_file(tmp_path, explorer={"name": "prior", "margin": 2.5}, replay_buffer_kwargs=replay)
    given = ["replay_buffer_kwargs:{'relabeller':{'cell_size':0.3}}", "explorer:{'doubt':0.1}"]
    assert main([*arguments, "--method", "htr-ec", "-params", *given]) == 0
    run = run_folder(tmp_path, "htr-ec")
    buffer = {"relabel_probability": 0.8, "rl_reward_type": "sparse", "context_episodes": 3}
    relabeller = {"name": "EpisodeClustering", "hindsight_task_strategy": "final", "cell_size": 0.3}
    model = PEARL.load(run / f"{ENV_ID}.zip")
    assert model.replay_buffer_kwargs == {**buffer, "relabeller": relabeller}
    assert model.explorer == Belief(margin=2.5, doubt=0.1)
    record = json.loads((run / RECORD).read_text())
    assert record["hyperparams"]["replay_buffer_kwargs"] == {**buffer, "relabeller": relabeller}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "htr"], "The method is 'htr', expected one of htr-ser"),
        (["-params", "method:'pearl'"], "The method is 'pearl', expected one of htr-ser"),
        (["-params", "replay_buffer_kwargs:{'cell_size':0.3}"], "replay_buffer_kwargs has no setting 'cell_size'"),
        (
            ["-params", "replay_buffer_kwargs:{'relabeller':{'cell_size':0.3}}"],
            "'SingleEpisodeRelabelling' has no setting 'ce",
        ),
        (["--method", "htr-ec", "-params", "replay_buffer_kwargs:{'relabeller':{'rl_batch_source':'task'}}"], "'EpisodeClu"),
        (["-params", "explorer:{'margn':0.3}"], "explorer 'belief' has no setting 'margn': did you mean margin"),
        (["-params", "explorer:'nobody'"], "explorer is 'nobody', expected one of"),
        (["-params", "n_exploration_episodes:3"], "PEARL has no setting 'n_exploration_episodes'"),
        (
            ["-params", "normalize:True"],
            "normalize asks for SB3's VecNormalize.*leave it out, the policies of PEARL and RL2 normalize",
        ),
        (["-params", "normalize:{'norm_reward':False}"], "normalize asks for SB3's VecNormalize"),
    ],
)
def test_what_is_not_known_is_refused_in_one_sentence(arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message) as refusal:
        main(["train", "--env", ENV_ID, "-f", str(tmp_path), "-n", "240", "--verbose", "0", *arguments])
    assert "\n" not in str(refusal.value) and not list(tmp_path.rglob("*.zip"))


def test_settings_of_an_env_are_those_of_its_block_or_else_of_the_default(tmp_path: Path) -> None:
    file = tmp_path / "my.yml"
    blocks = {"default": {"gamma": 0.9}, ENV_ID: {"method": "htr-ec", "gamma": 0.5}}
    file.write_text(yaml.safe_dump(blocks))
    assert block_of(str(file), ENV_ID) == {"gamma": 0.5} and block_of(str(file), "SparseAnt-v0") == {"gamma": 0.9}
    file.write_text(yaml.safe_dump({ENV_ID: blocks[ENV_ID]}))
    assert block_of(str(file), ENV_ID) == {"gamma": 0.5} and block_of(str(file), "SparseAnt-v0") == {}


@pytest.mark.parametrize(("missing", "given"), [("policy", []), ("n_timesteps", []), ("policy", ["-n", "240"])])
def test_a_file_that_lacks_what_a_training_needs(missing: str, given: list[str], tmp_path: Path) -> None:
    block = {"policy": "MlpPolicy", "n_timesteps": 240, "n_envs": 4}
    del block[missing]
    (tmp_path / "my.yml").write_text(yaml.safe_dump({ENV_ID: block}))
    with pytest.raises(ValueError, match=rf"my\.yml has no {missing} for {ENV_ID}: add it"):
        main(["train", "--env", ENV_ID, "-f", str(tmp_path / "logs"), "-conf", str(tmp_path / "my.yml"), *given])
    assert not (tmp_path / "logs").exists()


# --- one name all the way


@pytest.mark.parametrize("name", ["htr-ec", "pearl-sparse-prior"])
def test_the_name_is_recorded_and_stays_with_the_agent(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the folder, in run.json, through a resume, in the exported file and its card, and in what it says to train it."""
    monkeypatch.chdir(tmp_path)
    goals = ["--method", name, "--save-freq", "240", "--env-kwargs", "goal_distance:0.05"]
    assert main(train_arguments(Path("logs"), 480, *goals, eval_freq=480)) == 0
    run = run_folder(Path("logs"), name)
    record = json.loads((run / RECORD).read_text())
    assert record["method"] == name
    assert main(["train", "--resume", str(run)]) == 0
    assert [path.name for path in Path("logs").iterdir()] == [name], "it goes on where it was"
    assert main(["export", str(run), "-o", "agent", "--n-episodes", "2"]) == 0
    with zipfile.ZipFile(f"agent/pearl-{ENV_ID}.zip") as archive:
        exported = json.loads(archive.read(RECORD))
    assert exported["method"] == name and f"--method {name}" in exported["command"]
    card = Path("agent/README.md").read_text()
    metadata = yaml.safe_load(card.split("---")[1])
    assert metadata["model-index"][0]["name"] == name and f"\n# {name} on {ENV_ID}\n" in card
    assert ("with Hindsight Task Relabelling" in card) == name.startswith("htr")
    assert agent_for(ENV_ID, "logs", name).method == name
    capsys.readouterr()
    assert main(["enjoy", "--env", ENV_ID, "--method", name, "--no-render", "--n-tasks", "1", "--n-episodes", "1"]) == 0
    assert f"logs/{name}/" in capsys.readouterr().out


def test_enjoy_takes_the_agent_of_the_method_that_is_asked_for(
    tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    few = ["enjoy", "--env", ENV_ID, "--no-render", "--n-tasks", "1", "--n-episodes", "1"]
    make_run(Path("logs"), tiny_pearl(explorer=Prior(1)), method="pearl-sparse-prior")
    make_run(Path("logs"), tiny_pearl(), method="htr-ec")
    said = {}
    for name in ("htr-ec", "pearl-sparse-prior", "pearl-dense"):
        assert main([*few, "--method", name]) == 0
        said[name] = capsys.readouterr().out.splitlines()[0]
    assert said["htr-ec"].startswith("logs/htr-ec/") and said["htr-ec"].endswith("explorer 'belief'")
    assert said["pearl-sparse-prior"].startswith("logs/pearl-sparse-prior/")
    assert said["pearl-sparse-prior"].endswith("explorer 'prior'")
    assert f"trained_agents/pearl-dense/{ENV_ID}.zip" in said["pearl-dense"], "there is none in the logs, so the shipped one"
    assert main(few) == 0
    assert "logs/htr-ec/" in capsys.readouterr().out, "without a name, the first that there is"
    with pytest.raises(ValueError, match="The method is 'htr', expected one of"):
        main([*few, "--method", "htr"])
    with pytest.raises(FileNotFoundError, match=f"no trained agent for {ENV_ID} by pearl-dense-prior in logs/"):
        main([*few, "--method", "pearl-dense-prior"])


def test_a_method_may_stand_in_the_yaml_file_and_among_the_params(tmp_path: Path) -> None:
    arguments = by_file(tmp_path, method="htr-ec-prior")
    in_params = ["-params", "method:'pearl-sparse'"]
    for more, expected in (
        ([], "htr-ec-prior"),
        (in_params, "pearl-sparse"),
        (["--method", "htr-ser", *in_params], "htr-ser"),
    ):
        assert main([*arguments, *more]) == 0
        record = json.loads((run_folder(tmp_path, expected) / RECORD).read_text())
        assert record["method"] == expected and "method" not in record["hyperparams"]


def test_what_a_method_replaces_of_a_file_is_said(tmp_path: Path) -> None:
    replay = {"relabeller": {"name": "EpisodeClustering"}, "relabel_probability": 0.3}
    arguments = by_file(tmp_path, explorer="prior", train_explorer="aggregate", replay_buffer_kwargs=replay)
    replaced = "explorer 'prior', relabeller 'EpisodeClustering', relabel_probability 0.3, which the method htr-ser replaces"
    with pytest.warns(UserWarning, match=replaced):
        assert main(arguments) == 0


@pytest.mark.parametrize(
    ("learning_rate", "n_timesteps", "more", "message"),
    [
        ("1e-3", 240, "", r"learning_rate is the text '1e-3' \(.*my\.yml\), expected a number: in YAML, 1\.0e-3 is one"),
        (0.001, "1e3", "", "n_timesteps is the text '1e3'"),
        (0.001, 240, "replay_buffer_kwargs: 3", "replay_buffer_kwargs is 3 .*, expected names and values"),
        (0.001, 240, "env_kwargs: 3", "env_kwargs is 3 .*, expected names and values"),
        (0.001, 240, "gamma: [", r"my\.yml cannot be read: while parsing a flow node"),
    ],
)
def test_what_yaml_makes_of_a_slip(learning_rate: Any, n_timesteps: Any, more: str, message: str, tmp_path: Path) -> None:
    lines = ["policy: MlpPolicy", "n_envs: 4", f"learning_rate: {learning_rate}", f"n_timesteps: {n_timesteps}", more]
    (tmp_path / "my.yml").write_text("\n".join([f"{ENV_ID}:", *(f"  {line}" for line in lines)]))
    with pytest.raises(ValueError, match=message) as refusal:
        main(["train", "--env", ENV_ID, "-f", str(tmp_path / "logs"), "-conf", str(tmp_path / "my.yml")])
    assert "\n" not in str(refusal.value) and not (tmp_path / "logs").exists()


def test_keywords_that_are_left_empty_are_none(tmp_path: Path) -> None:
    arguments = by_file(tmp_path, replay_buffer_kwargs=None, env_kwargs=None)
    for number, more in enumerate(([], ["-params", "env_kwargs:None"]), start=1):
        assert main([*arguments, *more]) == 0
        assert json.loads((run_folder(tmp_path, number=number) / RECORD).read_text())["env_kwargs"] == {}


def test_keywords_may_be_python_where_the_file_is_trusted(tmp_path: Path) -> None:
    python = "dict(net_arch=[16], encoder_arch=[16])"
    assert main([*by_file(tmp_path, learning_rate="lin_1e-3", policy_kwargs=python), "--trust"]) == 0
    assert PEARL.load(run_folder(tmp_path) / f"{ENV_ID}.zip").policy_kwargs["net_arch"] == [16]


@pytest.mark.parametrize("file", ["pearl.yml", "pearl_paper.yml"])
@pytest.mark.parametrize("name", ["htr-hfr", "htr-hipi"])
def test_the_temperature_of_rivals_is_the_entropy_coefficient(name: str, file: str) -> None:
    """That is what it stands for: their papers scale rewards instead."""
    default = {"ent_coef": 0.01}
    for env_id, block in yaml.safe_load(hyperparams_file(file).read_text()).items():
        settings = get_method(name).settings({**default, **block})
        temperature = settings["replay_buffer_kwargs"]["relabeller"].get("temperature", 0.01)
        assert temperature == settings["ent_coef"], env_id
    assert "temperature" not in str(get_method("htr-ser").settings(block))


def test_no_method_replaces_another(monkeypatch: pytest.MonkeyPatch) -> None:
    known = dict(methods())
    monkeypatch.setattr("sb3_htr.zoo.run.method.methods", lambda: known)
    settings: dict[str, Any] = {"about": "mine", "relabeller": "SingleEpisodeRelabelling", "relabel_probability": 0.3}
    settings |= {"rl_reward_type": "sparse", "train_explorer": "aggregate", "explorer": "belief"}
    register_method("mine-prior", **settings)
    with pytest.raises(ValueError, match="There is a method 'mine-prior' already"):
        register_method("mine", **settings)
    for wrong, message in (
        ({"relabel_probability": "lots"}, "relabel_probability is 'lots', expected a number from 0 to 1"),
        ({"rl_reward_type": "dens"}, r"rl_reward_type of the method 'other' is 'dens', expected one of \['dense', 'sparse'\]"),
        ({"explorer": {"name": "prior"}}, "explorer of the method 'other' is {'name': 'prior'}, expected one of"),
    ):
        with pytest.raises(ValueError, match=message):
            register_method("other", **{**settings, **wrong})
    with pytest.raises(ValueError, match="expected one that can be the name of a folder"):
        register_method("a/b", **settings)
    assert "other" not in known and "mine" not in known and "mine-prior-prior" in known
