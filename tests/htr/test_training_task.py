"""HFR and HIPI: relabelling under training tasks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from helpers import ENV_ID, ROLLOUT, MakePEARL, parameters
from helpers.experience import FAMILY, add_episode, by_task, filled, make_buffer
from htr_envs import PointRobotFamily
from sb3_htr import MultiTaskReplayBuffer, evaluate_adaptation
from sb3_htr.common.type_aliases import Context
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import HindsightForesight, HindsightInference
from sb3_htr.htr.relabel import TrainingTaskRelabelling

KINDS: list[dict[str, Any]] = [
    {"name": "HindsightForesight"},
    {"name": "HindsightInference"},
]
kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind["name"])


class Oracle:
    """An adapted policy whose z is what the context was rewarded with, and whose value is z."""

    device = th.device("cpu")

    def infer(self, context: Context) -> tuple[th.Tensor, th.Tensor]:
        task = th.repeat_interleave(th.arange(len(context.lengths)), context.lengths)
        total = th.zeros(len(context.lengths)).index_add(0, task, context.rewards)
        return total[:, None], th.ones(len(context.lengths), 1)

    def values(self, obs: np.ndarray, z: th.Tensor, actions: np.ndarray | None = None) -> th.Tensor:
        assert z.shape[0] == len(obs) and (actions is None or len(actions) == len(obs))
        return z[..., 0]


def relabelling(kind: dict[str, Any], n_episodes: int = 6, **kwargs: Any) -> MultiTaskReplayBuffer:
    """A buffer of random walks that relabels whatever is drawn."""
    buffer = filled(n_episodes=n_episodes, relabel_probability=1.0, relabeller=kind, **kwargs)
    buffer.relabeller.policy = Oracle()
    return buffer


def walk(buffer: MultiTaskReplayBuffer, goal: np.ndarray, task: int) -> None:
    """Straight to a goal, and stay."""
    place = np.zeros((1, 2), dtype=np.float32)
    for step in range(20):
        action = np.clip((goal - place) / 0.1, -1, 1).astype(np.float32)
        next_place = (place + np.float32(0.1) * action).astype(np.float32)
        info = {"task_id": task, "task_free_reward": 0.0, "TimeLimit.truncated": step == 19}
        buffer.add(place, next_place, action, np.zeros(1), np.array([step == 19]), [info])
        place = next_place


# --- where experience goes


@kinds
@given(seed=st.integers(0, 2**20), lengths=st.sampled_from([(20,), (1, 7, 20)]))
def test_every_row_has_the_rewards_of_its_training_task(kind: dict[str, Any], seed: int, lengths: tuple[int, ...]) -> None:
    buffer = relabelling(kind, walk_seed=seed, lengths=lengths, seed=seed)
    data = buffer.sample(16, meta_batch_size=32, context_size=20)
    assert data.relabelled.all()
    relabeller = buffer.relabeller
    assert isinstance(relabeller, TrainingTaskRelabelling)
    index, columns = relabeller.episodes.index(), buffer.transitions
    assert len(index.rows) == buffer.size(), "everything is relabelled, once"
    task = np.repeat(np.arange(buffer.n_tasks), np.diff(index.task_row))
    rows = relabeller.episodes.rows[index.rows]
    traj: Any = columns.trajectory(rows[:, None])
    expected = FAMILY.compute_reward(traj, FAMILY.train_tasks[task])[:, 0]
    np.testing.assert_array_equal(rows[:, columns.reward], expected)
    stored = {row.tobytes() for row in rows[:, [*range(4), columns.reward]]}
    drawn = [np.column_stack([d.observations, d.actions, d.rewards]) for d in (data, data.context)]
    assert {row.tobytes() for row in np.concatenate(drawn).astype(np.float32)} <= stored


@kinds
def test_an_episode_goes_to_a_task_that_it_solves(kind: dict[str, Any]) -> None:
    """Whatever its own is. Of n episodes, one alone is n times as probable under a task that no other solves."""
    buffer = make_buffer(n_envs=1, relabel_probability=1.0, relabeller=kind, buffer_size=200_000)
    buffer.relabeller.policy = Oracle()
    goal, rng = FAMILY.train_tasks[17], np.random.default_rng(0)
    walk(buffer, goal, task=3)
    for _ in range(200):
        add_episode(buffer, [3], 20, rng)
    buffer.sample(16, meta_batch_size=4)
    relabeller = buffer.relabeller
    assert isinstance(relabeller, TrainingTaskRelabelling)
    index, columns = relabeller.episodes.index(), buffer.transitions
    rows = relabeller.episodes.rows[index.rows]
    places, rewards = (
        np.split(rows[:, column], index.episode_row[1:-1]) for column in (columns.next_observation, columns.reward)
    )
    (straight,) = [i for i, episode in enumerate(places) if np.linalg.norm(episode[-1] - goal) < 1e-6]
    assert (rewards[straight] > 0).any()


def chances(logits: np.ndarray, relabeller: TrainingTaskRelabelling, n: int = 4000) -> np.ndarray:
    """How often each task was chosen for the first unit."""
    counts = np.zeros(logits.shape[1])
    for _ in range(n):
        counts[relabeller._choose(logits)[0]] += 1
    return counts / n


def test_the_partition_function_keeps_an_easy_task_from_getting_everything() -> None:
    buffer = relabelling(KINDS[1])
    relabeller = buffer.relabeller
    assert isinstance(relabeller, TrainingTaskRelabelling)
    # The second task pays 5 for whatever is done, the first pays 2 for the first unit alone
    logits = np.array([[2.0, 5.0], [0.0, 5.0], [0.0, 5.0], [0.0, 5.0]])
    z = np.exp(logits).mean(axis=0)
    expected = np.exp(logits[0]) / z
    np.testing.assert_allclose(chances(logits, relabeller), expected / expected.sum(), atol=0.03)
    assert expected[0] > expected[1]


def test_the_temperature_says_how_much_utilities_count() -> None:
    entropies = []
    for temperature in (1e-3, 1.0, float("inf")):
        buffer = relabelling({**KINDS[1], "temperature": temperature}, n_episodes=40)
        buffer.sample(4, meta_batch_size=4)
        entropies.append(buffer.stats()["replay/relabelling_entropy"])
    assert entropies[0] < entropies[1] < entropies[2] == pytest.approx(np.log(80))


def test_foresight_is_the_value_of_the_policy_that_has_adapted() -> None:
    """z from the relabelled episode, values at the first states of episodes."""
    seen: dict[str, Any] = {}

    class Watched(Oracle):
        def infer(self, context: Context) -> tuple[th.Tensor, th.Tensor]:
            seen.setdefault("contexts", []).append(context)
            return super().infer(context)

        def values(self, obs: np.ndarray, z: th.Tensor, actions: np.ndarray | None = None) -> th.Tensor:
            seen.setdefault("starts", []).append(obs)
            assert actions is None
            return super().values(obs, z)

    buffer = make_buffer(n_envs=1, relabel_probability=1.0, relabeller=HindsightForesight(context_size=10))
    rng = np.random.default_rng(0)
    for length in (20, 7, 20):
        add_episode(buffer, [0], length, rng)
    relabeller = buffer.relabeller
    assert isinstance(relabeller, HindsightForesight)
    relabeller.policy = Watched()
    index = buffer.episodes.index()
    rows, lengths = buffer.episodes.rows[index.rows], np.diff(index.episode_row)
    utilities = relabeller.utilities(rows, lengths)
    assert utilities.shape == (3, 80)
    (context,) = seen["contexts"]
    assert context.lengths.tolist() == [length for length in (10, 7, 10) for _ in range(80)]
    np.testing.assert_allclose(context.next_observations, context.observations + 0.1 * context.actions, atol=1e-6)
    places = by_task(rows[:, buffer.transitions.next_observation], lengths)
    for i, (episode, every) in enumerate(zip(places, (2, 1, 2), strict=True)):
        distance = np.linalg.norm(episode[every - 1 :: every, None] - FAMILY.train_tasks, axis=-1)
        np.testing.assert_allclose(utilities[i], np.where(distance < 0.2, 1 - distance, 0).sum(axis=0), atol=1e-5)
    assert (np.concatenate(seen["starts"]) == 0).all(), "where the point robot starts"


def test_foresight_sees_a_goal_that_was_passed_between_two_steps_of_the_context() -> None:
    buffer = make_buffer(n_envs=1, relabel_probability=1.0, relabeller=HindsightForesight(context_size=2))
    add_episode(buffer, [0], 20, np.random.default_rng(0))
    relabeller, columns = buffer.relabeller, buffer.transitions
    assert isinstance(relabeller, HindsightForesight)
    relabeller.policy = Oracle()
    rows = buffer.episodes.take(np.arange(20))
    rows[:, columns.next_observation] = 9.0
    rows[4, columns.next_observation] = FAMILY.train_tasks[3]
    (utilities,) = relabeller.utilities(rows, np.array([20]))
    distance = np.linalg.norm(FAMILY.train_tasks - FAMILY.train_tasks[3], axis=-1)
    np.testing.assert_allclose(utilities, np.where(distance < 0.2, 1 - distance, 0), atol=1e-5)


def test_inference_is_the_return_under_the_task() -> None:
    buffer = relabelling(KINDS[1], n_episodes=12)
    relabeller, index = buffer.relabeller, buffer.episodes.index()
    assert isinstance(relabeller, HindsightInference)
    rows = buffer.episodes.rows[index.rows]
    utilities = relabeller.utilities(rows, np.diff(index.episode_row))
    places = np.split(rows[:, buffer.transitions.next_observation], index.episode_row[1:-1])
    distance = np.linalg.norm(np.stack(places)[:, None] - FAMILY.train_tasks[:, None], axis=-1)
    np.testing.assert_allclose(utilities, np.where(distance < 0.2, 1 - distance, 0).sum(axis=-1), atol=1e-5)


def test_rows_are_drawn_from_all_that_was_relabelled_and_from_nothing_else() -> None:
    """Also to tasks that were not played yet."""
    buffer = relabelling(KINDS[1], n_episodes=5)
    buffer.sample(4, meta_batch_size=4)
    relabeller = buffer.relabeller
    assert isinstance(relabeller, TrainingTaskRelabelling)
    known = relabeller.episodes.index().tasks
    assert set(known) - set(buffer.episodes.index().tasks), "some of them were not played"
    tasks = relabeller.draw(buffer.episodes.index().tasks.repeat(200)).tasks
    _, counts = np.unique(tasks, axis=0, return_counts=True)
    assert len(counts) == len(known) and counts.min() > 0.5 * counts.max()


# --- as a part of training


@kinds
def test_a_pearl_learns_with_it(kind: dict[str, Any], tiny_pearl: MakePEARL) -> None:
    settings = {"relabel_probability": 0.5, "relabeller": kind}
    env = make_task_vec_env(ENV_ID, 4, env_kwargs={"goal_distance": 0.3, "n_train_tasks": 8})
    model = tiny_pearl(env, replay_buffer_kwargs=settings).learn(4 * ROLLOUT, log_interval=None)
    logged = model.logger.name_to_value
    assert 0 < logged["replay/relabelling_entropy"] < np.log(8)
    assert logged["replay/rewarded_fraction_hindsight"] > logged["replay/rewarded_fraction_real"] > 0
    returns, _ = evaluate_adaptation(model, env, "validation", n_episodes=2)
    assert np.isfinite(returns).all()


@kinds
def test_its_state_goes_on(kind: dict[str, Any], tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Also of what is not relabelled yet."""
    settings = {"replay_buffer_kwargs": {"relabel_probability": 1.0, "relabeller": kind}}
    model = tiny_pearl(**settings).learn(2 * ROLLOUT, log_interval=None)
    assert model.replay_buffer is not None and model.env is not None
    waiting = filled(n_episodes=3)
    for episode in np.split(waiting.episodes.rows[waiting.episodes.index().rows], 6):
        model.replay_buffer.relabeller.on_episode(0, episode)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    other = type(model).load(tmp_path / "model", env=model.env)
    other.load_replay_buffer(tmp_path / "replay")
    assert other.replay_buffer is not None
    ours, theirs = (buffer.sample(4, meta_batch_size=32) for buffer in (model.replay_buffer, other.replay_buffer))
    assert th.equal(ours.rewards, theirs.rewards) and th.equal(ours.observations, theirs.observations)
    assert model.replay_buffer.stats() == other.replay_buffer.stats()


