"""Files from strangers and damaged ones: nothing of them runs, and one sentence says what is wrong."""

import base64
import inspect
import io
import json
import pickle
import random
import re
import threading
import warnings
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, get_args

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import RescaleAction, RescaleObservation
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.save_util import data_to_json, load_from_zip_file
from stable_baselines3.common.utils import LinearSchedule

from helpers import ENV_ID, ROLLOUT, TINY, MakePEARL, many, parameters, with_policy
from helpers.bombs import Bomb, bombs
from sb3_htr import PEARL, AdaptedAgent, evaluate_adaptation, load_untrusted
from sb3_htr.adaptation import Aggregate, Belief, Prior
from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.safe_load import box_in_words
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering, MultiTaskReplayBuffer
from sb3_htr.pearl.pearl import LEARNING_RATE
from sb3_htr.pearl.policies import PEARLPolicy
from sb3_htr.pearl.untrusted import NUMBERS, WORDS
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.sac_her import SACHER


def repack(source: Path, target: Path, changed: dict[str, bytes]) -> None:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, changed.get(name, old.read(name)))


def test_the_bombs_are_live(tmp_path: Path) -> None:
    for i, bomb in enumerate(bombs(tmp_path / "fuse")):
        load = pickle.loads if i < 2 else lambda data: th.load(io.BytesIO(data), weights_only=False)
        load(bomb)
        assert (tmp_path / "fuse").exists()
        (tmp_path / "fuse").unlink()


