"""Cells of an experiment are runs of the command line."""

import importlib
import json
import math
import platform
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from torch import nn

from helpers import ENV_ID
from helpers.disks import half_written
from helpers.results import made_up
from helpers.runs import OF_CELL
from sb3_htr import PEARL, evaluate_adaptation, make_task_vec_env
from sb3_htr.adaptation.explorers import Prior
from sb3_htr.common.checkpoint import checkpoints, write_checkpoint
from sb3_htr.common.digest import digest_of_code
from sb3_htr.common.versions import hardware
from sb3_htr.experiments import grid
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.evaluation_cache import FOLDER
from sb3_htr.experiments.executors import SerialExecutor
from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.experiments.protocol import evaluate
from sb3_htr.experiments.runner import find_finished, hyperparams_of, run_cell
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands import train
from sb3_htr.zoo.run.agents import agent_at
from sb3_htr.zoo.run.shipped import hyperparams_file

TINY = Variant("htr-ser", "tiny", OF_CELL, {"n_test_tasks": 4})


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small statistics."""
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    monkeypatch.setattr("sb3_htr.experiments.protocol.EVAL_SEEDS", (1, 2))


def refuse(*_: Any, **__: Any) -> None:
    raise AssertionError("a finished run is not trained again")


@pytest.mark.parametrize(
    ("evaluations", "message"),
    [
        (by(("beleif",)), r"could not be evaluated by 'beleif': explorer is 'beleif', expected one of"),
        (by(("belief",), {"goal_raduis": 0.3}), r"could not be evaluated by 'belief goal_raduis=0\.3': .*'goal_raduis'"),
    ],
)
def test_what_could_not_be_evaluated_is_not_trained(
    evaluations: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "main", refuse)
    variant = Variant("htr-ser", "tiny", OF_CELL)
    (cell,) = Experiment("one", "", ENV_ID, 1200, (variant,), 1, evaluations=evaluations).cells()
    with pytest.raises(ValueError, match=message):
        run_cell(cell, tmp_path)


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        ({"settings": {"method": "htr-ec"}}, "method is no setting of a Variant: give it as the first argument"),
        ({"settings": {"n_timesteps": 100}}, "n_timesteps is no setting of a Variant: give it to the Experiment, and budget"),
        ({"settings": {"env_kwargs": {}}}, "env_kwargs is no setting of a Variant: give it as env_kwargs="),
        ({"name": {"gamma": 0.9}}, r"The name of a Variant is {'gamma': 0\.9}, expected a text: Variant\(method, name, sett"),
    ],
)
def test_what_is_no_setting_of_a_variant_is_refused_before_it_is_trained(variant: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Variant("htr-ser", **variant)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seeds": 0}, "seeds is 0, expected a whole number of at least 1"),
        ({"seeds": [1, 2]}, r"seeds is \[1, 2\], expected a whole number"),
        ({"eval_freq": -1}, "eval_freq is -1, expected a whole number of at least 1"),
        ({"evaluations": ()}, "The experiment x has no evaluations, of which its table is"),
        ({"figure": "learning"}, "A figure of the experiment x is 'learning', expected a function, as figures.learning"),
        ({"also": ("race",)}, "A figure of the experiment x is 'race', expected a function"),
    ],
)
def test_an_experiment_without_a_result_is_refused_before_it_is_run(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Experiment("x", "", ENV_ID, 480, (Variant("htr-ser"),), **given)


@pytest.mark.parametrize(("name", "variants"), [("other", (Variant("htr-ser"),)), ("one", ())])
def test_an_experiment_has_the_name_that_it_is_called_by(
    name: str, variants: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(grid.EXPERIMENTS, "one", Experiment(name, "", ENV_ID, 1200, variants))
    with pytest.raises(ValueError, match=r'EXPERIMENTS\["one"\] is an Experiment named .* expected the same name'):
        main(["experiment", "one", "--runs", str(tmp_path)])


def test_of_two_unfinished_runs_the_newer_one_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell,) = Experiment("one", "", ENV_ID, 1200, (Variant("htr-ser", "tiny", OF_CELL),), 1).cells()
    runs = [cell.run_folder(tmp_path) / cell.method / f"{ENV_ID}_{number}" for number in (9, 10)]
    for run in runs:
        write_checkpoint(run / "checkpoints" / "400_steps", {})
    given: list[list[str]] = []

    def stop(arguments: list[str]) -> None:
        given.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "main", stop)
    with pytest.raises(KeyboardInterrupt):
        run_cell(cell, tmp_path)
    assert given == [["--resume", str(runs[1])]]


def test_a_killed_run_goes_on_and_a_finished_one_is_tested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variant = Variant("htr-ser", "tiny", OF_CELL, {"n_test_tasks": 10})
    evaluations = by(("belief", "prior"), {}, {"goal_distance": 0.3})
    experiment = Experiment("one", "", ENV_ID, 1200, (variant,), 1, 480, evaluations, n_episodes=5)
    (cell,) = experiment.cells()
    folder = cell.run_folder(tmp_path)
    train.main([*cell.training(folder), "--save-freq", "1"])
    run = next(folder.glob("*/*"))
    (run / f"{cell.env_id}.zip").unlink()
    steps = checkpoints(run)[0].name
    result = cell.result(tmp_path)
    assert run_cell(cell, tmp_path)
    assert f"Going on from {run / 'checkpoints' / steps}" in (folder / "log.txt").read_text()
    raw = np.load(result)
    assert raw["timesteps"].tolist() == [480, 960] and len(list(folder.glob("*/*"))) == 1
    tests = ["belief", "prior", "belief goal_distance=0.3", "prior goal_distance=0.3"]
    assert [key for key in raw if key.startswith("returns_")] == [f"returns_{test}" for test in tests]
    assert all(raw[f"returns_{test}"].shape == raw[f"successes_{test}"].shape == (2, 10, 5) for test in tests)
    assert raw["successes_prior goal_distance=0.3"].sum() > raw["successes_prior"].sum(), "near goals are found by chance"
    assert (raw["returns_prior goal_distance=0.3"][0] != raw["returns_prior goal_distance=0.3"][1]).any()
    monkeypatch.setattr(train, "main", refuse)
    changed = result.stat().st_mtime_ns
    assert run_cell(cell, tmp_path) and result.stat().st_mtime_ns == changed, "a result is not made again"
    assert str(raw["machine"]) == f"{hardware('cpu')}, one thread per run, Python {platform.python_version()}"
    # As from another place, where it was trained: without checkpoints and results
    shutil.rmtree(run / "checkpoints")
    record = json.loads((run / "run.json").read_text())
    there = {"hardware": ["a core", "a core, a GPU"], "versions": {"python": "3.99"}}
    (run / "run.json").write_text(json.dumps({**record, **there}))
    others = replace(cell, experiment="other", evaluations=by(("prior",)))
    assert run_cell(others, tmp_path)
    again = np.load(others.result(tmp_path))
    assert (again["returns_prior"] == raw["returns_prior"]).all() and "returns_belief" not in again
    trained = "a core, then a core, a GPU, one thread per run, Python 3.99"
    assert str(again["machine"]) == f"{trained}, evaluated on {hardware('cpu')}, Python {platform.python_version()}"
    with pytest.raises(
        ValueError,
        match="seed 1, but other/tiny-n_test_tasks10-seed2 needs 2, as the experiment or the YAML file says: move this run",
    ):
        find_finished(replace(others, seed=2), folder)
    with pytest.raises(ValueError, match=r"has batch_size 4, but .* needs 5"):
        find_finished(replace(others, settings={**OF_CELL, "batch_size": 5}), folder)
    assert find_finished(replace(others, n_timesteps=1200), tmp_path / "nowhere") is None


def test_a_killed_evaluation_goes_on_after_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless the code is another one by then."""
    tests = by(("prior", "belief"), {}, {"goal_distance": 0.3})
    (cell,) = Experiment("one", "", ENV_ID, 480, (TINY,), 1, 480, tests, n_episodes=3).cells()
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.mkdir()
    most, made = 5, list[str]()

    def evaluate_or_die(*args: Any, **kwargs: Any) -> Any:
        if len(made) == most:
            raise KeyboardInterrupt
        made.append(kwargs["explorer"].name)
        return evaluate_adaptation(*args, **kwargs)

    monkeypatch.setattr("sb3_htr.experiments.protocol.evaluate_adaptation", evaluate_or_die)
    with pytest.raises(KeyboardInterrupt):
        run_cell(cell, here)
    shutil.copytree(here, elsewhere)
    monkeypatch.setattr(train, "main", refuse)
    made.clear()
    most = 99
    next(here.rglob(f"{FOLDER}/*")).write_bytes(b"damaged")
    assert run_cell(cell, here) and made[-4:] == ["prior", "prior", "belief", "belief"] and len(made) == 6
    made.clear()
    monkeypatch.setattr("sb3_htr.experiments.runner.digest_of_code", lambda modules: "other")
    assert run_cell(cell, elsewhere) and len(made) == 8
    one, other = (np.load(cell.result(runs)) for runs in (here, elsewhere))
    assert all((one[key] == other[key]).all() for key in one if key.startswith(("returns", "successes")))
    assert not list(tmp_path.rglob(FOLDER)), "what is in a result is kept no longer"