def test_reset_forgets() -> None:
    buffer = relabelling(KINDS[0])
    buffer.sample(4, meta_batch_size=4)
    buffer.reset()
    assert buffer.stats()["replay/n_hindsight_buffers"] == 0
    with pytest.raises(ValueError, match="no complete episode"):
        buffer.sample(4)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ({"name": "HindsightForesight", "temperature": -1}, "temperature is -1, expected a number of at least 0"),
        ({"name": "HindsightForesight", "temperature": -np.inf}, "temperature is -inf, expected a number of at least 0"),
        ({"name": "HindsightForesight", "temperature": 0.0}, "temperature is 0, by which utilities cannot be divided"),
        ({"name": "HindsightForesight", "n_starts": 0}, "n_starts is 0, expected a whole number of at least 1"),
        ({"name": "HindsightInference", "n_starts": 3}, "'HindsightInference' has no setting 'n_starts'"),
    ],
)
def test_bad_settings_are_refused(kind: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(relabeller=kind)


@kinds
def test_rewards_may_be_of_double_precision(
    kind: dict[str, Any], tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, learnt = PointRobotFamily.compute_reward, []
    for kind_of_number in (np.float32, np.float64):
        monkeypatch.setattr(PointRobotFamily, "compute_reward", lambda *a, t=kind_of_number, **k: own(*a, **k).astype(t))
        model = tiny_pearl(replay_buffer_kwargs={"relabel_probability": 1.0, "relabeller": kind}).learn(2 * ROLLOUT)
        learnt.append(parameters(model))
    assert all(th.equal(learnt[1][name], value) for name, value in learnt[0].items())


class Judge:
    """Of a policy: z says nothing, values are what ``told`` makes of observations and actions."""

    device = th.device("cpu")

    def __init__(self, told: Any) -> None:
        self.told = told

    def infer(self, context: Context) -> tuple[th.Tensor, th.Tensor]:
        return th.zeros(len(context.lengths), 1), th.ones(len(context.lengths), 1)

    def values(self, obs: np.ndarray, z: th.Tensor, actions: np.ndarray | None = None) -> th.Tensor:
        return th.as_tensor(self.told(obs, actions)[:, None]).expand(z.shape[:2])


def rows_of(buffer: Any, n_episodes: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    for _ in range(n_episodes):
        add_episode(buffer, [0], 20, rng)
    return np.asarray(buffer.episodes.take(np.arange(20 * n_episodes)))


def test_foresight_is_from_the_same_starts_for_all_episodes() -> None:
    buffer = make_buffer(n_envs=1, relabel_probability=1.0, relabeller=HindsightForesight(n_starts=4), buffer_size=16_000)
    rows = rows_of(buffer, 4)
    rows[::20, buffer.transitions.observation] = [[0, 0], [1, 0], [2, 0], [3, 0]]
    assert isinstance(buffer.relabeller, HindsightForesight)
    buffer.relabeller.policy = Judge(lambda obs, actions: obs[:, 0])
    for _ in range(5):
        assert np.ptp(buffer.relabeller.utilities(rows, np.full(4, 20))) < 1e-6
