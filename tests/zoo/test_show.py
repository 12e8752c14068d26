"""Agents watched and filmed."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch as th
from PIL import Image, ImageSequence

from helpers import ENV_ID, MakePEARL
from helpers.disks import disk
from helpers.envs import DropsOptions
from helpers.runs import NOWHERE, SHIPPED, make_run
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.run.agents import TrainedAgent, agent_at
from sb3_htr.zoo.show.captions import Captioner
from sb3_htr.zoo.show.film import Film
from sb3_htr.zoo.show.play import Camera, Moment, Player
from sb3_htr.zoo.show.window import Window


def test_enjoy_shows_an_agent_that_adapts(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--env-kwargs", "n_test_tasks:3", "--n-tasks", "5", "--n-episodes", "1"]
    assert main(["enjoy", *NOWHERE, "--no-render", *few]) == 0
    assert "There are only 3 test tasks, fewer than --n-tasks 5" in capsys.readouterr().out
    assert main(["enjoy", *NOWHERE, "--no-render", "--n-tasks", "2", "--n-episodes", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    episodes = [line for line in lines if line.startswith("  episode")]
    assert len(episodes) == 12 and "explores" in episodes[6] and "adapted" in episodes[11] and "solved" in episodes[11]
    deviations = [float(line.split()[-1]) for line in episodes]
    assert deviations[11] < deviations[6], "z is known better once the task is"
    assert lines[-1].startswith("Solved 2 of 2 tasks")


@pytest.mark.parametrize("command", ["enjoy", "record"])
def test_every_env_that_is_made_to_be_drawn_is_closed(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_pearl: MakePEARL
) -> None:
    """Those that are asked for their frames per second alone, too."""
    made: list[gym.Env] = []
    closed: list[gym.Env] = []
    make = gym.make

    class Watched(gym.Wrapper):
        def close(self) -> None:
            closed.append(self)
            super().close()

    def make_watched(*args: Any, **kwargs: Any) -> gym.Env:
        made.append(Watched(make(*args, **kwargs)))
        return made[-1]

    make_run(tmp_path / "runs", tiny_pearl())
    agent = agent_at(tmp_path / "runs")
    model = agent.load()
    monkeypatch.setattr(TrainedAgent, "load", lambda *_: model)
    monkeypatch.setattr(gym, "make", make_watched)
    monkeypatch.setattr("sb3_htr.zoo.show.window.Window", lambda title, fps: (_ for _ in ()).throw(OSError("no screen")))
    few = ["--n-tasks", "1", "--n-episodes", "1", "--verbose", "0"]
    output = ["-o", str(tmp_path / "film.mp4")] if command == "record" else []
    assert main([command, str(tmp_path / "runs"), *few, *output]) == 0
    assert made and {*map(id, made)} == {*map(id, closed)}


def test_enjoy_needs_no_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["enjoy", *NOWHERE, "--task", "3", "--n-episodes", "1"]) == 0
    output = capsys.readouterr().out
    assert "Numbers only: no screen" in output and "test task 3 of 100" in output


def test_a_window_shows_its_frames_until_it_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    window = Window("A title", 1000)
    frame = np.random.default_rng(0).integers(0, 255, (30, 50, 3)).astype(np.uint8)
    assert window.show(frame)
    shown = pygame.surfarray.array3d(pygame.display.get_surface())
    np.testing.assert_array_equal(shown.swapaxes(0, 1), frame)
    assert pygame.display.get_caption()[0] == "A title"
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert not window.show(frame)
    window.close()
    assert not pygame.display.get_init()


@pytest.mark.filterwarnings("ignore:.*HumanRendering wrapper")
def test_gymnasium_opens_a_window_for_an_env_that_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    human, drawn = (gym.make(ENV_ID, render_mode=mode) for mode in ("human", "rgb_array"))
    for env in (human, drawn):
        env.reset(options={"task": [0.0, 1.0]})
        env.step(np.ones(2, dtype=np.float32))
    shown = pygame.surfarray.array3d(pygame.display.get_surface())
    np.testing.assert_array_equal(shown.swapaxes(0, 1), drawn.render())
    human.close()


def test_enjoy_ends_with_its_window_or_its_steps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    shown: list[np.ndarray] = []

    class Shown:
        def __init__(self, title: str, fps: float) -> None:
            assert ENV_ID in title and fps == 10

        def show(self, frame: np.ndarray) -> bool:
            shown.append(frame)
            return len(shown) < 30

        def close(self) -> None:
            shown.append(np.zeros(0))

    monkeypatch.setattr("sb3_htr.zoo.show.window.Window", Shown)
    assert main(["enjoy", *NOWHERE]) == 0
    assert len(shown) == 31 and shown[0].shape == shown[29].shape and (shown[0] != shown[29]).any()
    assert main(["enjoy", *NOWHERE, "-n", "45", "--no-render"]) == 0
    assert capsys.readouterr().out.splitlines()[-2].startswith("  episode   2")


@pytest.mark.parametrize("explorer", ["belief", "prior", "aggregate"])
def test_what_is_played_is_what_is_evaluated(explorer: str) -> None:
    model, env = PEARL.load(SHIPPED), gym.make(ENV_ID)
    tasks = env.unwrapped.task_family.test_tasks  # type: ignore[attr-defined]
    returns, successes = evaluate_adaptation(model, env, tasks[4:5], n_episodes=7, explorer=explorer, seed=3)
    moments = list(Player(model, env, explorer, seed=3).play(tasks, 5, 7))
    np.testing.assert_allclose(moments[-1].returns, returns[0], atol=1e-5)
    assert moments[-1].successes == tuple(successes[0]) and len(moments) == 7 * 21
    before = [moment.deviation for moment in moments if moment.exploring and not moment.ended]
    assert moments[-1].deviation <= before[0] > 0.1 and (explorer != "prior" or set(before) == {1.0})


def test_sampled_actions_are_those_of_an_evaluation_and_of_nobody_else() -> None:
    """They are not drawn with the numbers that z is drawn with."""
    model, env = PEARL.load(SHIPPED), gym.make(ENV_ID)
    tasks = env.unwrapped.task_family.test_tasks  # type: ignore[attr-defined]
    returns, _ = evaluate_adaptation(model, env, tasks[:2], n_episodes=3, deterministic=False, seed=3)
    before = th.get_rng_state()
    player = Player(model, env, deterministic=False, seed=3)
    played = [list(player.play(tasks, number, 3))[-1].returns for number in (1, 2)]
    np.testing.assert_allclose(played, returns, atol=1e-5)
    assert th.equal(th.get_rng_state(), before)


def test_another_task_than_was_asked_for_is_not_played() -> None:
    env = gym.make(ENV_ID)
    tasks = env.unwrapped.task_family.test_tasks  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"Env 0 was asked for the task .*, and is on"):
        next(Player(PEARL.load(SHIPPED), DropsOptions(env)).play(tasks, 1, 1))


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_record_makes_a_film(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / f"film{suffix}"
    arguments = ["--n-tasks", "1", "--n-episodes", "2", "--every", "5", "-o", str(film), "--verbose", "0"]
    assert main(["record", *NOWHERE, *arguments]) == 0
    frames = iio.imread(film)
    assert "10 frames" in capsys.readouterr().out and len(frames) >= 9
    height, width = frames.shape[1:3]
    assert width == 400 and 400 < height < 520 and height % 2 == 0
    assert (frames[0, :400] != frames[-1, :400]).any(), "the robot moves"
    assert (frames[0, 400:] != frames[-1, 400:]).any(), "and so does the caption"


def test_films_that_cannot_be_made(tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"the suffix '.avi', expected one of .mp4, .gif"):
        main(["record", *NOWHERE, "-o", "film.avi"])
    with pytest.raises(ValueError, match=r"no more than 50 of a gif: add --every 4, or write an .mp4"):
        main(["record", *NOWHERE, "-o", "film.gif", "--speed", "20"])
    with pytest.raises(ValueError, match="--every is 0"):
        main(["record", *NOWHERE, "--every", "0"])
    monkeypatch.setattr("sb3_htr.zoo.show.film.MAX_GIF_FRAMES", 5)
    with pytest.raises(ValueError, match="A gif holds at most 5 frames"):
        main(["record", *NOWHERE, "-o", str(tmp_path / "film.gif"), "--verbose", "0"])
    assert not list(tmp_path.iterdir()), "no half of a film is left"


class Draws(gym.Wrapper):
    """Something else than its env."""

    picture: Any = None

    def render(self) -> Any:
        return self.picture


@pytest.mark.parametrize(
    ("picture", "what"),
    [
        (None, "None"),
        ([[0, 0, 0]], "a list"),
        (np.zeros((8, 8, 3)), r"an array of shape \(8, 8, 3\) of float64"),
        (np.zeros((8, 8), dtype=np.uint8), r"an array of shape \(8, 8\) of uint8"),
        (np.zeros((8, 8, 4), dtype=np.uint8), r"an array of shape \(8, 8, 4\) of uint8"),
    ],
)
def test_an_env_that_draws_no_picture_is_told_what_one_is(picture: Any, what: str) -> None:
    env = Draws(gym.make(ENV_ID))
    env.picture = picture
    with pytest.raises(ValueError, match=rf"render\(\) gave {what}, expected a picture \(height, width, 3\) of uint8"):
        Camera(env, 1).reset()


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_pictures_of_a_film_are_of_one_size(suffix: str, tmp_path: Path) -> None:
    """As many bytes would make a broken film."""
    film = Film(tmp_path / f"film{suffix}", 10)
    film.add(np.zeros((40, 60, 3), dtype=np.uint8), 0.0)
    with pytest.raises(ValueError, match="A picture of the film has 40 x 60 pixels, expected 60 x 40 as the first one"):
        film.add(np.zeros((60, 40, 3), dtype=np.uint8), 0.0)
    film.close()


@pytest.mark.parametrize("fps", [15, 22.5, 30, 35, 45])
def test_a_gif_is_as_long_as_was_asked_for(fps: float, tmp_path: Path) -> None:
    """Though it counts hundredths of a second."""
    film = Film(tmp_path / "film.gif", fps)
    for i in range(20):
        film.add(np.full((8, 8, 3), 12 * i, dtype=np.uint8), 0.0)
    film.close()
    with Image.open(film.path) as gif:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(gif)]
    assert sum(durations) == pytest.approx(1000 * sum(film.seconds), abs=10) and min(durations) >= 20


def test_a_film_on_a_full_disk_is_no_film(tmp_path: Path, tiny_pearl: MakePEARL, capfd: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path / "runs", tiny_pearl())
    few = ["record", str(tmp_path / "runs"), "--n-tasks", "1", "--n-episodes", "2", "--every", "5", "--verbose", "0"]
    with disk(tmp_path, 8) as small:
        with pytest.raises(OSError, match=r"film.mp4 could not be written to its end: is the disk full\?"):
            main([*few, "-o", str(small / "film.mp4")])
        assert not list(small.iterdir())
    capfd.readouterr()
    with disk(tmp_path, 8, "ro") as read_only:
        with pytest.raises(PermissionError, match=f"The folder cannot be written to: '{read_only}'"):
            main([*few, "-o", str(read_only / "film.mp4")])
    assert "ffmpeg" not in capfd.readouterr().err


def test_captions_know_what_was_worst(tmp_path: Path) -> None:
    captioner = Captioner()
    frame = np.zeros((101, 201, 3), dtype=np.uint8)
    first = captioner(frame, Moment(1, 3, 0, (0.0,), (False,), True, 0.5, False, frame))
    last = captioner(frame, Moment(1, 3, 9, (0.0, -2.0, 5.0), (False, False, True), False, 0.05, True, frame))
    assert first.shape == last.shape and first.shape[0] % 2 == first.shape[1] % 2 == 0
    assert (first[:202, :402] == 0).all(), "the frame itself is not touched, but enlarged to have room for words"
    dark = [(picture[202:] < 60).all(axis=-1).sum() for picture in (first, last)]
    assert dark[1] < dark[0], "the bar of the uncertainty is shorter"


@pytest.mark.parametrize(("side", "n_episodes"), [(16, 20), (400, 300)])
def test_captions_of_small_frames_and_many_episodes(side: int, n_episodes: int) -> None:
    frame = np.zeros((side, side, 3), dtype=np.uint8)
    done = (1.0,) * n_episodes
    picture = Captioner()(frame, Moment(1, n_episodes, 9, done, (True,) * n_episodes, False, 0.1, True, frame))
    assert picture.shape[1] >= 300
