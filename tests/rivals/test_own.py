"""A rival that comes from outside of the package, the example's."""

import copy
import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from helpers import ENV_ID
from helpers.results import made_up
from helpers.runs import run_folder
from sb3_htr import evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.experiments import grid, report
from sb3_htr.experiments.grid import Experiment, Variant
from sb3_htr.experiments.runner import run_cell
from sb3_htr.rivals.off_policy import OffPolicyRival
from sb3_htr.rivals.on_policy import OnPolicyRival
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.untrusted import load_untrusted
from sb3_htr.zoo.cli import main
from sb3_htr.zoo.commands.export import export
from sb3_htr.zoo.run import algorithm, method
from sb3_htr.zoo.run.agents import TrainedAgent, agent_at
from sb3_htr.zoo.run.record import RECORD

MODULE = "examples.plain_ppo"
SMALL: dict[str, Any] = {"n_steps": 40, "batch_size": 40, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}
PARAMS = [f"{key}:{value!r}".replace(" ", "") for key, value in {**SMALL, "n_envs": 4}.items()]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module; what it registers is forgotten afterwards."""
    monkeypatch.setattr(algorithm, "ALGORITHMS", dict(algorithm.ALGORITHMS))
    monkeypatch.setattr(method, "ALGORITHMS", algorithm.ALGORITHMS)
    monkeypatch.setattr(grid, "EXPERIMENTS", dict(grid.EXPERIMENTS))
    yield importlib.import_module(MODULE)
    sys.modules.pop(MODULE)
    method.methods.cache_clear()


def test_the_commands_know_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It trains, goes on exactly where it was killed, is evaluated and watched."""
    packages = ["--gym-packages", MODULE]
    runs = [tmp_path / "once", tmp_path / "twice"]
    for folder, n in zip(runs, ("640", "320"), strict=True):
        what = ["--env", ENV_ID, *packages, "--method", "plain-ppo", "-n", n, "--seed", "1"]
        assert main(["train", *what, "-f", str(folder), "--eval-freq", "-1", "--verbose", "0", "-params", *PARAMS]) == 0
    run, begun = (run_folder(folder, "plain-ppo") for folder in runs)
    assert main(["train", "--resume", str(begun), "-n", "320", *packages]) == 0
    weights = [agent_at(folder, "last").load().policy.state_dict() for folder in (run, begun)]
    assert all(th.equal(value, weights[1][name]) for name, value in weights[0].items())
    assert json.loads((run / RECORD).read_text())["method"] == "plain-ppo"
    assert main(["evaluate", str(run), *packages, "--n-episodes", "2", "-o", str(tmp_path)]) == 0
    few = ["--no-render", "--n-tasks", "1", "--n-episodes", "1", "-f", str(runs[0])]
    assert main(["enjoy", "--env", ENV_ID, *packages, "--method", "plain-ppo", *few]) == 0
    assert "explorer 'own'" in capsys.readouterr().out
    with pytest.raises(ValueError, match="what to search for plain-ppo: give register_algorithm a search_space"):
        main(["optimize", "--env", ENV_ID, *packages, "--method", "plain-ppo", "-f", str(tmp_path)])


def test_it_is_what_the_library_trains(registered: Any) -> None:
    """Nothing is between SB3's algorithm and the env but the reset before each rollout, in which no episode is cut here."""
    env, own = (make_task_vec_env(ENV_ID, 4, seed=0) for _ in range(2))
    theirs = PPO("MlpPolicy", env, seed=0, **copy.deepcopy(SMALL)).learn(160)
    ours = registered.PlainPPO("MlpPolicy", own, seed=0, **copy.deepcopy(SMALL)).learn(160)
    assert all(th.equal(value, ours.policy.state_dict()[name]) for name, value in theirs.policy.state_dict().items())
    returns, _ = evaluate_adaptation(ours, ENV_ID, n_episodes=2)
    np.testing.assert_array_equal(returns[:, 0], returns[:, 1], "it does not adapt")
    # Also where it trained, as its observations are those of the env
    assert evaluate_adaptation(ours, own, n_episodes=1)[0].shape == (100, 1)


