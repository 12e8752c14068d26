"""Anything may come in; what comes out is a result that keeps its promises, or one sentence."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from helpers import many
from helpers.experience import make_buffer
from htr_envs import PointRobotFamily, TargetSpeedFamily
from sb3_htr.adaptation.explorers import EXPLORERS, to_explorer
from sb3_htr.common.settings import keywords_of
from sb3_htr.htr.relabel import RELABELLERS
from sb3_htr.zoo.run.method import merged
from sb3_htr.zoo.run.trust import plain_settings

FAMILY = PointRobotFamily(n_train_tasks=5, n_test_tasks=2, n_validation_tasks=2)
anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-5, 50),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(-1, 1), max_size=3),
    st.sampled_from(["random", "final", "even", "episode", "task", "sparse", "dense"]),
)
BUFFER_SETTINGS = ["relabel_probability", "rl_reward_type", "context_episodes", "buffer_size"]
RELABELLER_SETTINGS = sorted(set().union(*map(keywords_of, RELABELLERS.values())))
EXPLORER_SETTINGS = sorted(set().union(*map(keywords_of, EXPLORERS.values())))


def settings_of(names: list[str]) -> st.SearchStrategy[dict[str, Any]]:
    return st.dictionaries(st.sampled_from(names), anything, max_size=3)


@many
@example({}, "EpisodeClustering", {"exploratory_fraction": "\n"})
@given(settings_of(BUFFER_SETTINGS), st.sampled_from(sorted(RELABELLERS)), settings_of(RELABELLER_SETTINGS))
def test_buffers(kwargs: dict[str, Any], name: str, settings: dict[str, Any]) -> None:
    try:
        buffer = make_buffer(task_family=FAMILY, relabeller={"name": name, **settings}, **kwargs)
    except ValueError as error:
        assert str(error).count("\n") == 0 and any(given_name in str(error) for given_name in (*kwargs, *settings))
    else:
        assert 0 <= buffer.relabel_probability <= 1 and buffer.context_episodes >= 1
        assert type(buffer.relabeller).__name__ == name
        assert all(hasattr(buffer.relabeller, setting) for setting in settings if setting != "cell_size"), "none is ignored"


@many
@given(st.sampled_from(sorted(EXPLORERS)), settings_of(EXPLORER_SETTINGS))
def test_explorers(name: str, settings: dict[str, Any]) -> None:
    try:
        explorer = to_explorer({"name": name, **settings})
    except ValueError as error:
        assert str(error).count("\n") == 0 and any(setting in str(error) for setting in settings)
    else:
        assert all(getattr(explorer, setting) == value for setting, value in settings.items())


@many
@given(st.data())
def test_add_and_sample(data: st.DataObject) -> None:
    """Whatever steps come, ``add`` takes them or refuses them, and ``sample`` only knows whole episodes of one task."""
    relabeller = {"name": data.draw(st.sampled_from(["SingleEpisodeRelabelling", "EpisodeClustering"]))}
    relabeller["hindsight_task_strategy"] = data.draw(st.sampled_from(["random", "final", "even"]))
    if relabeller["name"] == "SingleEpisodeRelabelling":
        relabeller["rl_batch_source"] = data.draw(st.sampled_from(["episode", "task"]))
    buffer = make_buffer(
        task_family=FAMILY,
        n_envs=2,
        buffer_size=5 * 20 * data.draw(st.integers(1, 4)),
        relabel_probability=data.draw(st.floats(0, 1)),
        relabeller=relabeller,
    )
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    tasks = np.zeros(2, dtype=np.int64)
    done = np.full(2, True)
    for _ in range(data.draw(st.integers(0, 60))):
        tasks[done] = rng.integers(0, 5, done.sum())
        obs, action = rng.normal(size=(2, 2)).astype(np.float32), rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        done = rng.random(2) < data.draw(st.sampled_from([0.02, 0.3, 1.0]))
        bad = data.draw(st.sampled_from([None] * 20 + ["nan", "task", "action"]))
        if bad == "nan":
            obs[0, 0] = np.nan
        if bad == "action":
            action[0, 0] = 1.1
        infos = [{"task_id": 99 if bad == "task" else int(task), "task_free_reward": 0.0} for task in tasks]
        before = buffer.size()
        try:
            buffer.add(obs, obs + 0.1, action, np.zeros(2), done, infos)
        except ValueError as error:
            assert buffer.size() == before
            assert bad or "longer than the env's time limit" in str(error)
            return
    sizes = data.draw(st.tuples(st.integers(1, 7), st.integers(1, 9), st.integers(1, 30)))
    if buffer.size() == 0:
        with pytest.raises(ValueError, match="no complete episode"):
            buffer.sample(sizes[0], meta_batch_size=sizes[1], context_size=sizes[2])
        return
    sample = buffer.sample(sizes[0], meta_batch_size=sizes[1], context_size=sizes[2])
    for drawn in (sample, sample.context):
        assert drawn.observations.shape == drawn.actions.shape == (drawn.lengths.sum(), 2)
    assert all(np.isfinite(np.asarray(tensor)).all() for tensor in (*sample.context, *sample[1:-1]))
    assert (buffer.n_episodes[sample.task_ids] > 0).all()
    for lengths, largest in ((sample.lengths, sizes[0]), (sample.context.lengths, sizes[2])):
        assert len(lengths) == sizes[1] and (lengths >= 1).all() and (lengths <= largest).all()


@pytest.mark.parametrize(
    ("family", "names"),
    [(PointRobotFamily, ["goal_distance", "goal_radius"]), (TargetSpeedFamily, ["min_speed", "max_speed", "tolerance"])],
)
@many
@given(data=st.data())
def test_families(family: Any, names: list[str], data: st.DataObject) -> None:
    number, of_sets = st.one_of(st.integers(-2, 40), st.floats(-1, 12)), ["n_train_tasks", "n_test_tasks", "task_seed"]
    kwargs = data.draw(st.dictionaries(st.sampled_from([*names, *of_sets]), number, max_size=3))
    try:
        tasks = family(**kwargs).train_tasks
    except ValueError as error:
        # Of a setting, or of what follows from one that is next to nothing
        assert str(error).count("\n") == 0 and any(name in str(error) for name in (*kwargs, "train_tasks holds"))
    else:
        assert tasks.ndim == 2 and np.isfinite(tasks).all()


@many
@given(st.dictionaries(st.sampled_from(["policy_kwargs", "normalize", "replay_buffer_class", "gamma"]), anything))
def test_yaml_values(hyperparams: dict[str, Any]) -> None:
    try:
        read = plain_settings(hyperparams, "file.yml", trust=False)
    except ValueError as error:
        assert str(error).count("\n") == 0
    else:
        assert read.keys() == hyperparams.keys()


keys = st.sampled_from(["a", "b", "name"])
trees = st.recursive(anything, lambda inner: st.dictionaries(keys, inner, max_size=3), max_leaves=4)


@given(st.dictionaries(keys, trees, max_size=3), st.dictionaries(keys, trees, max_size=3))
def test_settings_can_always_be_joined(first: dict[str, Any], second: dict[str, Any]) -> None:
    assert merged(first, second).keys() == {*first, *second}
    assert repr(merged(first, {})) == repr(first) and repr(merged({}, second)) == repr(second)
