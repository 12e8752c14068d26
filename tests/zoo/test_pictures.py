"""What pictures show, and agents whose env cannot be drawn."""

import argparse
import subprocess
import sys
import warnings
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from helpers import ENV_ID, TINY, MakePEARL
from helpers.broken_envs import LineEnv
from helpers.runs import NOWHERE, SHIPPED, make_run
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.common.vec_env import N_ENVS
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands import evaluate, plot
from sb3_htr.zoo.commands.plot import check_same_settings
from sb3_htr.zoo.plots import adaptation, curves, style
from sb3_htr.zoo.plots.style import curve_colours, curve_styles
from sb3_htr.zoo.run.agents import TrainedAgent
from sb3_htr.zoo.run.method import methods


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that are saved."""
    figures: list[Figure] = []
    for module in (adaptation, curves):
        monkeypatch.setattr(module, "save", lambda figure, path: figures.append(figure))
    return figures


class Boastful(LineEnv):
    """Says that it can be drawn, but cannot."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012


@pytest.fixture
def line_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An agent of an env as in docs/own_task_family.md: its constructor knows no render_mode."""
    spec = EnvSpec("SparseLine-v0", "helpers.broken_envs:LineEnv", max_episode_steps=10)
    monkeypatch.setitem(gym.registry, spec.id, spec)
    path = tmp_path / "line.zip"
    PEARL("MlpPolicy", gym.make("SparseLine-v0"), **TINY).save(path)
    return path


def test_an_env_that_cannot_be_drawn_can_be_played(
    line_agent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(line_agent), "--env", "SparseLine-v0"]
    few = ["--n-tasks", "1", "--n-episodes", "1"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["enjoy", *arguments, *few, "--no-render"]) == 0
        assert main(["enjoy", *arguments, *few]) == 0
        assert "SparseLine-v0 cannot draw itself" in capsys.readouterr().out
        assert main(["plot", *arguments, "--n-episodes", "2", "-o", str(tmp_path / "plots")]) == 0
        assert main(["export", *arguments, "-o", str(tmp_path / "agent"), "--n-episodes", "2"]) == 0
        assert "# PEARL on SparseLine-v0" in (tmp_path / "agent" / "README.md").read_text()
    with pytest.raises(ValueError, match="SparseLine-v0 cannot be filmed: 'rgb_array' is not in"):
        main(["record", *arguments, "-o", str(tmp_path / "film.mp4")])
    monkeypatch.setattr(gym.registry["SparseLine-v0"], "entry_point", Boastful)
    with pytest.raises(ValueError, match="SparseLine-v0 cannot draw rgb_array: let the __init__"):
        main(["record", *arguments, "-o", str(tmp_path / "film.mp4")])


def test_paths_begin_at_the_start_and_name_their_task(drawn: list[Figure]) -> None:
    tasks = np.array([[0.0, 1.0], [1.0, 0.0]], dtype=np.float32)
    record = AdaptationRecord(np.ones((2, 3)), np.ones((2, 3), dtype=bool), np.full((2, 3, 4, 2), 0.5, dtype=np.float32))
    start = adaptation.start_position(gym.make(ENV_ID))
    assert start is not None
    adaptation.plot_adaptation_paths(record, tasks, 0.2, start, Path("x.png"), "about")
    axes = drawn[0].axes[0]
    assert axes.get_title().startswith("task 2: solved in episode 1")
    ways = [np.asarray(line.get_xydata()) for line in axes.lines]
    assert all(way.shape == (5, 2) and (way[0] == 0).all() for way in ways)


def test_the_curve_of_an_agent_is_what_was_returned_and_solved_in_an_episode_and_so_far(drawn: list[Figure]) -> None:
    successes = np.array([[False, True, False], [False, False, False]])
    record = AdaptationRecord(2.0 * successes, successes, np.zeros((2, 3, 1, 2)))
    adaptation.plot_adaptation_curve(record, Path("x.png"), "about")
    lines = [line for axes in drawn[0].axes for line in axes.get_lines()]
    shown = {line.get_label(): np.asarray(line.get_ydata()).tolist() for line in lines}
    assert shown == {"mean over tasks": [0, 1, 0], "in this episode": [0, 50, 0], "so far": [0, 50, 50]}


def test_a_learning_curve_is_of_the_env_steps_at_which_all_runs_were_evaluated(tmp_path: Path) -> None:
    agents = list[TrainedAgent]()
    for name, steps in (("a", [1000, 2000, 3000]), ("b", [2000, 3000])):
        agents.append(TrainedAgent(tmp_path / name / "x.zip", {"method": "htr-ser"}, tmp_path / name))
        (tmp_path / name).mkdir()
        returns = np.array(steps)[:, None, None] * np.ones((1, 4, 2))
        np.savez(tmp_path / name / "evaluations.npz", timesteps=steps, returns=returns, successes=returns > 2500)
    curve = plot.learning_curve("both", agents)
    assert curve is not None and curve.x.tolist() == [2, 3]
    assert curve.returns.tolist() == [[2000, 3000]] * 2 and curve.successes.tolist() == [[0, 1]] * 2


def test_a_host_keeps_the_backend_that_it_chose() -> None:
    code = "import matplotlib; matplotlib.use('svg'); import sb3_htr.zoo.plots.curves; print(matplotlib.get_backend())"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "svg\n"


def test_curves_say_what_they_show(drawn: list[Figure], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 200)
    for n_seeds, n_points, said in (
        (1, 21, "env"),
        (2, 15, "env; mean and range of 2 seeds"),
        (3, 15, "env; mean and range of 3 seeds"),
        (4, 2, "env; IQM over seeds, 95 % interval"),
    ):
        zeros = np.zeros((n_seeds, n_points))
        plots_of = {"_a": curves.Curve(np.arange(n_points), zeros, zeros, "htr-ser")}
        curves.plot_curves(plots_of, Path("x.png"), "env", "x", "return")
        left, right = drawn[-1].axes
        assert [axes.get_ylabel() for axes in (left, right)] == ["return", "share of tasks solved (%)"]
        assert drawn[-1].get_suptitle() == said
        assert left.get_legend_handles_labels()[1], "whatever a folder is called"
        line: Any = left.lines[0]
        assert line.get_marker() == "o" and n_points / line.get_markevery() <= 12
        assert left.get_ylim()[1] >= 1 and left.get_ylim()[0] < 0, "zeros are no noise"
        assert right.get_ylim() == (-4, 104)


def test_curves_that_coincide_are_all_seen(tmp_path: Path) -> None:
    names = ["pearl-sparse", "htr-hfr", "htr-hipi"]
    zeros = np.zeros((1, 12))
    plots_of = {name: curves.Curve(np.arange(12), zeros, zeros, name) for name in names}
    curves.plot_curves(plots_of, tmp_path / "x.png", "env", "x", "return")
    pixels = plt.imread(tmp_path / "x.png")[:420, :, :3]  # above the legend
    for name, (colour, _) in zip(names, curve_styles(names), strict=True):
        n_seen = (np.abs(pixels - to_rgb(colour)).max(axis=-1) < 0.02).sum()
        assert n_seen >= 24, f"{name} is hidden"


# Of linear RGB, as it is seen without one kind of cones: Machado, Oliveira and Fernandes, 2009, severity 1
VISION = {
    "all": np.eye(3).tolist(),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
# From linear RGB to Oklab, in which distances are as they are seen: Ottosson, 2020
TO_CONES = [[0.412221, 0.536333, 0.051446], [0.211903, 0.680700, 0.107397], [0.088302, 0.281719, 0.629979]]
TO_OKLAB = [[0.210454, 0.793618, -0.004072], [1.977998, -2.428592, 0.450594], [0.025904, 0.782772, -0.808676]]


@pytest.mark.parametrize("vision", VISION)
def test_colours_are_told_apart_by_all_kinds_of_vision(vision: str) -> None:
    rgb = np.array([to_rgb(colour) for colour in style.COLOURS])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(VISION[vision]), 0, 1)
    points = np.cbrt(seen @ np.transpose(TO_CONES)) @ np.transpose(TO_OKLAB)
    distances = {(one, other): np.linalg.norm(points[one] - points[other]) for one, other in combinations(range(len(rgb)), 2)}
    closest = min(distances, key=lambda pair: distances[pair])
    assert distances[closest] > 0.07, f"{[style.COLOURS[i] for i in closest]}, and 0.02 is all that is seen"


def test_thin_grey_lines_are_seen_on_white() -> None:
    """A contrast of 3 and more, as WCAG 2.1 asks of what a picture is understood by (1.4.11)."""
    grey = to_rgb(style.GREY)[0]
    assert 1.05 / (((grey + 0.055) / 1.055) ** 2.4 + 0.05) >= 3


def test_markers_are_told_apart_without_their_colours() -> None:
    ink = []
    for colour in style.COLOURS:
        figure = Figure(figsize=(0.25, 0.25), dpi=120)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.axis("off")
        curves.band(axes, np.arange(3), np.zeros((1, 3)), colour, "-", "")
        axes.lines[0].set(color="black", markevery=[1])
        canvas.draw()
        ink.append(1 - np.asarray(canvas.buffer_rgba())[..., 0] / 255)
    for one, other in combinations(ink, 2):
        assert np.minimum(one, other).sum() / np.maximum(one, other).sum() < 0.82, "as of a circle and a hexagon"


@pytest.mark.parametrize("n_curves", [1, 24])
def test_a_legend_covers_no_label(n_curves: int, drawn: list[Figure]) -> None:
    zeros = np.zeros((1, 3))
    plots_of = {f"mine {i}": curves.Curve(np.arange(3), zeros, zeros, f"mine {i}") for i in range(n_curves)}
    curves.plot_curves(plots_of, Path("x.png"), "env", "x", "return")
    (figure,) = drawn
    figure.draw_without_rendering()
    for axes in figure.axes:
        label, legend = axes.xaxis.label.get_window_extent(), axes.get_legend()
        assert legend is not None and 0 < label.y0 - legend.get_window_extent().y1 < figure.dpi / 4


def test_a_method_has_one_colour_in_all_pictures() -> None:
    every = dict(zip(methods(), curve_styles(list(methods())), strict=True))
    assert len(set(every.values())) == len(every), "no two methods look alike"
    assert every["htr-ser-prior"] == (every["htr-ser"][0], "--")
    for name, own in every.items():
        other, again = curve_styles(["mine", name])
        assert again == own != other
        first, second = curve_styles([name, name])
        assert first == own != second, "two settings of one method are told apart"
    assert len(curve_styles([f"mine {i}" for i in range(99)])) == 99


def test_where_lines_tell_something_else_no_two_methods_have_one_colour() -> None:
    own = {name: colour for name, (colour, _) in zip(methods(), curve_styles(list(methods())), strict=True)}
    names = ["htr-ser", "htr-ec", "pearl-dense", "pearl-sparse", "pearl-sparse-prior"]
    colours = curve_colours(names)
    assert len(set(colours)) == len(names)
    assert colours[:4] == [own[name] for name in names[:4]]
    alone = ["htr-ser-prior", "pearl-dense-prior"]
    assert curve_colours(alone) == [own[name] for name in alone]


@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_name_of_a_picture_says_which_kind_it_is(kind: str, begin: bytes, tmp_path: Path) -> None:
    style.save(Figure(), tmp_path / f"picture.{kind}")
    assert (tmp_path / f"picture.{kind}").read_bytes().startswith(begin)


def test_plot_draws_all_pictures_of_an_agent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", *NOWHERE, "--n-episodes", "6", "-o", str(tmp_path), "--format", "svg"]) == 0
    names = {"adaptation_curve.svg", "adaptation_paths.svg", "latent_space.svg"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert all(path.stat().st_size > 10_000 and "<svg" in path.read_text() for path in tmp_path.iterdir())
    assert "No learning curves" in capsys.readouterr().out
    with pytest.raises(ValueError, match="--n-episodes is 0, expected a whole number of at least 1"):
        main(["plot", *NOWHERE, "--n-episodes", "0"])


@pytest.mark.parametrize("command", [evaluate, plot])
def test_an_env_that_is_only_looked_at_is_closed(command: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at, closed = list[gym.Env](), list[gym.Env]()

    def noting(env: gym.Env) -> np.ndarray | None:
        looked_at.append(env)
        monkeypatch.setattr(env, "close", lambda: closed.append(env))
        return adaptation.start_position(env)

    monkeypatch.setattr(command, "start_position", noting)
    command.main([*NOWHERE, "--n-episodes", "1", "-o", str(tmp_path)])
    assert looked_at and closed == looked_at


def test_what_is_drawn_is_what_is_evaluated() -> None:
    agent = TrainedAgent(SHIPPED, {"method": "htr-ser", "env_id": ENV_ID, "env_kwargs": {}}, None)
    how = {"tasks": "test", "n_episodes": 2, "explorer": "belief", "stochastic": False, "seed": 3, "device": "cpu"}
    adapted = plot.adapt(agent, argparse.Namespace(**how))
    returns, successes = evaluate_adaptation(agent.load(), ENV_ID, "test", 2, "belief", seed=3)
    np.testing.assert_array_equal(adapted.record.returns, returns)
    assert len(returns) > N_ENVS, "in several adaptations"
    tasks, mean, deviation, known_z = adapted.latent  # type: ignore[misc]
    assert len(tasks) == len(mean) == len(deviation) == successes.any(axis=1).sum() > 0 and len(known_z)
    assert (tasks == adapted.tasks[successes.any(axis=1)]).all()


def test_plot_draws_seeds_as_one_curve(
    tmp_path: Path, tiny_pearl: MakePEARL, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        for number in (1, 2):
            make_run(folder, tiny_pearl(seed=number), number)
    # Goals out of reach
    arguments = [*map(str, folders), "--n-episodes", "2", "-o", str(tmp_path / "plots"), "--env-kwargs", "goal_distance:9"]
    assert main(["plot", *arguments]) == 0
    output = capsys.readouterr().out
    assert "learning_curves.png" in output and "adaptation_curve.png" in output and "No latent space: one found" in output
    with pytest.raises(ValueError, match="--labels needs one name of its own for each of the 2 folders"):
        main(["plot", *arguments, "-l", "same", "same"])
    with pytest.raises(ValueError, match=r"The runs in one differ in \['gamma'\]"):
        make_run(folders[0], tiny_pearl(), 3, hyperparams={"explorer": {"name": "belief"}, "gamma": 0.5})
        main(["plot", *arguments])
    check_same_settings("none", [])
    make_run(folders[1], tiny_pearl(seed=2), 3, seed=2)
    with pytest.raises(ValueError, match="Several runs in other have the seed 2, as a copy of one has"):
        main(["plot", str(folders[1]), "--only", "learning"])


@pytest.mark.parametrize(("only", "n_adapted"), [(["paths", "latent"], 1), (["paths", "adaptation"], 3)])
def test_only_those_adapt_that_are_drawn(
    only: list[str], n_adapted: int, tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (1, 2):
        make_run(tmp_path / "seeds", tiny_pearl(seed=number), number)
    make_run(tmp_path / "other", tiny_pearl(), 1)
    adapted, adapt = list[Path](), plot.adapt

    def noting(agent: TrainedAgent, args: argparse.Namespace) -> plot.Adapted:
        adapted.append(agent.path)
        return adapt(agent, args)

    monkeypatch.setattr(plot, "adapt", noting)
    folders = [str(tmp_path / name) for name in ("seeds", "other")]
    assert main(["plot", *folders, "--n-episodes", "1", "--only", *only, "-o", str(tmp_path / "plots")]) == 0
    assert len(adapted) == n_adapted and "seeds" in str(adapted[0])


@pytest.mark.parametrize(
    ("arguments", "different"),
    [
        (["-i", "agent.zip"], "-i"),
        (["--trained-agent=agent.zip"], "-i"),
        (["--eval-env-kwargs", "goal_distance:0.2", "goal_radius:1"], "--eval-env-kwargs"),
        (["--eval-episodes", "3"], "--eval-episodes"),
        (["--eval-episodes", "20", "--eval-freq", "-1"], None),
    ],
)
def test_runs_on_one_curve_began_and_were_evaluated_alike(arguments: list[str], different: str | None) -> None:
    record: dict[str, Any] = {"hyperparams": {}, "env_kwargs": {}}
    runs = [TrainedAgent(Path("a"), {**record, "arguments": more}, None) for more in ([], arguments)]
    if different is None:
        check_same_settings("one", runs)
        return
    with pytest.raises(ValueError, match=rf"The runs in one differ in \['{different}'\]"):
        check_same_settings("one", runs)


def test_plot_says_what_is_missing_in_a_curve(
    tmp_path: Path, tiny_pearl: MakePEARL, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tiny_pearl()
    runs = [make_run(tmp_path / "runs", model, number) for number in (1, 2, 3)]
    (runs[1] / "evaluations.npz").unlink()
    with np.load(runs[2] / "evaluations.npz") as file:
        first = {name: values[:1] for name, values in file.items()}
    np.savez(runs[2] / "evaluations.npz", **first)
    other_code: dict[str, Any] = {"commit": "0123456789", "versions": {"torch": "1.0"}}
    far = make_run(tmp_path / "far", model, env_kwargs={"goal_distance": 2.0}, **other_code)
    command = ["plot", str(tmp_path / "runs"), str(far), "-l", "near", "far", "--only", "learning", "-o", str(tmp_path / "o")]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert f"{runs[1]} has no evaluations.npz, and is not in the learning curve" in said
    assert f"{runs[2]} was evaluated up to 480 of 960 env steps, where the curve of near ends" in said
    assert "different arguments, {'near': {}, 'far': {'goal_distance': 2.0}}: their tasks are not the same" in said
    assert "Not all of these runs were made by one code: commit unknown -> 0123456789, torch unknown -> 1.0." in said
    assert main([*command[:2], *command[6:]]) == 0
    assert "one code" not in capsys.readouterr().err
    resumed = make_run(tmp_path / "resumed", model, resumed_by=[{"from": 480, **other_code}])
    assert main(["plot", str(resumed), *command[6:]]) == 0
    assert "one code: commit unknown -> 0123456789" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"-o is learning.svg, expected a folder"):
        main(["plot", *NOWHERE, "-o", "learning.svg"])
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        main(["plot", *NOWHERE, "-o", str(tmp_path / "file")])
    for command_ in ("plot", "evaluate", "enjoy"):
        with pytest.raises(ValueError, match="seed is -1, expected a whole number from 0 to"):
            main([command_, *NOWHERE, "--seed", "-1"])