def test_its_experiment_has_the_runs_of_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "made").mkdir()
    rivals = grid.EXPERIMENTS["rivals"]
    report.write("", rivals, made_up(rivals.cells(), tmp_path / "made"), tmp_path / "published")
    given = ["--gym-packages", MODULE, "--with-results", "published", "--finished"]
    assert main(["experiment", "plain_ppo", *given]) == 0
    rows = json.loads(Path("results", "plain_ppo", "summary.json").read_text())["rows"]
    assert {row["variant"] for row in rows} == {variant.name or variant.method for variant in rivals.variants}


class OwnTD3(OffPolicyRival, TD3):
    """TD3 that is not told its task."""

    DEFAULT_POLICY = "MlpPolicy"

    def _adaptation(self, n_envs: int, generator: th.Generator | None) -> Any:
        return importlib.import_module(MODULE).Unadapted(self.policy, n_envs)


def own_td3(env: VecEnv | None = None, **kwargs: Any) -> OwnTD3:
    env = env or make_task_vec_env(ENV_ID, 4, seed=0)
    settings = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 100, "batch_size": 8, "gradient_steps": 2}
    return OwnTD3("MlpPolicy", env, seed=0, **{**settings, **kwargs})


def test_an_off_policy_rival_sees_whole_episodes_and_goes_on_exactly(tmp_path: Path) -> None:
    """Its replay is in its checkpoints, also where it has begun anew."""
    unbroken = own_td3(buffer_size=600).learn(960)
    assert unbroken.replay_buffer is not None and unbroken.replay_buffer.full
    # 150 of 240 steps of each env are kept, with seven or eight ends of episodes among them
    assert unbroken.replay_buffer.dones.sum() in (28, 32)
    assert np.abs(unbroken.replay_buffer.observations).max() > 0.3
    state = copy.deepcopy(own_td3(buffer_size=600).learn(480).state_dict())
    second = own_td3(buffer_size=600)
    second.load_state_dict(state)
    second.learn(480, reset_num_timesteps=False)
    assert all(th.equal(value, second.policy.state_dict()[name]) for name, value in unbroken.policy.state_dict().items())
    unbroken.save(tmp_path / "model.zip")
    record = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [4]}}
    loaded = load_untrusted(OwnTD3, tmp_path / "model.zip", record, gym.make(ENV_ID), "cpu")
    ours, theirs = (evaluate_adaptation(model, ENV_ID, n_episodes=1)[0] for model in (unbroken, loaded))
    np.testing.assert_array_equal(ours, theirs)
    wider = gym.wrappers.RescaleAction(gym.make(ENV_ID), np.float32(-3), np.float32(3))
    with pytest.raises(ValueError, match=r"^Action spaces do not match: Box\(-3\.0, 3\.0"):
        load_untrusted(OwnTD3, tmp_path / "model.zip", record, wider, "cpu")
    with pytest.raises(ValueError, match="OwnTD3 has no setting 'train_freq': a rollout is an episode of each env"):
        own_td3(train_freq=1)


def test_a_training_without_an_update_says_so() -> None:
    with pytest.warns(
        UserWarning, match="Nothing was learnt: learning begins after 1000 env steps, at the end of a rollout, and this"
    ):
        own_td3(learning_starts=1000).learn(160)


class EndsEarly(gym.Wrapper):
    """After 13 of 20 steps."""

    def reset(self, **kwargs: Any) -> Any:
        self.n_steps = 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        self.n_steps += 1
        return obs, reward, self.n_steps == 13, truncated, info


def ends_early() -> VecEnv:
    return make_task_vec_env(ENV_ID, 2, seed=0, wrapper=EndsEarly)


def test_returns_of_several_steps_end_where_a_rollout_does() -> None:
    """The reset that begins the next one cuts episodes short."""
    model = OwnSAC("MlpPolicy", ends_early(), seed=0, n_steps=3, learning_starts=0, policy_kwargs={"net_arch": [4]}).learn(80)
    buffer = model.replay_buffer
    assert buffer is not None and not buffer.dones[18].any() and buffer.dones[12].all() and not buffer.timeouts[12].any()
    assert (buffer.next_observations[19] != buffer.observations[20]).any()
    for start in (18, 19):
        sample = buffer._get_samples(np.array([start]))
        assert any(np.array_equal(sample.next_observations[0], last) for last in buffer.next_observations[19])
        assert sample.dones.item() == 0, "a longer episode would have gone on"