def test_a_spoilt_log_is_named(tmp_path: Path) -> None:
    (cell,) = Experiment("one", "", ENV_ID, 960, (TINY,), 1, 480, by(("prior",)), n_episodes=2).cells()
    assert run_cell(cell, tmp_path)
    run, _ = find_finished(cell, cell.run_folder(tmp_path)) or pytest.fail("there is one")
    progress, evaluations = run / "progress.csv", run / "evaluations.npz"
    text = progress.read_text()
    cell.result(tmp_path).unlink()
    for spoilt in ("", text.splitlines()[0] + "\n", text[: text.index("\n") + 9], text.replace("time_elapsed", "time")):
        progress.write_text(spoilt)
        with pytest.raises(ValueError, match=rf"{progress} is missing or damaged\. Its run has to be trained again: remove"):
            run_cell(cell, tmp_path)
    evaluations.unlink()
    with pytest.raises(OSError, match=rf"{evaluations} cannot be read .*Its run has to be trained again: remove"):
        run_cell(cell, tmp_path)


def test_a_last_checkpoint_that_cannot_be_written_is_no_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The grid goes on with its other cells, and says why this one did not end."""
    (cell,) = Experiment("one", "", ENV_ID, 960, (TINY,), 1, 480, n_episodes=2).cells()

    def write_unless_last(folder: Path, state: dict[str, Any]) -> None:
        if state["model"]["counters"]["num_timesteps"] >= 960:
            raise OSError(28, "No space left on device")
        write_checkpoint(folder, state)

    monkeypatch.setattr("sb3_htr.common.checkpoint_callback.write_checkpoint", write_unless_last)
    with pytest.raises(OSError, match=r"The last checkpoint of .* could not be written: mend that, and `sb3-htr train"):
        train.main([*cell.training(cell.run_folder(tmp_path)), "--save-freq", "1"])
    with pytest.raises(OSError, match=r"The last checkpoint of .* could not be written"):
        run_cell(cell, tmp_path)


def test_a_result_that_is_half_written_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell,) = Experiment("one", "", ENV_ID, 1200, (TINY,), 1).cells()
    monkeypatch.setattr("sb3_htr.experiments.runner._train_and_evaluate", lambda *_: {"seed": 1})
    monkeypatch.setattr(np, "savez_compressed", half_written)
    with pytest.raises(KeyboardInterrupt):
        run_cell(cell, tmp_path)
    assert not cell.result(tmp_path).exists()


def test_the_command_repeats_an_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With `--quick`, one seed and a tenth of the env steps; each cell trains by its method, with its settings."""
    settings = {**OF_CELL, "replay_buffer_kwargs": {"relabeller": {"cell_size": 0.3}}}
    variants = (
        Variant("htr-ec", "coarse", settings, {"goal_distance": 0.5, "n_test_tasks": 4}),
        Variant("pearl-sparse-prior", "", OF_CELL, {"n_test_tasks": 4}),
    )
    experiment = Experiment("tiny", "Two tiny runs.", ENV_ID, 9600, variants, 1, 4800, by(("belief",)), n_episodes=3)
    monkeypatch.setitem(grid.EXPERIMENTS, "tiny", experiment)
    monkeypatch.setattr("sb3_htr.experiments.executors.Processes", lambda _: SerialExecutor())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["experiment", "--help"])
    assert "SparsePointRobot-v0: Two tiny runs." in capsys.readouterr().out
    assert main(["experiment", "tiny", "--quick", "--jobs", "1"]) == 0
    results, runs = tmp_path / "results" / "quick-tiny", tmp_path / "runs" / "quick"
    raw = {"raw-htr-ec.npz", "raw-pearl-sparse-prior.npz"}
    assert {path.name for path in results.iterdir()} == {"tiny.png", "reliability.png", "summary.json", *raw}
    summary = json.loads((results / "summary.json").read_text())
    assert summary["command"] == "sb3-htr experiment tiny --quick --seeds 1", "what repeats these results"
    coarse, plain = (replace(agent_at(cell.run_folder(runs)), trusted=True) for cell in experiment.cells(1, 0.1))
    assert (coarse.method, plain.method) == ("htr-ec", "pearl-sparse-prior")
    assert coarse.record["env_kwargs"] == {"goal_distance": 0.5, "n_test_tasks": 4} and coarse.record["n_timesteps"] == 960
    trained = coarse.load()
    assert isinstance(trained, PEARL)
    relabeller: Any = trained.replay_buffer_kwargs["relabeller"]
    assert relabeller["name"] == "EpisodeClustering" and relabeller["cell_size"] == 0.3
    assert plain.load().explorer.name == "prior"


