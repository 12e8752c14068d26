"""SER: relabelling when experience is drawn."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.experience import FAMILY, by_task, filled, make_buffer
from htr_envs import Trajectory
from sb3_htr.common.type_aliases import Context
from sb3_htr.htr import HindsightTaskStrategy, SingleEpisodeRelabelling
from sb3_htr.htr.relabel.hindsight_task import solved_at_start


def relabelling(**settings: Any) -> dict[str, Any]:
    """Arguments of a buffer that relabels whatever is drawn."""
    return {"relabel_probability": 1.0, "relabeller": {"name": "SingleEpisodeRelabelling", **settings}}


def trajectory(context: Context) -> Trajectory:
    obs, action = context.observations.numpy(), context.actions.numpy()
    return Trajectory(obs, action, (obs + 0.1 * action).astype(np.float32), np.zeros(len(obs), dtype=np.float32))


@given(st.integers(0, 2**20), st.sampled_from([(20,), (1, 7, 20)]), st.floats(0, 1), st.sampled_from(HindsightTaskStrategy))
def test_every_reward_is_that_of_one_task_per_row(
    seed: int, lengths: tuple[int, ...], k: float, strategy: HindsightTaskStrategy
) -> None:
    """Rows that are not relabelled keep the env's reward; relabelled ones carry the reward of one task that was reached."""
    settings = {**relabelling(hindsight_task_strategy=strategy), "relabel_probability": k}
    data = filled(seed, lengths=lengths, seed=seed, **settings).sample(8, meta_batch_size=16, context_size=20)
    traj = trajectory(data.context)
    columns = [by_task(values, data.context.lengths) for values in (*traj, data.context.rewards)]
    for row, (obs, action, next_obs, free, reward) in enumerate(zip(*columns, strict=True)):
        steps = Trajectory(obs, action, next_obs, free)
        if not data.relabelled[row]:
            own = FAMILY.train_tasks[data.task_ids[row]]
            np.testing.assert_array_equal(reward, FAMILY.compute_reward(steps, own), err_msg="own task")
        else:
            # The whole episode, so the step that reached the hindsight task too
            assert (reward > 0).any()
            # The task that a state solves is the place itself
            candidates = FAMILY.compute_reward(Trajectory(*(x[None] for x in steps)), next_obs)
            assert (candidates == reward).all(axis=1).any(), "no reached state gives these rewards"


def test_context_and_rl_batch_come_from_one_episode() -> None:
    data = filled(n_episodes=12, **relabelling(elsewhere=0.0)).sample(16, meta_batch_size=32, context_size=20)
    context, batch = (
        by_task(np.column_stack([drawn.observations, drawn.actions, drawn.rewards]), drawn.lengths)
        for drawn in (data.context, data)
    )
    for episode, steps in zip(context, batch, strict=True):
        assert len(episode) == 20 and len(steps) == 16
        assert {tuple(step) for step in steps} <= {tuple(step) for step in episode}


@given(st.integers(0, 2**20), st.integers(2, 6), st.sampled_from([(20,), (1, 7, 20)]))
def test_a_context_can_be_a_window_of_neighbouring_episodes_under_one_task(
    seed: int, most: int, lengths: tuple[int, ...]
) -> None:
    buffer = filled(seed, n_episodes=24, lengths=lengths, seed=seed, **relabelling(elsewhere=0.0, context_episodes=most))
    index = buffer.episodes.index()
    draw = buffer.relabeller.draw(np.resize(np.flatnonzero(buffer.n_episodes), 64))
    draw.check(64, FAMILY.train_tasks.shape[1])
    first, end = (np.searchsorted(index.episode_row, side) for side in draw.context.T)
    own = np.searchsorted(index.episode_row, draw.batch[:, 0])
    np.testing.assert_array_equal(index.episode_row[first], draw.context[:, 0], err_msg="whole episodes")
    np.testing.assert_array_equal(index.episode_row[end], draw.context[:, 1], err_msg="whole episodes")
    assert ((end - first >= 1) & (end - first <= most)).all()
    # It contains the episode that the RL batch is from, or ends right before it
    assert ((first <= own) & (own <= end)).all()
    task_of = np.searchsorted(index.task_episode, np.stack([first, end - 1, own]), side="right")
    assert (task_of == task_of[2]).all(), "of one training task"


