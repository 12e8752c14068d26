"""Pictures of SparseWheeled-v0 and SparseAnt-v0."""

import pickle
from typing import Any

import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from gymnasium.utils.env_checker import data_equivalence

from helpers.drawing import skip_where_mujoco_cannot_draw
from helpers.robots import both_envs, make, random_actions, robots
from htr_envs import DynamicsEnv


def picture(env: DynamicsEnv) -> Any:
    skip_where_mujoco_cannot_draw()
    frame = env.render()
    assert frame is not None and frame.shape == (400, 640, 3) and frame.dtype == np.uint8
    return frame.astype(int)


def goal_pixels(frame: Any) -> Any:
    """Rows and columns of orange pixels."""
    red, green, blue = np.moveaxis(frame, -1, 0)
    return np.argwhere((red > 200) & (red - blue > 150) & (green > 100))


@both_envs
def test_the_picture_shows_the_goal_of_the_episode(env_id: str) -> None:
    _, base = make(env_id, render_mode="rgb_array")
    middles, areas = [], []
    for goal in ([-2.0, 0.0], [0.0, 2.0], [2.0, 0.0]):
        base.reset(seed=0, options={"task": goal})
        pixels = goal_pixels(picture(base))
        middles.append(pixels.mean(axis=0))
        areas.append(len(pixels))
    base.close()
    (left_row, left), (upper_row, middle), (_, right) = middles
    assert left < 150 and 300 < middle < 340 and right > 490 and upper_row < left_row - 50
    assert min(areas) > 1500
    _, smaller = make(env_id, render_mode="rgb_array", goal_radius=0.2)
    smaller.reset(seed=0, options={"task": [2.0, 0.0]})
    assert len(goal_pixels(picture(smaller))) < 0.5 * areas[-1]
    smaller.close()


def test_goals_are_in_the_picture_however_far_away_they_are() -> None:
    _, far = make("SparseWheeled-v0", render_mode="rgb_array", goal_distance=5.0)
    for goal in ([-5.0, 0.0], [0.0, 5.0], [5.0, 0.0]):
        far.reset(seed=0, options={"task": goal})
        assert len(goal_pixels(picture(far))) > 300
    far.close()


@both_envs
def test_rendering_changes_nothing(env_id: str) -> None:
    (seen, base), (unseen, _) = make(env_id, render_mode="rgb_array"), make(env_id)
    options = {"task": [0.0, 0.3]}
    assert data_equivalence(seen.reset(seed=0, options=options), unseen.reset(seed=0, options=options), exact=True)
    frames = []
    for action in random_actions(seen, 20):
        frames.append(picture(base))
        assert data_equivalence(seen.step(action), unseen.step(action), exact=True)
    assert (frames[0] != frames[-1]).any()
    # neither does the goal, which is a body of the model that nothing touches
    model = robots(base).model
    assert model.geom("goal").contype[0] == model.geom("goal").conaffinity[0] == 0
    twin = pickle.loads(pickle.dumps(seen))
    assert data_equivalence(seen.step(action), twin.step(action), exact=True)
    seen.close()


@both_envs
def test_pictures_survive_the_end_of_another_env(env_id: str) -> None:
    (_, ours), (_, other) = (make(env_id, render_mode="rgb_array") for _ in range(2))
    for env in (ours, other):
        env.reset(seed=0, options={"task": [0.0, 1.0]})
    before = picture(ours)
    np.testing.assert_array_equal(picture(other), before)
    other.close()
    np.testing.assert_array_equal(picture(ours), before)
    ours.close()


@both_envs
def test_a_window_shows_the_reset_and_each_step(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []

    class Window:
        viewer = None

        def __init__(self, model: Any, data: Any, *args: Any, **kwargs: Any) -> None:
            self.data = data

        def render(self, render_mode: str) -> None:
            shown.append((render_mode, self.data.mocap_pos[0, :2].tolist(), self.data.time))

        def close(self) -> None:
            shown.append("closed")

    monkeypatch.setattr("gymnasium.envs.mujoco.mujoco_rendering.MujocoRenderer", Window)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(DependencyNotInstalled, match="needs a screen, and there is none: take 'rgb_array'"):
        make(env_id, render_mode="human")[0].reset()
    monkeypatch.setenv("DISPLAY", ":0")
    env, base = make(env_id, render_mode="human")
    env.reset(seed=0, options={"task": [0.5, 1.0]})
    env.step(env.action_space.sample())
    env.close()
    step = robots(base).frame_skip * robots(base).model.opt.timestep
    assert shown == [("human", [0.5, 1.0], 0.0), ("human", [0.5, 1.0], pytest.approx(step)), "closed"]
    assert env.metadata["render_fps"] == pytest.approx(1.0 / step)