def test_results_of_other_settings_are_not_taken_for_those_of_a_cell(tmp_path: Path) -> None:
    (cell,) = Experiment("one", "", ENV_ID, 480, (TINY,), 1, 480, by(("prior",)), n_episodes=2).cells()
    assert run_cell(cell, tmp_path)
    for other in (
        replace(cell, settings={**OF_CELL, "gamma": 0.5}),
        replace(cell, n_timesteps=960),
        replace(cell, n_episodes=3),
    ):
        with pytest.raises(ValueError, match="move it away with its run"):
            run_cell(other, tmp_path)
    result = cell.result(tmp_path)
    np.savez(result, **{key: value for key, value in np.load(result).items() if key != "cell"})
    with pytest.raises(ValueError, match=r"lacks \['cell'\]\. Remove it: the same command then evaluates its run again"):
        run_cell(cell, tmp_path)
    result.unlink()
    with pytest.raises(ValueError, match=r"has --eval-episodes '2', but .* needs '3'"):
        find_finished(replace(cell, n_episodes=3), cell.run_folder(tmp_path))
    with pytest.raises(ValueError, match=r"has --eval-freq '480', but .* needs '240'"):
        find_finished(replace(cell, eval_freq=240), cell.run_folder(tmp_path))


def test_a_run_by_another_file_of_settings_is_not_that_of_a_cell(tmp_path: Path) -> None:
    (cell,) = Experiment("one", "", ENV_ID, 480, (TINY,), 1, 480, by(("prior",)), n_episodes=2).cells()
    blocks = yaml.safe_load(hyperparams_file("pearl.yml").read_text())
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({"default": {**blocks["default"], "kl_coef": 7.0}}))
    assert main([*["train", *cell.training(cell.run_folder(tmp_path))], "-conf", str(tmp_path / "mine.yml")]) == 0
    with pytest.raises(
        ValueError, match=r"has kl_coef 7\.0, but one/tiny-n_test_tasks4-seed1 needs None, as the experiment or the YAML"
    ):
        run_cell(cell, tmp_path)