def test_some_windows_hold_the_first_success_and_some_the_misses_before() -> None:
    data = filled(n_episodes=24, **relabelling(context_episodes=3)).sample(16, meta_batch_size=200, context_size=60)
    episodes = data.context.lengths.numpy() // 20
    assert set(episodes) == {1, 2, 3}
    rewarded = np.array([rewards.any() for rewards in by_task(data.context.rewards, data.context.lengths)])
    assert 0.6 < rewarded.mean() < 1


def test_a_share_of_the_rl_batch_comes_from_anywhere_under_the_same_task() -> None:
    buffer = filled(n_episodes=24, **relabelling(elsewhere=0.25))
    data = buffer.sample(16, meta_batch_size=200, context_size=20)
    contexts, batches = (
        by_task(np.column_stack([drawn.observations, drawn.actions]), drawn.lengths) for drawn in (data.context, data)
    )
    foreign = [
        len({tuple(step) for step in batch} - {tuple(step) for step in context})
        for context, batch in zip(contexts, batches, strict=True)
    ]
    assert 0.15 < np.mean(foreign) / 16 < 0.3, "a few of any are of that episode"
    reached, given, lengths = trajectory(data.context).next_observations, data.context.rewards, data.context.lengths
    for places, rewards, next_obs, rl_rewards in zip(
        *(by_task(x, lengths) for x in (reached, given)),
        *(by_task(x, data.lengths) for x in (data.next_observations, data.rewards)),
        strict=True,
    ):
        (goal,) = np.unique(places[rewards == 1], axis=0)
        distance = np.linalg.norm(next_obs - goal, axis=1)
        np.testing.assert_allclose(rl_rewards, np.where(distance < FAMILY.goal_radius, 1 - distance, 0), atol=1e-5)


def test_a_batch_larger_than_an_episode_is_the_whole_episode_once() -> None:
    data = filled(**relabelling()).sample(256, meta_batch_size=8, context_size=1024)
    assert (data.lengths == 20).all() and (data.context.lengths == 20).all()


def test_ablation_draws_the_rl_batch_from_the_whole_task() -> None:
    buffers = [filled(n_episodes=24, **relabelling(rl_batch_source=source)) for source in ("episode", "task")]
    zero = [(buffer.sample(16, meta_batch_size=200).rewards == 0).float().mean() for buffer in buffers]
    # B.2: the whole buffer under one episode's task is mostly unrewarded
    assert zero[1] > zero[0] + 0.1


def places_of_hindsight_tasks(context: Context) -> np.ndarray:
    """(n, 2): at the goal itself the reward is 1 - 0."""
    return trajectory(context).next_observations[context.rewards.numpy() == 1]


def test_final_strategy_takes_the_last_state() -> None:
    buffer = filled(**relabelling(hindsight_task_strategy="final"))
    index, columns = buffer.episodes.index(), buffer.transitions
    ends = buffer.episodes.rows[index.rows[index.episode_row[1:] - 1], columns.next_observation]
    reached = places_of_hindsight_tasks(buffer.sample(4, meta_batch_size=16, context_size=20).context)
    assert len(reached) >= 16 and {tuple(place) for place in reached} <= {tuple(row) for row in ends}


def hindsight_places(strategy: str) -> np.ndarray:
    """(n, 2) hindsight tasks that are drawn from random walks, most of whose states are near the start."""
    buffer = filled(n_episodes=60, **relabelling(hindsight_task_strategy=strategy))
    draws = [buffer.sample(1, meta_batch_size=64, context_size=20) for _ in range(20)]
    return np.concatenate([places_of_hindsight_tasks(data.context) for data in draws])