def test_noise_with_a_memory_goes_on_exactly() -> None:
    def make() -> OwnTD3:
        noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
        return own_td3(env=ends_early(), action_noise=noise, learning_starts=0)

    unbroken = make().learn(160)
    state = copy.deepcopy(make().learn(80).state_dict())
    second = make()
    second.load_state_dict(state)
    second.learn(80, reset_num_timesteps=False)
    assert all(th.equal(value, second.policy.state_dict()[name]) for name, value in unbroken.policy.state_dict().items())


def test_training_is_on_training_tasks_after_an_evaluation_in_the_same_env(registered: Any) -> None:
    for make in (own_td3, lambda: registered.PlainPPO("MlpPolicy", make_task_vec_env(ENV_ID, 4, seed=0), **SMALL)):
        model, seen = make(), set[int]()
        env = model.get_env()
        assert env is not None
        evaluate_adaptation(model, env, "validation", n_episodes=1)

        def look(local: dict[str, Any], _: Any, seen: set[int] = seen) -> bool:
            seen.update(info["task_id"] for info in local["infos"])
            return True

        model.learn(160, look)
        assert len(seen) > 1 and -1 not in seen


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), "has no task_family"),
        (lambda: VecNormalize(make_task_vec_env(ENV_ID, 2)), "VecNormalize stands between the env"),
    ],
)
def test_envs_that_cannot_be_meta_trained_on_are_refused(env: Any, message: str, registered: Any) -> None:
    for rival in (registered.PlainPPO, OwnTD3):
        with pytest.raises(ValueError, match=message):
            rival("MlpPolicy", env())
        model = rival("MlpPolicy", make_task_vec_env(ENV_ID, 2))
        with pytest.raises(ValueError, match=message):
            model.set_env(env())


def test_what_would_not_go_on_exactly_is_refused(registered: Any) -> None:
    for rival in (registered.PlainPPO, OwnSAC, RL2):
        with pytest.raises(ValueError, match="has no setting 'use_sde': its noise is drawn before a rollout, and"):
            rival(rival.DEFAULT_POLICY, ENV_ID, use_sde=True)


class OwnSAC(OffPolicyRival, SAC):
    """Of a library's class that adds to the settings of its policy."""

    DEFAULT_POLICY = "MlpPolicy"
    _adaptation = OwnTD3._adaptation


@pytest.mark.parametrize("kind", [OwnSAC, RL2])
def test_settings_that_were_given_stay_as_they_are(kind: Any, tmp_path: Path) -> None:
    given: dict[str, Any] = {"net_arch": [4]}
    model = kind(kind.DEFAULT_POLICY, ENV_ID, policy_kwargs=given)
    assert given == {"net_arch": [4]}
    given["net_arch"] = [8]
    model.save(tmp_path / "model")
    assert kind.load(tmp_path / "model").policy_kwargs["net_arch"] == [4]


def test_actions_that_are_not_scaled_are_refused(registered: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registered.Unadapted, "act", lambda adaptation, obs, deterministic: np.full((len(obs), 2), 3.0))
    with pytest.raises(
        ValueError, match=r"The actions of env 0 are \[3\. 3\.\], expected numbers from -1 to 1: .* policy\.scale_action"
    ):
        evaluate_adaptation(registered.PlainPPO("MlpPolicy", ENV_ID), ENV_ID, n_episodes=1)


def test_an_adaptation_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OwnTD3, "_adaptation", lambda self, n_envs, generator: None)
    with pytest.raises(ValueError, match="_adaptation of OwnTD3 returned None, expected act, observe"):
        evaluate_adaptation(own_td3(), ENV_ID, n_episodes=1)


def test_rollouts_without_the_end_of_an_episode_are_refused(registered: Any) -> None:
    with pytest.raises(ValueError, match="n_steps is 8, and episodes have up to 20 steps: give it as many or more"):
        registered.PlainPPO("MlpPolicy", ENV_ID, n_steps=8)