def test_loading_a_replay_buffer_runs_no_code(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    for bomb in bombs(tmp_path / "fuse"):
        (tmp_path / "bomb.pt").write_bytes(bomb)
        with pytest.raises(ValueError, match=r"bomb\.pt is damaged, or no replay buffer of sb3_htr"):
            model.load_replay_buffer(tmp_path / "bomb.pt")
    assert not (tmp_path / "fuse").exists()


def test_loading_an_untrusted_model_runs_no_code(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    fuse = tmp_path / "fuse"
    tiny_pearl().save(tmp_path / "model.zip")
    for bomb in bombs(fuse):
        repack(tmp_path / "model.zip", tmp_path / "bomb.zip", {"policy.pth": bomb})
        with pytest.raises(ValueError, match=r"bomb\.zip (is damaged, or no model saved by PEARL|was loaded: it)"):
            load_untrusted(tmp_path / "bomb.zip", ENV_ID)
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    serialized = {":type:": "x", ":serialized:": base64.b64encode(cloudpickle.dumps(Bomb(fuse))).decode()}
    hostile: dict[str, Any] = {name: serialized for name in [*data, "learning_rate", "gamma", "replay_buffer_class"]}
    hostile["policy_kwargs"] = {**data["policy_kwargs"], "optimizer_class": serialized}
    repack(tmp_path / "model.zip", tmp_path / "bomb.zip", {"data": json.dumps(hostile).encode()})
    with pytest.raises(ValueError, match=r"bomb\.zip (is damaged, or no model saved by PEARL|was loaded: it)"):
        load_untrusted(tmp_path / "bomb.zip", ENV_ID)
    # What it needs is read, all else is ignored; its weights are fine
    hostile |= {name: data[name] for name in ("policy_class", "explorer", "train_explorer")}
    with pytest.raises(ValueError, match="its policy has the setting 'optimizer_class', which only"):
        repack(tmp_path / "model.zip", tmp_path / "bomb.zip", {"data": json.dumps(hostile).encode()})
        load_untrusted(tmp_path / "bomb.zip", ENV_ID)
    hostile["policy_kwargs"] = data["policy_kwargs"]
    repack(tmp_path / "model.zip", tmp_path / "bomb.zip", {"data": json.dumps(hostile).encode()})
    load_untrusted(tmp_path / "bomb.zip", ENV_ID)
    hostile["explorer"] = serialized
    repack(tmp_path / "model.zip", tmp_path / "bomb.zip", {"data": json.dumps(hostile).encode()})
    with pytest.raises(ValueError, match="its explorer is a class of its own"):
        load_untrusted(tmp_path / "bomb.zip", ENV_ID)
    load_untrusted(tmp_path / "bomb.zip", ENV_ID, explorer="belief")
    assert not fuse.exists()


def test_an_untrusted_model_is_refused_in_an_env_of_other_bounds(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    for wrapper, name in ((RescaleObservation, "Observation"), (RescaleAction, "Action")):
        other = wrapper(gym.make(ENV_ID), np.float32(-3), np.float32(3))
        with pytest.raises(ValueError, match=rf"{name} spaces do not match: Box\(-3\.0, 3\.0, \(2,\), float32\) here"):
            load_untrusted(tmp_path / "model", other)


def test_an_untrusted_model_is_loaded_in_its_env_however_numpy_printed(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    env = RescaleAction(gym.make(ENV_ID), np.float32(-np.pi), np.float32(np.pi))
    with np.printoptions(precision=2, threshold=1, formatter={"float": lambda x: "?"}):
        tiny_pearl(env, n_tasks_per_rollout=1).save(tmp_path / "model")
    load_untrusted(tmp_path / "model", RescaleAction(gym.make(ENV_ID), np.float32(-np.pi), np.float32(np.pi)))


@given(
    bounds=arrays(np.float32, (2, 6), elements=st.floats(-1e6, 1e6, width=32)).map(lambda a: np.sort(a, axis=0)),
    unbounded=st.booleans(),
    shape=st.sampled_from([(6,), (2, 3)]),
)
def test_a_space_in_words_is_the_space(bounds: np.ndarray, unbounded: bool, shape: tuple[int, ...]) -> None:
    low, high = bounds.reshape(2, *shape)
    space = gym.spaces.Box(np.where(unbounded, -np.inf, low).astype(np.float32), high)
    words = box_in_words(json.loads(data_to_json({"space": space}))["space"])
    assert words is not None and words.shape == shape
    np.testing.assert_allclose([words.low, words.high], [space.low, space.high], rtol=1e-5, atol=1e-8)


def test_a_space_that_was_not_printed_in_full_is_not_guessed() -> None:
    long = json.loads(data_to_json({"space": gym.spaces.Box(np.arange(2000.0), np.arange(2000.0) + 1)}))["space"]
    for record in (
        long,
        None,
        "Box",
        {},
        {"low": 3, "high": [1], "_shape": [1]},
        {"low": "[1.]", "high": "[x]", "_shape": [1]},
    ):
        assert box_in_words(record) is None, record


def test_explorers_can_be_given_in_place_of_those_of_the_file(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", explorer="prior", train_explorer={"name": "aggregate", "scale": 2.0})
    assert loaded.explorer == Prior() and loaded.train_explorer == Aggregate(scale=2.0)


def test_settings_that_an_explorer_had_once_are_left_out(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    explorer = Belief(margin=2.0)
    explorer.noise = 0.1  # type: ignore[attr-defined]
    tiny_pearl(explorer=explorer).save(tmp_path / "older")
    with pytest.warns(UserWarning, match="'belief' has no setting 'noise' in this version: it is left out"):
        assert load_untrusted(tmp_path / "older", ENV_ID).explorer == Belief(margin=2.0)
    with warnings.catch_warnings(), pytest.raises(UserWarning, match="no setting 'noise'"):
        warnings.simplefilter("error")  # and is not taken for damage
        load_untrusted(tmp_path / "older", ENV_ID)
    assert PEARL.load(tmp_path / "older").explorer == Belief(margin=2.0)


def test_an_untrusted_model_acts_as_the_one_that_was_saved(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    explorers: dict[str, Any] = {"explorer": Belief(margin=2.0), "train_explorer": Prior(2)}
    replay = {"relabeller": {"name": "EpisodeClustering", "cell_size": 0.3}, "relabel_probability": 0.4}
    rate = LinearSchedule(2e-3, 1e-4, 0.5)
    settings = {"learning_rate": rate, "replay_buffer_kwargs": replay, **explorers}
    policy_kwargs = with_policy(encoder_class="PriorFactorEncoder", use_next_obs_in_context=True)
    settings |= {"n_steps": 2, "final_kl_coef": 0.03, "policy_kwargs": policy_kwargs}
    model = tiny_pearl(gamma=0.7, kl_coef=0.02, context_size=7, **settings).learn(3 * ROLLOUT)
    model.save(tmp_path / "model.zip")
    loaded = load_untrusted(tmp_path / "model.zip", ENV_ID)
    assert loaded.gamma == 0.7 and loaded.kl_coef == 0.02 and loaded.context_size == 7
    assert loaded.n_steps == 2 and loaded.final_kl_coef == 0.03
    assert type(loaded.policy.encoder) is type(model.policy.encoder)
    assert loaded.num_timesteps == model.num_timesteps and loaded._n_updates == model._n_updates
    assert loaded.replay_buffer_kwargs == replay and vars(loaded.learning_rate) == vars(rate)
    assert loaded.explorer == Belief(margin=2.0) and loaded.train_explorer == Prior(2)
    assert load_untrusted(tmp_path / "model.zip", ENV_ID, explorer="prior").explorer == Prior()
    for a, b in zip(*(evaluate_adaptation(m, ENV_ID, "validation", n_episodes=3) for m in (model, loaded)), strict=True):
        np.testing.assert_array_equal(a, b)
    tiny_pearl(ent_coef="auto_0.3", target_entropy=-1.5, matmul_precision="medium", cuda_graph=False).save(
        tmp_path / "words.zip"
    )
    words = load_untrusted(tmp_path / "words.zip", ENV_ID)
    assert (words.ent_coef, words.target_entropy, words.matmul_precision) == ("auto_0.3", -1.5, "medium")
    assert words.cuda_graph is False
    # What is pickled is left out
    tiny_pearl(learning_rate=lambda _: 1.0, replay_buffer_kwargs={"relabeller": EpisodeClustering(0.2)}).save(
        tmp_path / "own.zip"
    )
    own = load_untrusted(tmp_path / "own.zip", ENV_ID)
    assert str(own.learning_rate) == str(LEARNING_RATE) and own.replay_buffer_kwargs == {}
    with pytest.raises(ValueError, match="do not fit the env or the settings"):
        load_untrusted(tmp_path / "model.zip", "SparseTargetSpeed-v0", policy_kwargs={"latent_dim": 7})


def test_no_plain_setting_of_pearl_is_forgotten() -> None:
    """Those that are left out take memory, or are the user's."""
    for name, parameter in inspect.signature(PEARL).parameters.items():
        # Also those that follow from the time limit, whose default is None
        is_number = {int, float} & {parameter.annotation, *get_args(parameter.annotation)}
        if is_number and name not in ("stats_window_size", "verbose", "seed"):
            assert name in NUMBERS, name
        if isinstance(parameter.default, str) and name not in ("explorer", "train_explorer", "device"):
            assert re.fullmatch(WORDS[name], parameter.default), name


@many
@given(st.binary(max_size=300))
def test_garbage_is_refused(tmp_path_factory: pytest.TempPathFactory, garbage: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "garbage"
    file.write_bytes(garbage)
    with pytest.raises(ValueError, match="is damaged, or no model saved by PEARL"):
        load_untrusted(file, ENV_ID)


@pytest.mark.parametrize("numbers", [{"end_fraction": 0}, {"start": 10**400}, {"end": float("inf")}])
def test_a_schedule_without_numbers_is_refused(numbers: dict[str, float], tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl(learning_rate=LinearSchedule(0.1, 0.0, 1.0)).save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    data["learning_rate"] |= numbers
    repack(tmp_path / "model.zip", tmp_path / "crafted.zip", {"data": json.dumps(data).encode()})
    with pytest.raises(ValueError, match=r"crafted\.zip is damaged"):
        load_untrusted(tmp_path / "crafted.zip", ENV_ID)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_truncated_files_are_refused(tiny_pearl: MakePEARL, tmp_path: Path, part: float) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pt")
    for name in ("model.zip", "buffer.pt"):
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: int(part * len(data))])
    with pytest.raises(ValueError, match="is damaged"):
        load_untrusted(tmp_path / "model.zip", ENV_ID)
    with pytest.raises(ValueError, match="is damaged"):
        model.load_replay_buffer(tmp_path / "buffer.pt")


def test_flipped_bits_are_noticed_or_harmless(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """A hundred in each kind of file."""
    model = tiny_pearl().learn(ROLLOUT)
    agent = model.adapt(gym.make(ENV_ID), n_episodes=1)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pt")
    agent.save(tmp_path / "agent.pt")
    assert model.replay_buffer is not None
    rows, actor, places = model.replay_buffer.episodes.rows, model.policy.state_dict(), random.Random(0)
    noticed = dict.fromkeys(("model.zip", "buffer.pt", "agent.pt"), 0)
    for name in noticed:
        whole = (tmp_path / name).read_bytes()
        for _ in range(100):
            damaged = bytearray(whole)
            damaged[places.randrange(len(damaged))] ^= 1 << places.randrange(8)
            (tmp_path / name).write_bytes(damaged)
            try:
                if name == "model.zip":  # which has more than is read here: states of optimizers
                    weights = load_untrusted(tmp_path / name, ENV_ID).policy.state_dict()
                    assert all(th.equal(weights[key], value) for key, value in actor.items())
                elif name == "buffer.pt":
                    model.load_replay_buffer(tmp_path / name)
                    np.testing.assert_array_equal(model.replay_buffer.episodes.rows, rows)
                else:
                    weights = AdaptedAgent.load(tmp_path / name).policy.state_dict()
                    assert all(th.equal(actor[key], value) for key, value in weights.items())
            except ValueError:
                noticed[name] += 1
    assert min(noticed.values()) > 50


def test_a_replay_buffer_of_other_settings_is_refused(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().learn(ROLLOUT).save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match="make the model with the relabeller that it was saved with"):
        (model := tiny_pearl(replay_buffer_kwargs={"relabeller": "EpisodeClustering"})).load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is not None and model.replay_buffer.size() == 0, "nothing was loaded"
    # Refused whatever it holds: hindsight buffers of another kind, or none at K = 0
    kinds: list[dict[str, Any]] = [{"relabeller": "HindsightForesight"}, {"relabel_probability": 0.0}]
    for kind in kinds:
        tiny_pearl(replay_buffer_kwargs=kind).learn(ROLLOUT).save_replay_buffer(tmp_path / "other")
        with pytest.raises(ValueError, match="make the model with the relabeller that it was saved with"):
            model.load_replay_buffer(tmp_path / "other")
    model.learn(ROLLOUT)
    with pytest.raises(ValueError, match="use the settings that they were saved with"):
        tiny_pearl(buffer_size=10_000).load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"task bank has 20 steps of 9 numbers .* this model has 7 of 9"):
        tiny_pearl(context_size=7).load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match="pass env="):
        PEARL("MlpPolicy", None, _init_setup_model=False).load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match="no env, so it has no replay buffer"):
        PEARL("MlpPolicy", None, _init_setup_model=False).save_replay_buffer(tmp_path / "other")


def test_streams_work_as_files_do(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    assert model.replay_buffer is not None
    model_file, buffer_file = io.BytesIO(), io.BytesIO()
    model.save(model_file)
    model.save_replay_buffer(buffer_file)
    model_file.seek(0)
    buffer_file.seek(0)
    loaded = PEARL.load(model_file, env=make_task_vec_env(ENV_ID, 4))
    loaded.load_replay_buffer(buffer_file)
    assert loaded.replay_buffer is not None and loaded.replay_buffer.size() == model.replay_buffer.size()


def test_a_save_that_fails_leaves_the_old_model(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    model.not_picklable = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(TypeError):
        model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_a_replay_buffer_that_cannot_be_written_leaves_the_old_one(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_pearl().learn(ROLLOUT)
    model.save_replay_buffer(tmp_path / "buffer.pt")
    before = (tmp_path / "buffer.pt").read_bytes()

    def write_half(state: Any, file: Any) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(th, "save", write_half)
    with pytest.raises(OSError, match="No space left"):
        model.save_replay_buffer(tmp_path / "buffer.pt")
    assert (tmp_path / "buffer.pt").read_bytes() == before and len([*tmp_path.iterdir()]) == 1


def test_a_state_is_a_copy(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl(ent_coef="auto").learn(ROLLOUT)
    before, state = parameters(model), model.state_dict()
    entropy = state["log_ent_coef"].clone()
    model.learn(ROLLOUT, reset_num_timesteps=False)
    assert not th.equal(entropy, model.log_ent_coef), "it learns"  # type: ignore[arg-type]
    model.load_state_dict(state)
    after = parameters(model)
    assert all(th.equal(value, after[name]) for name, value in before.items())
    assert th.equal(entropy, model.log_ent_coef)  # type: ignore[arg-type]
    # What goes on from it leaves it as it is, its optimizers included
    twins = []
    for _ in range(2):
        model.load_state_dict(state)
        twins.append(parameters(model.learn(ROLLOUT, reset_num_timesteps=False)))
    assert all(th.equal(value, twins[1][name]) for name, value in twins[0].items())


def test_settings_of_an_untrusted_file_are_joined_with_those_given(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl(replay_buffer_kwargs={"relabel_probability": 0.3}).save(tmp_path / "model")
    given: dict[str, Any] = {
        "policy_kwargs": {"normalize_observations": True},
        "replay_buffer_kwargs": {"context_episodes": 2},
    }
    model = load_untrusted(tmp_path / "model", ENV_ID, **given)
    assert model.policy.latent_dim == 3 and model.replay_buffer is not None
    assert (model.replay_buffer.relabel_probability, model.replay_buffer.context_episodes) == (0.3, 2)


def test_a_file_of_n_step_returns_is_loaded_without_a_warning(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl(n_steps=3).save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone, with_env = PEARL.load(tmp_path / "model"), PEARL.load(tmp_path / "model", env=make_task_vec_env(ENV_ID, 3))
    assert alone.n_steps == with_env.n_steps == 3


def test_a_file_is_loaded_as_what_it_is_and_with_settings_that_are_known(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"PEARL has no setting 'gama': did you mean gamma\?"):
        PEARL.load(tmp_path / "model", gama=0.9)
    with pytest.raises(ValueError, match="tau is 0, with which the target critics would never learn"):
        PEARL.load(tmp_path / "model", tau=0.0)
    with pytest.raises(ValueError, match="context_size is 0, expected a whole number of at least 1"):
        PEARL.load(tmp_path / "model", context_size=0)
    with pytest.raises(ValueError, match="stats_window_size is 0, expected a whole number of at least 1"):
        PEARL.load(tmp_path / "model", stats_window_size=0)
    loaded = PEARL.load(tmp_path / "model", gamma=0.9, device="cpu", stats_window_size=7)
    assert loaded.gamma == 0.9 and loaded._stats_window_size == 7
    env = make_task_vec_env(ENV_ID, 3)
    follows = PEARL.load(tmp_path / "model", env=env, gamma=None, gradient_steps=None, n_tasks_per_rollout=4)
    plain = PEARL("MlpPolicy", env, n_tasks_per_rollout=4, n_episodes_per_task=follows.n_episodes_per_task)
    for name in ("gamma", "gradient_steps", "n_tasks_per_rollout"):
        assert getattr(follows, name) == getattr(plain, name), name
    SAC("MlpPolicy", "Pendulum-v1").save(tmp_path / "sac")
    with pytest.raises(ValueError, match="PEARL has no policies such as SACPolicy: is the file one of another algorithm"):
        PEARL.load(tmp_path / "sac")
    for rival in (RL2, SACHER):
        with pytest.raises(ValueError, match=f"{rival.__name__} has no policies such as PEARLPolicy"):
            rival.load(tmp_path / "model")
    with pytest.raises(ValueError, match=f"The env is the id '{ENV_ID}', expected an env: make it with"):
        PEARL.load(tmp_path / "model", env=ENV_ID)  # type: ignore[arg-type]


def test_networks_of_default_sizes_are_read_without_trust(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl(policy_kwargs={"net_arch": None, "encoder_arch": None, "latent_dim": 3}).save(tmp_path / "model")
    env = make_task_vec_env(ENV_ID, 4)
    assert load_untrusted(tmp_path / "model", env).policy.latent_dim == 3
    tiny_pearl(policy_kwargs={"activation_fn": th.nn.Tanh}).save(tmp_path / "tanh")
    with pytest.raises(ValueError, match="has the setting 'activation_fn', which only"):
        load_untrusted(tmp_path / "tanh", env)


def test_numbers_of_numpy_are_numbers_to_all_who_read_a_file(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """As a sweep over an array gives them."""
    numbers: dict[str, Any] = {"gamma": np.float32(0.5), "context_size": np.int64(7), "batch_size": np.int32(5)}
    numbers["explorer"] = Prior(n_exploration_episodes=np.int64(2))  # type: ignore[arg-type]
    numbers["replay_buffer_kwargs"] = {"relabel_probability": np.float64(0.5)}
    model = tiny_pearl(**numbers, policy_kwargs=with_policy(latent_dim=np.int64(2), net_arch=[np.int64(8)]))
    model.learn(2 * ROLLOUT).save(tmp_path / "model")
    for loaded in (PEARL.load(tmp_path / "model"), load_untrusted(tmp_path / "model", ENV_ID)):
        assert (loaded.gamma, loaded.context_size, loaded.batch_size) == (0.5, 7, 5)
        assert loaded.explorer == Prior(2) and loaded.policy.latent_dim == 2
        assert loaded.replay_buffer_kwargs == {"relabel_probability": 0.5}


def test_a_number_that_is_pickled_is_missed(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl()
    model.gamma = np.float32(0.5)  # type: ignore[assignment]
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="gamma is in .* as no plain number, and is left at its default"):
        load_untrusted(tmp_path / "model", ENV_ID)


def test_a_relabeller_that_is_an_object_is_missed(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    settings = {"relabeller": EpisodeClustering(cell_size=0.2), "relabel_probability": 0.3}
    tiny_pearl(replay_buffer_kwargs=settings).save(tmp_path / "model")
    with pytest.warns(UserWarning, match="replay_buffer_kwargs are in .* as no plain data, and are left at their default"):
        load_untrusted(tmp_path / "model", ENV_ID)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load_untrusted(tmp_path / "model", ENV_ID, replay_buffer_kwargs=settings)
    assert isinstance(loaded.replay_buffer, MultiTaskReplayBuffer) and loaded.replay_buffer.relabel_probability == 0.3


def test_layers_of_actor_and_critics_may_differ(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model = tiny_pearl(policy_kwargs=with_policy(net_arch={"pi": [8], "qf": [9, 10]})).learn(2 * ROLLOUT)
    model.save(tmp_path / "model")
    loaded = load_untrusted(tmp_path / "model", ENV_ID)
    for a, b in zip(*(evaluate_adaptation(m, ENV_ID, "validation", n_episodes=3) for m in (model, loaded)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_entropy_coefficient_that_load_is_given_is_the_one_that_is_used(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl(ent_coef=0.01).save(tmp_path / "model")
    SACHER("MultiInputPolicy", ENV_ID, ent_coef=0.01, buffer_size=1000).save(tmp_path / "told")
    for model in (PEARL.load(tmp_path / "model", ent_coef=0.2), SACHER.load(tmp_path / "told", ent_coef=0.2)):
        assert model.ent_coef == 0.2 and model.ent_coef_tensor.item() == pytest.approx(0.2)
    assert PEARL.load(tmp_path / "model").ent_coef_tensor.item() == pytest.approx(0.01)


class ActsByHalf(PEARLPolicy):
    def _act(self, obs_z: th.Tensor, deterministic: bool) -> th.Tensor:
        return super()._act(obs_z, deterministic) / 2


class OwnPrior(Prior):
    """Has the name of another one."""


def test_what_acts_in_a_way_of_its_own_is_not_loaded_as_something_else(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    own = PEARL(ActsByHalf, ENV_ID, policy_kwargs=with_policy())
    own.save(tmp_path / "policy")
    tiny_pearl(explorer=OwnPrior()).save(tmp_path / "explorer")
    for name, what in (("policy", "its policy is a class of its own"), ("explorer", "its explorer is a class of its own")):
        with pytest.raises(ValueError, match=f"{what}.*, which only PEARL.load restores"):
            load_untrusted(tmp_path / name, ENV_ID)
        assert PEARL.load(tmp_path / name).policy is not None
    load_untrusted(tmp_path / "explorer", ENV_ID, explorer="prior")
    small = gym.wrappers.RescaleAction(gym.make(ENV_ID), np.float32(-1e-4), np.float32(1e-4))
    for model in (own, PEARL(ActsByHalf, small, policy_kwargs=with_policy())):
        agent = AdaptedAgent(model.policy, np.zeros(3, dtype=np.float32), np.zeros(0), np.zeros(0, dtype=bool))
        with pytest.raises(ValueError, match="acts in a way of its own: save the model"):
            agent.save(tmp_path / "agent")


def test_what_was_refused_is_not_there(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Else the next learn() trains with it."""
    model = tiny_pearl(buffer_size=80 * 20)
    env, replay = model.env, model.replay_buffer
    with pytest.raises(ValueError, match="too small for one episode"):
        model.set_env(make_task_vec_env(ENV_ID, 4, env_kwargs={"n_train_tasks": 200}))
    assert model.env is env and model.replay_buffer is replay and model.max_episode_steps == 20
    other = tiny_pearl().learn(ROLLOUT)
    assert other.replay_buffer is not None
    other.replay_buffer.episodes._data[..., other.replay_buffer.transitions.reward] += 1
    other.save_replay_buffer(tmp_path / "replay")
    model = tiny_pearl()
    with pytest.raises(ValueError, match="of another task family"):
        model.load_replay_buffer(tmp_path / "replay")
    assert model.replay_buffer is not None and model.replay_buffer.size() == 0


def test_load_takes_replay_settings_beside_those_of_the_file(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    replay = {"relabel_probability": 0.3, "relabeller": {"name": "SingleEpisodeRelabelling", "elsewhere": 0.25}}
    tiny_pearl(replay_buffer_kwargs=replay).save(tmp_path / "model")
    given: dict[str, Any] = {"replay_buffer_kwargs": {"context_episodes": 2}}
    with open(tmp_path / "model.zip", "rb") as file:
        models = [PEARL.load(tmp_path / "model", **given), PEARL.load(file, **given)]
    for model in (*models, load_untrusted(tmp_path / "model", ENV_ID, **given)):
        assert model.replay_buffer_kwargs == {**replay, "context_episodes": 2}


def test_settings_given_to_load_are_checked_as_the_constructors(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    given: tuple[tuple[dict[str, Any], str], ...] = (
        ({"replay_buffer_kwargs": {"relabel_probabilty": 1}}, "did you mean relabel_probability"),
        ({"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class is HerReplayBuffer, expected MultiTask"),
        ({"seed": -1}, "seed is -1, expected a whole number"),
        ({"ent_coef": -0.1}, "ent_coef is -0.1, expected a number of at least 0"),
    )
    for kwargs, message in given:
        for env in (None, make_task_vec_env(ENV_ID, 4)):
            with pytest.raises(ValueError, match=message):
                PEARL.load(tmp_path / "model", env=env, **kwargs)


def test_what_follows_from_the_time_limit_is_known_without_an_env(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().save(tmp_path / "model")
    loaded = PEARL.load(tmp_path / "model", gamma=None, context_size=None, gradient_steps=None)
    trained = PEARL.load(tmp_path / "model", tiny_pearl().env, gamma=None, context_size=None, gradient_steps=None)
    for name in ("gamma", "context_size", "gradient_steps"):
        assert getattr(loaded, name) == getattr(trained, name) > 0, name


def test_a_file_has_nothing_that_load_makes_anew(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().learn(ROLLOUT).save(tmp_path / "model")
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert data is not None and not {"_rng", "_task_queue"} & data.keys()
    env = make_task_vec_env(ENV_ID, 4)
    PEARL.load(tmp_path / "model", env=env).learn(ROLLOUT)
    later = PEARL.load(tmp_path / "model")
    later.set_env(env)
    later.learn(ROLLOUT)


def test_a_path_that_cannot_be_opened_is_not_called_damaged(tmp_path: Path) -> None:
    """Only a file that was read is."""
    folder = tmp_path / "folder.pt"
    folder.mkdir()
    for load in (load_arrays, AdaptedAgent.load, partial(load_untrusted, env=ENV_ID)):
        with pytest.raises(IsADirectoryError):
            load(folder)


def test_a_folder_of_a_models_name_is_not_in_its_way(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """``save`` writes beside it, and SB3's ``load`` would read the folder."""
    folder = tmp_path / "model"
    folder.mkdir()
    with pytest.raises(IsADirectoryError, match=r"model is a folder, expected a model file\.$"):
        PEARL.load(folder)
    tiny_pearl().save(folder)
    assert PEARL.load(str(folder)).seed == 0
    with pytest.raises(
        IsADirectoryError, match=r"is a folder, expected a model file, such as one of \['model.zip'\] in it\.$"
    ):
        PEARL.load(tmp_path)


@pytest.mark.filterwarnings("ignore:No reward was found")
def test_a_model_is_told_by_what_is_in_its_file(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Its name may end as files of torch do, and theirs as a model's."""
    model = tiny_pearl()
    model.save(tmp_path / "model.pt")
    assert PEARL.load(tmp_path / "model.pt").seed == 0
    model.save_replay_buffer(tmp_path / "replay")
    for name in ("agent.pt", "agent.zip"):
        model.adapt(ENV_ID, n_episodes=1, task=0).save(tmp_path / name)
    for name in ("agent.pt", "agent", "replay.pt"):
        with pytest.raises(ValueError, match=r"is no model: an agent .* is loaded by AdaptedAgent\.load, and a replay"):
            PEARL.load(tmp_path / name)


def test_a_setting_that_cannot_be_read_is_not_the_default(
    tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one of a class that is gone; SB3 warns, and goes on without."""
    gone = type("Gone", (EpisodeClustering,), {"__module__": "sb3_htr.htr", "__qualname__": "Gone"})
    with monkeypatch.context() as patch:
        patch.setattr("sb3_htr.htr.Gone", gone, raising=False)
        tiny_pearl(replay_buffer_kwargs={"relabeller": gone(), "relabel_probability": 0.3}).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"model has a replay_buffer_kwargs that cannot be read.*'Gone'.*give all of it"):
        PEARL.load(tmp_path / "model")
    given = {"relabeller": EpisodeClustering(), "relabel_probability": 0.3}
    with pytest.warns(UserWarning, match="Could not deserialize object replay_buffer_kwargs"):
        model = PEARL.load(tmp_path / "model", replay_buffer_kwargs=given)
    assert model.replay_buffer_kwargs == given


def test_a_policy_that_cannot_be_read_is_said(tmp_path: Path, tiny_pearl: MakePEARL, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = type("Gone", (PEARLPolicy,), {"__module__": "sb3_htr.pearl.policies", "__qualname__": "Gone"})
    with monkeypatch.context() as patch:
        patch.setattr("sb3_htr.pearl.policies.Gone", gone, raising=False)
        PEARL(gone, ENV_ID, **TINY).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"a policy_class that cannot be read.* as custom_objects={'policy_class': \.\.\.}"):
        PEARL.load(tmp_path / "model")
    assert type(PEARL.load(tmp_path / "model", custom_objects={"policy_class": PEARLPolicy}).policy) is PEARLPolicy


def test_warnings_that_are_errors_are_told_as_what_they_are(tmp_path: Path, tiny_pearl: MakePEARL) -> None:
    tiny_pearl().save(tmp_path / "model")
    env = make_task_vec_env(ENV_ID, 64)
    with warnings.catch_warnings(), pytest.raises(UserWarning, match="A rollout is of 64 tasks"):
        warnings.simplefilter("error")
        PEARL.load(tmp_path / "model", env)