def test_even_strategy_draws_tasks_that_are_rarely_reached_more_often() -> None:
    random, even = (np.linalg.norm(hindsight_places(strategy), axis=1) for strategy in ("random", "even"))
    assert len(random) == len(even) == 20 * 64
    far = np.quantile(random, 0.9)
    assert (even > far).mean() > 0.25, "a tenth of all states is that far from the start"


def test_a_place_that_no_other_episode_reached_is_as_rare_as_can_be() -> None:
    buffer = make_buffer(n_envs=1, **relabelling())
    assert isinstance(buffer.relabeller, SingleEpisodeRelabelling)
    places = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    first: Any = Trajectory(places[:, :1], places[:, :1], places[:, :1], np.zeros((2, 1), dtype=np.float32))
    count = buffer.relabeller._count_alike(first, places, np.zeros((2, 3), dtype=np.int8))
    np.testing.assert_array_equal(count, np.ones((2, 3)), err_msg="its own episode is no other")


@given(st.lists(st.lists(st.floats(0.1, 100), min_size=3, max_size=3), min_size=1, max_size=5), st.integers(0, 99))
def test_candidates_are_chosen_inversely_to_how_common_they_are(counts: list[list[float]], seed: int) -> None:
    count = np.repeat(np.array(counts), 4000, axis=0)
    chosen = HindsightTaskStrategy.choose(count, np.random.default_rng(seed)).reshape(len(counts), 4000)
    expected = (1 / np.array(counts)) / (1 / np.array(counts)).sum(axis=1, keepdims=True)
    frequency = np.stack([np.bincount(row, minlength=3) for row in chosen]) / 4000
    np.testing.assert_allclose(frequency, expected, atol=0.05)


@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=1, max_size=9), st.integers(0, 99))
def test_solved_candidates_are_chosen_only_where_all_are(solved: list[list[bool]], seed: int) -> None:
    is_solved = np.repeat(np.array(solved), 100, axis=0)
    chosen = HindsightTaskStrategy.choose(np.ones(is_solved.shape), np.random.default_rng(seed), is_solved)
    taken = np.take_along_axis(is_solved, chosen[:, None], axis=1)[:, 0]
    np.testing.assert_array_equal(taken, is_solved.all(axis=1))
    assert set(chosen[is_solved.all(axis=1)]) in (set(), {0, 1, 2}), "any of them"


def starts_and_tasks(n_moving: int, **settings: Any) -> tuple[np.ndarray, np.ndarray]:
    """
    Of 24 episodes of one task, so many leave the place where they began, each another place, in their last steps.

    :return: where episodes began (n, 2), hindsight tasks (n, 2)
    """
    buffer = make_buffer(n_envs=1, buffer_size=40_000, **relabelling(**settings))
    rng = np.random.default_rng(0)
    for episode in range(24):
        obs = rng.uniform(-5, 5, (1, 2)).astype(np.float32)
        for step in range(20):
            action = np.full((1, 2), episode < n_moving and step >= 14, dtype=np.float32)
            next_obs, done = (obs + 0.1 * action).astype(np.float32), np.array([step == 19])
            buffer.add(obs, next_obs, action, np.zeros(1), done, [{"task_id": 0, "task_free_reward": 0.0}])
            obs = next_obs
    draw = buffer.relabeller.draw(np.zeros(500, dtype=np.int64))
    return draw.store.take(draw.context[:, 0])[:, buffer.transitions.observation], draw.tasks