def test_a_training_that_was_interrupted_in_its_last_updates_is_not_finished(tmp_path: Path) -> None:
    """It leaves a model of as many env steps as were planned."""
    (cell,) = Experiment("one", "", ENV_ID, 480, (TINY,), 1, 480, by(("prior",)), n_episodes=2).cells()
    folder = cell.run_folder(tmp_path)
    assert main(["train", *cell.training(folder)]) == 0
    run, _ = find_finished(cell, folder) or pytest.fail("there is one")
    (last,) = checkpoints(run)
    last.rename(last.with_name("240_steps"))
    assert find_finished(cell, folder) is None


def test_explorers_and_episodes_are_those_of_the_experiment(tmp_path: Path) -> None:
    """Of the training, its evaluations, and the final model's."""
    explorer = {"name": "prior", "n_exploration_episodes": 2}
    variant = Variant("pearl-sparse-prior", "", {**OF_CELL, "explorer": explorer}, {"n_test_tasks": 4, "goal_distance": 0.3})
    experiment = Experiment("few", "", ENV_ID, 480, (variant,), 1, 480, by(("prior", "aggregate")), n_episodes=3)
    (cell,) = experiment.cells()
    assert run_cell(cell, tmp_path)
    run, model = find_finished(cell, cell.run_folder(tmp_path)) or pytest.fail("there is one")
    assert np.load(run / "evaluations.npz")["returns"].shape == (1, 20, 3)
    raw = np.load(cell.result(tmp_path))
    assert raw["returns_prior"].shape == raw["returns_aggregate"].shape == (2, 4, 3)
    env = make_task_vec_env(ENV_ID, 4, env_kwargs=cell.env_kwargs)
    by_itself, _ = evaluate_adaptation(model, env, n_episodes=3, seed=1)
    assert (raw["returns_prior"][0] == by_itself.astype(np.float32)).all()
    # What nobody has set is as it is today, for all explorers of a table, whatever it was when the model was saved
    as_today, _ = evaluate_adaptation(model, env, n_episodes=3, explorer=Prior(), seed=1)
    anew = evaluate(cell, model, None, lambda name, make: make())
    assert (anew["returns_prior"][0] == as_today.astype(np.float32)).all()
    assert (as_today != by_itself).any()