@pytest.mark.parametrize("log_interval", [None, 3])
def test_logs_are_so_many_rollouts_apart(log_interval: int | None, registered: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for make in (own_td3, lambda: registered.PlainPPO("MlpPolicy", make_task_vec_env(ENV_ID, 2, seed=0), **SMALL)):
        logged: list[int] = []
        monkeypatch.setattr(Logger, "dump", lambda logger, step=0, logged=logged: logged.append(step))
        make().learn(480, log_interval=log_interval)
        assert logged == ([] if log_interval is None else [240, 480])


def test_what_could_not_be_evaluated_is_not_trained(registered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Models of experiments are loaded as those of strangers are."""
    monkeypatch.setattr("sb3_htr.experiments.runner.train.main", None)
    variant = Variant("plain-ppo", settings={"policy_kwargs": {"latent_dim": 5}})
    (cell,) = Experiment("one", "", ENV_ID, 480, (variant,), 1).cells()
    message = (
        r"-seed1 could not be evaluated: its policy has latent_dim: 5, .* unless POLICY_SIZES of PlainPPO names it.* Leave"
    )
    with pytest.raises(ValueError, match=message):
        run_cell(cell, tmp_path)
    monkeypatch.setattr(registered.PlainPPO, "POLICY_SIZES", {"latent_dim": 8})
    with pytest.raises(TypeError, match="NoneType"):
        run_cell(cell, tmp_path)


def test_what_it_acts_by_is_exported(registered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registered.PlainPPO, "KEPT_TO_ACT", ("gain",))
    model = registered.PlainPPO("MlpPolicy", ENV_ID, **SMALL)
    model.gain, model.loss = 0.5, 2.0
    model.save(tmp_path / "model.zip")
    record = {"method": "plain-ppo", "env_id": ENV_ID, "env_kwargs": {}, "seed": 0, "gym_packages": [MODULE]}
    export(TrainedAgent(tmp_path / "model.zip", record, None, trusted=True), tmp_path / "exported.zip")
    loaded = registered.PlainPPO.load(tmp_path / "exported.zip")
    assert loaded.gain == 0.5 and not hasattr(loaded, "loss")


def test_a_model_of_a_method_that_is_not_known_says_so(registered: Any, tmp_path: Path) -> None:
    registered.PlainPPO("MlpPolicy", ENV_ID).save(tmp_path / "model.zip")
    record = {"method": "unheard-of", "env_id": ENV_ID, "env_kwargs": {}, "hyperparams": {}}
    with pytest.raises(ValueError, match="Nobody has registered the method 'unheard-of': is it of a module of yours"):
        TrainedAgent(tmp_path / "model.zip", record, None).load()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"name": "rl2"}, "There is an algorithm 'rl2' already"),
        ({"name": "my ppo"}, "The name of the algorithm is 'my ppo', expected one that can be the name of a folder"),
        ({"model_class": PPO}, r"PPO is no subclass of PEARL, sb3_htr\.rivals\.on_policy\.OnPolicyRival or"),
        (
            {"model_class": type("Bare", (OnPolicyRival, PPO), {"_adaptation": None})},
            "Bare is not whole: it needs a DEFAULT_POLICY",
        ),
        ({"model_class": type("Mute", (OnPolicyRival, PPO), {"DEFAULT_POLICY": "MlpPolicy"})}, "Mute is not whole"),
        ({"model_class": type("Turned", (PPO, OnPolicyRival), {})}, "Turned has PPO before its mixin: class Mine"),
        (
            {"model_class": type("Script", (RL2,), {"__module__": "__main__"})},
            "Script is in a script, which nobody can",
        ),
        ({"model_class": type("Inner", (RL2,), {"__qualname__": "outer.<locals>.Inner"})}, "put the class at the top"),
        ({"settings": "nowhere.yml"}, r"There is no file nowhere\.yml: did you mean"),
    ],
)
def test_what_is_no_algorithm(changed: dict[str, Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yml").write_text("default: {}\n")
    whole: dict[str, Any] = {"name": "mine", "model_class": RL2, "settings": tmp_path / "mine.yml", "about": "It is mine."}
    before = dict(algorithm.ALGORITHMS)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        algorithm.register_algorithm(**{**whole, **changed})
    assert before == algorithm.ALGORITHMS
    algorithm.register_algorithm(**whole)
    assert algorithm.ALGORITHMS["mine"].model_class is RL2