def test_tasks_that_the_start_does_not_solve_are_preferred() -> None:
    solved = {}
    for n_moving in (0, 1, 12):
        for prefer in (False, True):
            starts, tasks = starts_and_tasks(n_moving, prefer_unsolved=prefer)
            solved[n_moving, prefer] = (np.linalg.norm(starts - tasks, axis=1) < FAMILY.goal_radius).mean()
    assert solved[0, False] == solved[0, True] == 1, "where nothing moved, any"
    # A candidate is unsolved in 5/20 of the steps of the episodes that move; eight are drawn eight times
    assert solved[12, False] > 0.6 and solved[12, True] < 0.01
    assert solved[1, False] > 0.9 and solved[1, True] == pytest.approx((1 - 1 / 24 * 5 / 20) ** 64, abs=0.07)


@pytest.mark.parametrize("n_near", [0, 2])
def test_tasks_like_those_of_training_are_preferred_for_a_share(n_near: int) -> None:
    """Of 40 episodes that walk away from the start, so many to where training tasks are, the others to the other side."""
    share = {}
    for like_training in (0.0, 0.5, 1.0):
        buffer = make_buffer(n_envs=1, buffer_size=80_000, **relabelling(like_training=like_training))
        for episode in range(40):
            obs, up = np.zeros((1, 2), dtype=np.float32), 1.0 if episode < n_near else -1.0
            for step in range(20):
                action = np.array([[0.0, up]], dtype=np.float32)
                next_obs, done = (obs + 0.07 * action).astype(np.float32), np.array([step == 19])
                buffer.add(obs, next_obs, action, np.zeros(1), done, [{"task_id": 0, "task_free_reward": 0.0}])
                obs = next_obs
        tasks = buffer.relabeller.draw(np.zeros(500, dtype=np.int64)).tasks
        distance = np.linalg.norm(tasks[:, None] - FAMILY.train_tasks, axis=-1).min(axis=1)
        share[like_training] = (distance < FAMILY.goal_radius).mean()
    if n_near == 0:
        assert set(share.values()) == {0}
    else:
        # Seldom by chance; eight candidates are drawn eight times
        assert share[0.0] < 0.1 and share[1.0] > 0.5
        assert share[0.5] == pytest.approx((share[0.0] + share[1.0]) / 2, abs=0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"like_training": 2}, "like_training is 2, expected a number from 0 to 1"),
        ({"hindsight_task_strategy": "best"}, r"hindsight_task_strategy is 'best', expected one of \['even', 'final', 'ran"),
        ({"rl_batch_source": "x"}, "rl_batch_source is 'x'"),
    ],
)
def test_bad_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(**relabelling(**settings))


def test_what_the_first_step_solves_was_not_solved_at_the_start() -> None:
    zero, action, next_obs = np.zeros((1, 2), np.float32), np.array([[1, 0]], np.float32), np.array([[0.1, 0]], np.float32)
    step: Any = Trajectory(zero, action, next_obs, zero[:, 0])
    assert FAMILY.is_success(step, np.array([0.25, 0.0]))[0]
    assert [bool(solved_at_start(FAMILY, step, np.array([x, 0.0]))) for x in (0.15, 0.25)] == [True, False]


def test_the_rl_batch_of_a_task_is_of_the_task_that_the_context_is_of() -> None:
    """Which is another one than was drawn, where nothing but that would do."""
    relabeller = {"name": "SingleEpisodeRelabelling", "rl_batch_source": "task", "like_training": 0.0}
    buffer = make_buffer(n_envs=1, buffer_size=16_000, relabel_probability=1.0, relabeller=relabeller)
    for task, speed in ((0, 0.0), (1, 1.0)):
        obs = np.zeros((1, 2), dtype=np.float32)
        for step in range(20):
            action = np.full((1, 2), speed, dtype=np.float32)
            next_obs = obs + np.float32(0.1) * action
            buffer.add(obs, next_obs, action, np.zeros(1), np.array([step == 19]), [{"task_id": task}])
            obs = next_obs
    draw = buffer.relabeller.draw(np.zeros(100, dtype=int))
    assert (draw.context == [20, 40]).all(axis=1).mean() > 0.9, "the first does not move"
    np.testing.assert_array_equal(draw.batch, draw.context, err_msg="each task has one episode")