def test_plain_settings_of_a_variant_reach_its_evaluation(tmp_path: Path) -> None:
    """Its models are loaded as those of strangers are."""
    kwargs = {"n_test_tasks": 4}
    networks = {"net_arch": [8], "encoder_arch": [8], "n_critics": 3, "optimizer_kwargs": {"eps": 1e-5}}
    trial: dict[str, Any] = {"n_envs": 4, "n_episodes_per_trial": 2, "n_epochs": 1}
    trial["policy_kwargs"] = {"lstm_hidden_size": 4, "net_arch": [4], "log_std_init": -0.5}
    of_sac = {"n_envs": 4, "gradient_steps": 1, "policy_kwargs": {"net_arch": [4]}}
    variants = (
        Variant("htr-ser", "critics", {**OF_CELL, "policy_kwargs": networks}, kwargs),
        Variant("rl2", "trials", trial, kwargs),
        Variant("sac-her", "told", of_sac, kwargs),
    )
    for cell in Experiment("settings", "", ENV_ID, 960, variants, 1, 960, by(("prior",)), n_episodes=2).cells():
        assert run_cell(cell, tmp_path)
        agent = agent_at(cell.run_folder(tmp_path), "last")
        both = [replace(agent, trusted=trust).load() for trust in (False, True)]
        ours, theirs = (evaluate_adaptation(model, ENV_ID, "validation", n_episodes=1) for model in both)
        np.testing.assert_array_equal(ours, theirs)


def test_settings_that_could_not_be_evaluated_are_not_trained_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_htr.experiments.runner.train.main", None)
    for settings, message in (
        ({"policy_kwargs": {"activation_fn": nn.Tanh}}, "its policy has the setting 'activation_fn'"),
        ({"buffer_size": 10**8}, "PEARL has no buffer_size of 100000000 here"),
    ):
        (cell,) = Experiment("one", "", ENV_ID, 480, (Variant("htr-ser", "", settings),), 1).cells()
        with pytest.raises(ValueError, match=f"could not be evaluated: {message}"):
            run_cell(cell, tmp_path)


