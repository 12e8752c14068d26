"""EC: relabelling at data generation, in hindsight buffers of a discretised task space."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import ENV_ID, add_episode
from hypothesis import given
from hypothesis import strategies as st

from htr_envs import PointRobotFamily
from sb3_htr import PEARL
from sb3_htr.htr import EpisodeClustering
from sb3_htr.htr.episode_clustering import GridDiscretiser

FAMILY = PointRobotFamily()


def filled(n_episodes: int = 30, **kwargs: Any) -> EpisodeClustering:
    env = gym.make(ENV_ID)
    settings = {"n_envs": 2, "device": "cpu", "task_family": FAMILY, "max_episode_steps": 20, "seed": 0, **kwargs}
    buffer = EpisodeClustering(16_000, env.observation_space, env.action_space, **settings)
    rng = np.random.default_rng(0)
    for i in range(n_episodes):
        add_episode(buffer, [i % 5, 5 + i % 7], 20, rng)
    return buffer


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=1), st.floats(0.01, 2))
def test_grid_maps_tasks_to_the_middle_of_their_cell(tasks: list[tuple[float, float]], cell_size: float) -> None:
    points = np.array(tasks, dtype=np.float32)
    middles = GridDiscretiser(cell_size)(points)
    assert middles.dtype == np.float32 and (np.abs(middles - points) <= cell_size / 2 + 1e-3).all()
    np.testing.assert_allclose(GridDiscretiser(cell_size)(middles), middles, atol=1e-4)


def test_real_buffers_are_as_they_would_be_without() -> None:
    buffer = filled()
    assert buffer.size() == 60 * 20 and buffer.n_episodes.sum() == 60
    assert len(buffer.episodes.take_new()[0]) == 60, "copies are not new experience"
    plain = buffer.sample(8, meta_batch_size=200, context_size=20)
    task = np.repeat(np.arange(200), plain.lengths.numpy())
    real = ~plain.relabelled[task]
    distance = np.linalg.norm(plain.next_observations.numpy() - FAMILY.train_tasks[plain.task_ids[task]], axis=-1)
    expected = np.where(distance < 0.2, 1 - distance, 0)
    np.testing.assert_allclose(plain.rewards.numpy()[real], expected[real], atol=1e-5)


def test_a_hindsight_buffer_holds_the_rewards_of_its_task() -> None:
    buffer = filled(exploratory_fraction=0.0)
    index = buffer.episodes.index()
    assert buffer.n_hindsight_buffers > 10
    for i, task in enumerate(buffer._hindsight_tasks):
        number = buffer.n_tasks + i
        rows = buffer.episodes.rows[index.rows[index.task_row[number] : index.task_row[number + 1]]]
        np.testing.assert_array_equal(rows[:, 4], buffer.task_family.compute_reward(buffer.trajectory(rows), task))
        # Without exploratory episodes, each one has solved the task
        assert (rows[:, 4].reshape(-1, 20) > 0).any(axis=1).all()
    real, hindsight = buffer.rewarded_fraction()
    assert hindsight == 1.0 > real


def test_even_strategy_prefers_hindsight_buffers_with_few_episodes() -> None:
    even, random = (filled(200, hindsight_task_strategy=name, exploratory_fraction=0.0) for name in ("even", "random"))
    assert even.n_hindsight_buffers > 1.1 * random.n_hindsight_buffers


@pytest.mark.parametrize("k", [0.0, 0.4, 1.0])
def test_k_is_the_probability_of_a_hindsight_buffer(k: float) -> None:
    buffer = filled(relabel_probability=k)
    relabelled = np.concatenate([buffer.sample(2, meta_batch_size=200).relabelled for _ in range(20)])
    assert abs(relabelled.mean() - k) < 0.03


def test_exploratory_episodes_keep_their_share() -> None:
    shares = {f: filled(200, exploratory_fraction=f).rewarded_fraction()[1] for f in (0.0, 0.3, 0.7)}
    assert shares[0.0] == 1.0 > shares[0.3] > shares[0.7]
    # Exploratory episodes may be rewarded by chance, so that the share is a bound
    assert shares[0.3] >= 0.7 - 0.05 and shares[0.7] >= 0.3 - 0.05


def test_memory_grows_with_the_number_of_hindsight_buffers() -> None:
    coarse, fine = filled(cell_size=0.5, exploratory_fraction=0.0), filled(cell_size=0.05, exploratory_fraction=0.0)
    assert fine.n_hindsight_buffers > coarse.n_hindsight_buffers
    assert fine.hindsight_nbytes == 60 * 20 * 9 * 4


def test_a_task_space_can_bring_its_own_discretiser() -> None:
    by_quadrant = filled(discretiser=lambda tasks: np.sign(tasks).astype(np.float32) * np.float32(0.1))
    assert by_quadrant.n_hindsight_buffers <= 9


def test_pearl_trains_with_it(tiny_pearl: Callable[..., PEARL]) -> None:
    model = tiny_pearl(replay_buffer_class=EpisodeClustering, replay_buffer_kwargs={"cell_size": 0.1}).learn(480)
    assert isinstance(model.replay_buffer, EpisodeClustering) and model.replay_buffer.n_hindsight_buffers > 0
    model.replay_buffer.reset()
    assert model.replay_buffer.n_hindsight_buffers == 0 == model.replay_buffer.size()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"cell_size": 0.0}, "cell_size is 0.0, expected positive"),
        ({"exploratory_fraction": 1.0}, "exploratory_fraction is 1.0, expected a number from 0 to below 1"),
    ],
)
def test_bad_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        filled(0, **kwargs)
