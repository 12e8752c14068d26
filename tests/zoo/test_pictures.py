"""What pictures show, and agents whose env cannot be drawn."""

import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from broken_envs import LineEnv
from conftest import ENV_ID, TINY
from gymnasium.envs.registration import EnvSpec
from matplotlib.figure import Figure

from sb3_htr import PEARL
from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.zoo import curves, intervals, plots
from sb3_htr.zoo.cli import main


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that are saved."""
    figures: list[Figure] = []
    for module in (plots, curves):
        monkeypatch.setattr(module, "save", lambda figure, path: figures.append(figure))
    return figures


class Boastful(LineEnv):
    """Says that it can be drawn, but cannot."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012


@pytest.fixture
def line_agent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An agent of an env as in docs/own_task_family.md: its constructor knows no render_mode."""
    spec = EnvSpec("SparseLine-v0", "broken_envs:LineEnv", max_episode_steps=10)
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
    with pytest.raises(ValueError, match="SparseLine-v0 cannot be filmed: 'rgb_array' is not in"):
        main(["record", *arguments, "-o", str(tmp_path / "film.mp4")])
    monkeypatch.setattr(gym.registry["SparseLine-v0"], "entry_point", Boastful)
    with pytest.raises(ValueError, match="SparseLine-v0 cannot draw rgb_array: let the __init__"):
        main(["record", *arguments, "-o", str(tmp_path / "film.mp4")])


def test_paths_begin_at_the_start_and_name_their_task(drawn: list[Figure]) -> None:
    tasks = np.array([[0.0, 1.0], [1.0, 0.0]], dtype=np.float32)
    record = AdaptationRecord(np.ones((2, 3)), np.ones((2, 3), dtype=bool), np.full((2, 3, 4, 2), 0.5, dtype=np.float32))
    start = plots.start_position(gym.make(ENV_ID))
    assert start is not None
    plots.plot_adaptation_paths(record, tasks, 0.2, start, Path("x.png"), "about")
    axes = drawn[0].axes[0]
    assert axes.get_title().startswith("task 2: solved in episode 1")
    ways = [np.asarray(line.get_xydata()) for line in axes.lines]
    assert all(way.shape == (5, 2) and (way[0] == 0).all() for way in ways)


def test_curves_say_what_they_show(drawn: list[Figure], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intervals, "REPS", 200)
    for n_seeds, n_points, said in (
        (1, 16, "env"),
        (2, 15, "env; mean and range of 2 seeds"),
        (3, 2, "env; IQM over seeds, 95 % interval"),
    ):
        zeros = np.zeros((n_seeds, n_points))
        plots_of = {"a": curves.Curve(np.arange(n_points), zeros, zeros)}
        curves.plot_curves(plots_of, Path("x.png"), "env", "x", ("return", "share of tasks solved (%)"))
        left, right = drawn[-1].axes
        assert drawn[-1].get_suptitle() == said
        assert left.lines[0].get_marker() == ("" if n_points > 15 else "o")
        assert left.get_ylim()[1] >= 1 and left.get_ylim()[0] < 0, "zeros are no noise"
        assert right.get_ylim() == (-4, 104)