def test_a_file_of_settings_is_read_as_a_training_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the run would be another one than the cell's, when it has been trained."""
    block: dict[str, Any] = {"policy": "MlpPolicy", "policy_kwargs": "{'latent_dim': 3}", "replay_buffer_kwargs": None}
    monkeypatch.setattr("sb3_htr.experiments.runner.block_of", lambda *_: dict(block))
    (cell,) = Experiment("one", "", ENV_ID, 480, (Variant("htr-ser"),), 1).cells()
    assert hyperparams_of(cell)["policy_kwargs"] == {"latent_dim": 3}
    assert "relabeller" in hyperparams_of(cell)["replay_buffer_kwargs"]
    block["env_kwargs"] = {"goal_distance": 0.8}
    with pytest.raises(ValueError, match=r"htr-ser.* would be trained with env_kwargs .*: give them to the Variant"):
        run_cell(cell, tmp_path)


@pytest.mark.parametrize(
    "settings",
    [
        {"policy_kwargs": "{'latent_dim': 3}"},
        {"policy_kwargs": "dict(latent_dim=3)"},
        {"policy_kwargs": {"latent_dim": 0}},
        {"policy_kwargs": {"latentdim": 3}},
        {"buffer_size": "large"},
    ],
)
def test_what_is_for_the_training_to_say_is_left_to_it(settings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Begun(Exception):
        pass

    def begin(_: Any) -> None:
        raise Begun

    monkeypatch.setattr("sb3_htr.experiments.runner.train.main", begin)
    (cell,) = Experiment("one", "", ENV_ID, 480, (Variant("htr-ser", "", settings),), 1).cells()
    with pytest.raises(Begun):
        run_cell(cell, tmp_path)


def test_the_code_that_evaluated_is_that_of_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever was committed since it began."""
    (cell,) = Experiment("one", "", ENV_ID, 480, (TINY,), 1, 480, by(("prior",)), n_episodes=2).cells()
    monkeypatch.setattr("sb3_htr.common.versions.commit", lambda: {"commit": "later", "dirty": False})
    monkeypatch.setattr("sb3_htr.experiments.runner.commit", lambda: {"commit": "later", "dirty": False}, raising=False)
    assert run_cell(cell, tmp_path)
    assert "later" not in str(np.load(cell.result(tmp_path))["evaluation_commit"])


def test_infinity_can_be_a_setting() -> None:
    settings = {"replay_buffer_kwargs": {"relabeller": {"temperature": math.inf}}}
    (cell,) = Experiment("one", "", ENV_ID, 480, (Variant("htr-hfr", "random", settings),), 1).cells()
    (given,) = [word for word in cell.training(Path("x")) if word.startswith("replay_buffer_kwargs:")]
    assert eval(given.partition(":")[2], {}) == settings["replay_buffer_kwargs"]


def test_one_cell_of_a_job_array_writes_no_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(grid.EXPERIMENTS, "pair", Experiment("pair", "", ENV_ID, 480, (Variant("htr-ser"),), 2))
    ran: list[tuple[str, Path]] = []

    def make_result(cell: Cell, runs: Path) -> bool:
        cell.result(runs).parent.mkdir(parents=True)
        cell.result(runs).touch()
        ran.append((cell.name, runs))
        return True

    monkeypatch.setattr("sb3_htr.experiments.storage.folder.run_cell", make_result)
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", "pair", "--cell", "1", "--runs", "here"]) == 0
    assert ran == [("htr-ser-seed2", tmp_path / "here")] and not Path("results").exists()
    with pytest.raises(ValueError, match="--cell is 2, expected 0 to 1"):
        main(["experiment", "pair", "--cell", "2"])


def test_one_command_runs_several_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their cells have the same names, are in one queue, and go on; each experiment has results of its own."""
    queue: list[str] = []

    def train(cell: Cell, runs: Path) -> bool:
        queue.append(f"{cell.experiment} {cell.env_kwargs} {cell.name[-5:]}")
        cell.result(runs).parent.mkdir(parents=True, exist_ok=True)
        made_up([cell], cell.result(runs).parent)
        return True

    for name, distance in (("near", 0.5), ("far", 2.0)):
        variants = (
            Variant("htr-ser", settings={"gamma": distance / 4}, env_kwargs={"goal_distance": distance}),
            Variant("rl2"),
        )
        experiment = Experiment(name, "", ENV_ID, 480, variants, 1, eval_freq=240, evaluations=by(("prior",)))
        monkeypatch.setitem(grid.EXPERIMENTS, name, experiment)
    monkeypatch.setattr("sb3_htr.experiments.storage.folder.run_cell", train)
    monkeypatch.setattr("sb3_htr.experiments.executors.Processes", lambda _: SerialExecutor())
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", "near", "far", "--cell", "3"]) == 0
    assert queue == ["far {} seed1"] and not Path("results").exists()
    assert main(["experiment", "near", "far", "-o", "both"]) == 0
    assert queue[1:] == ["near {'goal_distance': 0.5} seed1", "near {} seed1", "far {'goal_distance': 2.0} seed1"]
    for name in ("near", "far"):
        summary = json.loads(Path("both", name, "summary.json").read_text())
        assert summary["name"] == name and {row["variant"] for row in summary["rows"]} == {"htr-ser", "rl2"}
        assert summary["command"] == f"sb3-htr experiment {name} --seeds 1"
    assert main(["experiment", "near", "far", "-o", "again", "--runs", "elsewhere", "--with-results", "both"]) == 0
    assert len(queue) == 4, "nothing was trained again"
    summary = json.loads(Path("again", "far", "summary.json").read_text())
    assert summary["command"] == "sb3-htr experiment far --seeds 1 --with-results both/far"
    Path("both").rename("all of both")
    again = ["-o", "once more", "--runs", "elsewhere", "--with-results", "all of both/far"]
    assert main(["experiment", "far", *again]) == 0
    summary = json.loads(Path("once more", "summary.json").read_text())
    assert summary["command"] == "sb3-htr experiment far --seeds 1 --with-results 'all of both/far'"
    with pytest.raises(ValueError, match=r"near has no run of near: expected raw-METHOD.npz"):
        main(["experiment", "near", "far", "--runs", "third", "--with-results", "both/near"])


def test_an_experiment_that_is_whole_is_reported_whatever_others_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(cell: Cell, runs: Path) -> bool:
        if cell.name == "htr-ser-seed2":
            raise RuntimeError("no luck")
        cell.result(runs).parent.mkdir(parents=True, exist_ok=True)
        made_up([cell], cell.result(runs).parent)
        return True

    for name, n_seeds in (("broken", 2), ("whole", 1)):
        experiment = Experiment(name, "", ENV_ID, 480, (Variant("htr-ser"),), n_seeds, evaluations=by(("prior",)))
        monkeypatch.setitem(grid.EXPERIMENTS, name, experiment)
    monkeypatch.setattr("sb3_htr.experiments.storage.folder.run_cell", train)
    monkeypatch.setattr("sb3_htr.experiments.executors.Processes", lambda _: SerialExecutor())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"1 of 3 cells failed .*failed 3 times: .*no luck"):
        main(["experiment", "broken", "whole"])
    assert "1 of 2 runs of broken are finished." in capsys.readouterr().out
    assert Path("results", "whole", "summary.json").exists() and not Path("results", "broken").exists()
    with pytest.raises(ValueError, match="no luck"):
        main(["experiment", "broken", "--cell", "1"])


