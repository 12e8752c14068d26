"""n-step returns count what happened in an episode, under one task."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.experience import add_episode, by_task, filled, make_buffer

LENGTHS = (1, 7, 20)


def expected(episode: np.ndarray, rewards: np.ndarray, step: int, n_steps: int, gamma: float) -> tuple[Any, ...]:
    """Of a step: return, next observation, and the discount of what follows."""
    last = min(step + n_steps, len(episode)) - 1
    total = sum(gamma**k * rewards[step + k] for k in range(last - step + 1))
    return total, episode[last], gamma ** (last - step + 1)


@given(st.integers(0, 2**20), st.integers(1, 25), st.floats(0.5, 1.0))
def test_a_return_has_the_rewards_of_the_hindsight_task(seed: int, n_steps: int, gamma: float) -> None:
    relabeller = {"name": "SingleEpisodeRelabelling", "elsewhere": 0.0}
    buffer = filled(seed, lengths=LENGTHS, seed=seed, relabel_probability=1.0, relabeller=relabeller)
    data = buffer.sample(8, meta_batch_size=8, context_size=20, n_steps=n_steps, gamma=gamma)
    of_context = (data.context.observations, data.context.actions, data.context.rewards)
    of_rl = (data.observations, data.actions, data.rewards, data.next_observations, data.discounts)
    context = (by_task(values, data.context.lengths) for values in of_context)
    rl = (by_task(values, data.lengths) for values in of_rl)
    for obs, action, rewards, *drawn in zip(*context, *rl, strict=True):
        # The context is the whole episode, in some order
        order = in_order(obs, action)
        places = (obs + 0.1 * action).astype(np.float32)[order]
        for o, a, *values in zip(*drawn, strict=True):
            step = next(i for i, j in enumerate(order) if (obs[j] == o).all() and (action[j] == a).all())
            for value, wanted in zip(values, expected(places, rewards[order], step, n_steps, gamma), strict=True):
                np.testing.assert_allclose(value, wanted, rtol=1e-5, atol=1e-6)


def test_no_return_is_longer_than_an_episode() -> None:
    """A number that asks for all of it takes no more memory than that."""
    whole, more = (filled(lengths=LENGTHS, seed=0).sample(8, meta_batch_size=8, n_steps=n, gamma=0.9) for n in (20, 10**9))
    np.testing.assert_array_equal(whole.rewards, more.rewards)


def in_order(obs: np.ndarray, action: np.ndarray) -> list[int]:
    """Of the steps of a walk from the origin."""
    steps = [int(np.flatnonzero((obs == 0).all(axis=1))[0])]
    while len(steps) < len(obs):
        place = (obs[steps[-1]] + 0.1 * action[steps[-1]]).astype(np.float32)
        steps.append(int(np.abs(obs - place).sum(axis=1).argmin()))
    return steps


@pytest.mark.parametrize(
    "settings",
    [
        {"relabel_probability": 0.0},
        {"relabel_probability": 0.0, "rl_reward_type": "dense"},
        {"relabel_probability": 1.0, "relabeller": "EpisodeClustering"},
    ],
)
def test_a_return_has_the_rewards_that_are_stored(settings: dict[str, Any]) -> None:
    """Those of the env, its dense proxy in their place, or those of what was relabelled when it came in."""
    buffer = filled(n_episodes=12, lengths=LENGTHS, **settings)
    family, columns, n_steps, gamma = buffer.task_family, buffer.transitions, 4, 0.9
    store = buffer.relabeller.draw(np.zeros(1, dtype=int)).store if buffer.relabel_probability else buffer.episodes
    store.rows[:, columns.reward] = np.random.default_rng(1).random(len(store.rows))
    data = buffer.sample(20, meta_batch_size=64, n_steps=n_steps, gamma=gamma)
    index = store.index()
    stored, own = store.rows[index.rows], family.train_tasks[np.repeat(data.task_ids, data.lengths)]
    for i, (obs, action, reward) in enumerate(zip(data.observations, data.actions, data.rewards, strict=True)):
        is_drawn = (stored[:, columns.observation] == obs.numpy()) & (stored[:, columns.action] == action.numpy())
        returns = []
        # One episode may be stored under several hindsight tasks
        for row in np.flatnonzero(is_drawn.all(axis=1)):
            episode = np.searchsorted(index.episode_row, row, side="right") - 1
            first, end = index.episode_row[episode : episode + 2]
            steps = stored[first:end]
            rewards = steps[:, columns.reward]
            if buffer.rl_reward_type == "dense":
                rewards = family.compute_reward(columns.trajectory(steps), own[i], reward_type="dense")
            total, place, discount = expected(steps[:, columns.next_observation], rewards, row - first, n_steps, gamma)
            assert data.discounts[i] == pytest.approx(discount) and (data.next_observations[i].numpy() == place).all()
            returns.append(total)
        assert np.isclose(reward.item(), returns, atol=1e-6).any()


def test_an_episode_that_terminates_has_no_value_behind_it() -> None:
    buffer = make_buffer(n_envs=1, relabel_probability=0.0)
    add_episode(buffer, [0], 6, np.random.default_rng(0), terminated=True)
    data = buffer.sample(6, meta_batch_size=1, n_steps=3)
    steps_left = np.round(np.log(data.discounts.numpy()) / np.log(0.98)).astype(int)
    assert sorted(steps_left.tolist()) == [1, 2, 3, 3, 3, 3]
    assert data.dones.sum() == 3, "the last three steps see its end"
