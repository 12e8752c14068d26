"""Results of one time are part of those of another: nothing is trained twice, mixed up, or lost."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers import ENV_ID
from helpers.results import made_up
from sb3_htr.experiments import executors, grid, raw_results, report
from sb3_htr.experiments.cell import Cell
from sb3_htr.experiments.grid import Experiment, Variant, by
from sb3_htr.zoo.cli import main

THEIRS = tuple(map(Variant, ("htr-ser", "rl2", "pearl-sparse")))


def experiment_of(name: str, *variants: Variant) -> Experiment:
    return Experiment(name, "", ENV_ID, 480, variants, 2, eval_freq=240, evaluations=by(("prior",)))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of an experiment that somebody ran, once for all tests."""
    folder, theirs = tmp_path_factory.mktemp("written"), experiment_of("theirs", *THEIRS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
        report.write("", theirs, made_up(theirs.cells(), folder), folder / "published")
    return folder / "published"


@pytest.fixture(autouse=True)
def published(written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of them, in a working folder without their runs."""
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(grid.EXPERIMENTS, "theirs", experiment_of("theirs", *THEIRS))
    monkeypatch.setitem(grid.EXPERIMENTS, "mine", experiment_of("mine", *THEIRS, Variant("htr-ser", "mine", {"gamma": 0.5})))
    return Path(shutil.copytree(written, tmp_path / "published"))


def test_a_method_of_ones_own_is_trained_alone_and_reported_beside_what_others_ran(
    published: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trained: list[str] = []

    def train(cell: Cell, runs: Path) -> bool:
        trained.append(cell.name)
        made_up([cell], cell.result(runs).parent)
        return True

    monkeypatch.setattr("sb3_htr.experiments.storage.folder.run_cell", train)
    monkeypatch.setattr(executors, "Processes", lambda _: executors.SerialExecutor())
    assert main(["experiment", "mine", "--with-results", "published"]) == 0
    assert "6 of 8 runs are in published." in capsys.readouterr().out
    assert trained == ["mine-seed1", "mine-seed2"]
    rows = json.loads(Path("results", "mine", "summary.json").read_text())["rows"]
    assert {(row["variant"], row["n_seeds"]) for row in rows} == {("htr-ser", 2), ("rl2", 2), ("pearl-sparse", 2), ("mine", 2)}
    assert json.loads(Path("results/mine/summary.json").read_text())["command"].endswith("--seeds 2 --with-results published")
    raw, before = np.load("results/mine/raw-rl2.npz"), np.load(published / "raw-rl2.npz")
    assert {*raw.files} == {*before.files} and all((raw[key] == before[key]).all() for key in before.files)


def test_own_runs_come_before_those_of_others(published: Path) -> None:
    cells = grid.EXPERIMENTS["theirs"].cells()
    own = cells[0].result(Path("runs"))
    own.parent.mkdir(parents=True)
    np.savez(own, **{**np.load(made_up([cells[0]], own.parent)[cells[0]]), "commit": "my own"})
    assert raw_results.unpack(published, cells, Path("runs")) == len(cells)
    assert [str(np.load(cell.result(Path("runs")))["commit"]) for cell in cells] == ["my own"] + ["abc"] * (len(cells) - 1)


def test_runs_of_something_else_are_not_taken(published: Path) -> None:
    cells = grid.EXPERIMENTS["theirs"].cells()
    others = [replace(cell, n_timesteps=960) for cell in cells]
    with pytest.raises(ValueError, match=r"htr-ser-seed1 in .* has n_timesteps 480, but theirs/.* needs 960: leave"):
        raw_results.unpack(published, others, Path("runs"))
    # Also where it lacks what the other thing needs
    others = [replace(cell, n_timesteps=960, evaluations=by(("belief",))) for cell in cells]
    with pytest.raises(ValueError, match=r"htr-ser-seed1 in .* has n_timesteps 480, but theirs/.* needs 960: leave"):
        raw_results.unpack(published, others, Path("runs"))
    others = [replace(cell, evaluations=by(("belief",))) for cell in cells]
    with pytest.raises(ValueError, match=r"htr-ser-seed1 in .* lacks \['returns_belief'\], which theirs needs: leave"):
        raw_results.unpack(published, others, Path("runs"))
    with pytest.raises(ValueError, match=r"nowhere has no run of theirs: expected .* with runs such as htr-ser-seed1"):
        raw_results.unpack(Path("nowhere"), cells, Path("runs"))
    others = [replace(cell, settings={"gamma": 0.5}) for cell in cells]
    with pytest.raises(ValueError, match=r"htr-ser-seed1 in .* has settings {}, but theirs/.* needs {'gamma': 0.5}: leave"):
        raw_results.unpack(published, others, Path("runs"))
    assert not Path("runs").exists(), "all or nothing"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cell": None}, r"htr-ser-seed1 in .* lacks \['cell'\], which theirs needs: leave the folder out"),
        ({"hyperparams": None}, r"lacks \['hyperparams'\]"),
        # As a stranger may write them
        *(
            ({key: text}, "does not say what it is of")
            for key in ("cell", "hyperparams")
            for text in ("[1]", "[" * 99_999, "x")
        ),
        # As where a YAML file has changed since
        (
            {"hyperparams": json.dumps({"gamma": 0.5})},
            r"was trained with other \[.*'gamma'.*\] than theirs/.*-seed1 would be: has .*\? Restore it, or leave",
        ),
        (
            {"hyperparams": json.dumps({"replay_buffer_kwargs": {"context_episodes": 7}})},
            r"was trained with other \[.*'replay_buffer_kwargs.context_episodes'.*\] than theirs/.* would be: has .*\?",
        ),
    ],
)
def test_runs_must_say_what_they_are_of(changed: dict[str, str | None], message: str, published: Path) -> None:
    path = published / "raw-htr-ser.npz"
    raw = dict(np.load(path))
    for key, value in changed.items():
        raw.pop(f"htr-ser-seed1/{key}")
        if value is not None:
            raw[f"htr-ser-seed1/{key}"] = np.array(value)
    np.savez(path, **raw)
    with pytest.raises(ValueError, match=message):
        raw_results.unpack(published, grid.EXPERIMENTS["theirs"].cells(), Path("runs"))


def test_damaged_results_of_others_are_named(published: Path) -> None:
    path = published / "raw-rl2.npz"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"raw-rl2\.npz is damaged, or no npz file\. Leave the folder out of --with-results"):
        raw_results.unpack(published, grid.EXPERIMENTS["theirs"].cells(), Path("runs"))
    assert not Path("runs").exists()


def test_results_do_not_replace_those_of_more_runs(published: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with what is finished so far, nor, before anything is trained, with fewer seeds."""
    monkeypatch.setattr("sb3_htr.experiments.driver.Driver", None)
    before = {path.name: path.read_bytes() for path in published.iterdir()}
    finished = grid.EXPERIMENTS["theirs"].cells()[3]
    finished.result(Path("runs")).parent.mkdir(parents=True)
    made_up([finished], finished.result(Path("runs")).parent)
    message = r"published has 5 runs that these results would not have, htr-ser-seed1 among them: name another folder with -o"
    with pytest.raises(ValueError, match=message):
        main(["experiment", "theirs", "--finished", "-o", "published"])
    with pytest.raises(ValueError, match=r"has 3 runs .* are kept by --with-results published, and as many --seeds"):
        main(["experiment", "theirs", "--seeds", "1", "-o", "published"])
    # Of the same names, and of other settings
    with pytest.raises(ValueError, match=r"-seed\d in .* has (n_timesteps 480|eval_freq 240), but theirs/.*: name another"):
        main(["experiment", "theirs", "--quick", "--seeds", "2", "-o", "published"])
    assert {path.name: path.read_bytes() for path in published.iterdir()} == before
    assert main(["experiment", "theirs", "--finished", "-o", "published", "--with-results", "published"]) == 0
    summary = json.loads((published / "summary.json").read_text())
    assert {row["n_seeds"] for row in summary["rows"]} == {2} and summary["command"] == "sb3-htr experiment theirs --seeds 2"