def test_results_of_what_is_finished_are_written_without_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = Experiment("pair", "", ENV_ID, 480, (Variant("htr-ser"),), 2, eval_freq=240, evaluations=by(("prior",)))
    monkeypatch.setitem(grid.EXPERIMENTS, "pair", pair)
    monkeypatch.setattr("sb3_htr.experiments.driver.Driver", None)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(grid.EXPERIMENTS, "none", Experiment("none", "", ENV_ID, 480, (Variant("rl2"),), 1))
    with pytest.raises(ValueError, match=r"No run of pair is finished in .*runs: run it without --finished"):
        main(["experiment", "pair", "--finished"])
    assert not Path("results").exists()
    second = pair.cells()[1]
    second.result(Path("runs")).parent.mkdir(parents=True)
    made_up([second], second.result(Path("runs")).parent)
    with pytest.raises(ValueError, match="No run of none is finished"):
        main(["experiment", "none", "pair", "--finished"])
    output = capsys.readouterr().out
    assert "1 of 2 runs of pair are finished." in output
    assert "| method | explorer | return of episode" in output and "| htr-ser | `prior` | " in output
    summary = json.loads(Path("results", "pair", "summary.json").read_text())
    assert {row["n_seeds"] for row in summary["rows"]} == {1} and summary["command"] == "sb3-htr experiment pair --seeds 2"
    for wrong in (["--cell", "1"], ["--seed", "7"]):
        with pytest.raises(SystemExit):
            main(["experiment", "pair", "--finished", *wrong])


@pytest.mark.parametrize(("arguments", "device"), [([], "cpu"), (["--device", "cuda:0"], "cuda:0")])
def test_runs_are_on_the_cpu_unless_a_device_is_given(
    arguments: list[str], device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there is a GPU, too: bits are promised on a CPU, and tables say on what their runs were trained."""
    seen: list[Cell] = []

    def run(cell: Cell, runs: Path) -> bool:
        seen.append(cell)
        cell.result(runs).parent.mkdir(parents=True)
        made_up([cell], cell.result(runs).parent)
        return True

    only = Experiment("only", "", ENV_ID, 480, (Variant("htr-ser"),), 1, eval_freq=240, evaluations=by(("prior",)))
    monkeypatch.setitem(grid.EXPERIMENTS, "only", only)
    monkeypatch.setattr("sb3_htr.experiments.storage.folder.run_cell", run)
    monkeypatch.setattr("sb3_htr.experiments.command.executors.Processes", lambda n_jobs: SerialExecutor())
    monkeypatch.setattr("sb3_htr.experiments.command.check_device", lambda device: None)
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", "only", *arguments]) == 0
    (cell,) = seen
    words = cell.training(tmp_path)
    assert words[words.index("--device") + 1] == device
    command = json.loads(Path("results", "only", "summary.json").read_text())["command"]
    assert command == " ".join(["sb3-htr experiment only --seeds 1", *arguments])


def test_a_device_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="The device 'gpu' cannot be used: give cpu, cuda or cuda:N"):
        main(["experiment", "point_robot", "--device", "gpu"])
    with pytest.raises(ValueError, match="--device is cuda:1, but Ray chooses which GPU a run sees: give --device cuda"):
        main(["experiment", "point_robot", "--ray", "auto", "--device", "cuda:1"])


def test_results_that_could_not_be_written_are_not_trained_for(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file is a file, expected a folder for the results"):
        main(["experiment", "point_robot", "--runs", str(tmp_path / "runs"), "-o", str(tmp_path / "file")])


def test_the_digest_of_code_is_of_all_that_it_may_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of modules and assets beside one in a folder, and of a module that is alone."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "digested").mkdir()
    for name in ("one.py", "two.py", "robot.xml"):
        (tmp_path / "digested" / name).touch()
    (tmp_path / "digested_alone.py").touch()
    importlib.import_module("digested.one")
    importlib.import_module("digested_alone")
    seen = [(digest_of_code(["digested.one"]), digest_of_code(["digested_alone"]))]
    for name, text in (("digested/two.py", "x = 1"), ("digested/robot.xml", "<mujoco/>"), ("digested_alone.py", "x = 1")):
        (tmp_path / name).write_text(text)
        seen.append((digest_of_code(["digested.one"]), digest_of_code(["digested_alone"])))
    assert len({of_package for of_package, _ in seen}) == 3 and len({alone for _, alone in seen}) == 2
    (tmp_path / "digested" / "__pycache__").mkdir(exist_ok=True)
    for name in ("three.cpython-311.pyc", "three.cpython-311.pyc.140223"):  # another process imports it, and will rename it
        (tmp_path / "digested" / "__pycache__" / name).write_text(name)
    assert digest_of_code(["digested.one"]) == seen[-1][0]
