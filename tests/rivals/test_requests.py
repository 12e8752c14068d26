"""What a user may ask of a rival by mistake is refused in one sentence, before any work is lost."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from stable_baselines3.her import GoalSelectionStrategy

from helpers import ENV_ID
from sb3_htr import evaluate_adaptation
from sb3_htr.adaptation.adaptation import Step
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.divergence import DivergedError
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.rivals.rl2 import RL2
from sb3_htr.rivals.sac_her import SACHER

RIVALS = pytest.mark.parametrize("kind", [RL2, SACHER])
SMALL: dict[Any, dict[str, Any]] = {
    RL2: {"n_trials_per_rollout": 1, "policy_kwargs": {"lstm_hidden_size": 4}},
    SACHER: {"buffer_size": 2000, "policy_kwargs": {"net_arch": [4]}},
}


def small(kind: Any, env: Any = None, **settings: Any) -> Any:
    """A model of two envs unless given others."""
    return kind(kind.DEFAULT_POLICY, make_task_vec_env(ENV_ID, 2, 0) if env is None else env, **SMALL[kind] | settings)


@RIVALS
def test_a_model_needs_an_env_for_its_networks(kind: Any) -> None:
    with pytest.raises(ValueError, match=f"{kind.__name__} has no env to make its networks for: pass one, or the id"):
        kind(kind.DEFAULT_POLICY, None)


@RIVALS
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gama": 0.9}, "has no setting 'gama': did you mean gamma"),
        ({"policy_kwargs": {"net_arc": [8]}}, "policy_kwargs has no setting 'net_arc': did you mean net_arch"),
        ({"seed": -1}, "seed is -1, expected a whole number"),
        ({"device": "gpu"}, "The device 'gpu' cannot be used: give cpu, cuda"),
        ({"gamma": 1.5}, "gamma is 1.5, expected a number from 0 to 1"),
        ({"gamma": "x"}, "gamma is 'x', expected a number"),
        ({"learning_rate": -1e-3}, "learning_rate is -0.001, expected a number of at least 0"),
        ({"ent_coef": -1.0}, "ent_coef is -1.0, expected a number of at least 0"),
        ({"batch_size": 0}, "batch_size is 0, expected a whole number of at least 1"),
        ({"stats_window_size": 0}, "stats_window_size is 0, expected a whole number of at least 1"),
        ({"sde_sample_freq": 4}, "has no setting 'sde_sample_freq': it is of use_sde"),
        ({"policy_kwargs": {"net_arch": "x"}}, r"net_arch is 'x', expected the hidden units of each layer"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": [8, 0]}}}, r"qf is \[8, 0\], expected the hidden units"),
    ],
)
def test_settings(kind: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(kind.DEFAULT_POLICY, ENV_ID, **settings)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (RL2, {"gamma": 7.0}, "gamma is 7.0, expected a number from 0 to 1"),
        (RL2, {"n_episodes_per_trial": -3}, "n_episodes_per_trial is -3, expected a whole number of at least 1"),
        (RL2, {"n_trials_per_rollout": 0}, "n_trials_per_rollout is 0, expected a whole number of at least 1"),
        (RL2, {"batch_size": 1}, "batch_size is 1, and a rollout has 200 steps"),
        (RL2, {"clip_range_vf": 0.0}, r"clip_range_vf is 0\.0, which keeps networks from learning: expected a number above 0"),
        (RL2, {"target_kl": -1}, "target_kl is -1, expected a number of at least 0"),
        (RL2, {"target_kl": 0}, "target_kl is 0, which keeps networks from learning"),
        (SACHER, {"tau": 0}, "tau is 0, which keeps networks from learning"),
        (SACHER, {"gamma": 7.0}, "gamma is 7.0, expected a number from 0 to 1"),
        (SACHER, {"buffer_size": 0}, "buffer_size is 0, expected a whole number of at least 1"),
        (SACHER, {"gradient_steps": -2}, "gradient_steps is -2, expected a whole number of at least -1"),
        (SACHER, {"replay_buffer_kwargs": {"n_sampled_goal": -1}}, "n_sampled_goal is -1, expected a whole number"),
    ],
)
def test_settings_that_load_is_given(kind: Any, settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    small(kind).save(tmp_path / "model")
    for env in (None, make_task_vec_env(ENV_ID, 2)):
        with pytest.raises(ValueError, match=message):
            kind.load(tmp_path / "model", env=env, **settings)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (RL2, {"target_kl": "x"}, "target_kl is 'x', expected a number"),
        (RL2, {"ent_coef": "auto"}, "ent_coef is 'auto', expected a number"),
        (RL2, {"policy_kwargs": {"lstm_hidden_size": -1}}, "lstm_hidden_size is -1, expected a whole number of at least 1"),
        (RL2, {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [8]}}}, "net_arch is .*, expected layers for 'pi' and 'vf'"),
        (RL2, {"policy_kwargs": {"n_lstm_layers": 0}}, "n_lstm_layers is 0, expected a whole number of at least 1"),
        (SACHER, {"policy_kwargs": {"n_critics": 0}}, "n_critics is 0, expected a whole number of at least 1"),
        (SACHER, {"ent_coef": "1e-3"}, "ent_coef is the text '1e-3', expected a number"),
        (SACHER, {"ent_coef": "auto_x"}, "ent_coef is the text 'auto_x', expected a number"),
        (SACHER, {"target_entropy": "x"}, "target_entropy is 'x', expected a number"),
    ],
)
def test_settings_of_one(kind: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(kind.DEFAULT_POLICY, ENV_ID, **settings)


@RIVALS
def test_a_window_may_be_a_number_of_numpy(kind: Any) -> None:
    model = small(kind, stats_window_size=np.int64(3)).learn(40)
    assert model.ep_info_buffer.maxlen == 3


def test_an_entropy_coefficient_may_be_learnt() -> None:
    model = small(SACHER, ent_coef="auto_0.1", target_entropy="auto")
    assert model.target_entropy == -2 and model.log_ent_coef.exp().item() == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["train_freq", "optimize_memory_usage", "replay_buffer_class", "n_steps"])
def test_what_follows_is_no_setting(name: str, tmp_path: Path) -> None:
    given: dict[str, Any] = {name: True}
    with pytest.raises(ValueError, match=f"SACHER has no setting '{name}': .*(episode of each env|HER's)"):
        SACHER("MultiInputPolicy", ENV_ID, **given)
    small(SACHER).save(tmp_path / "model")
    with pytest.raises(ValueError, match=f"SACHER has no setting '{name}'"):
        SACHER.load(tmp_path / "model", **given)


def test_models_that_share_an_env_have_trials_of_their_own(tmp_path: Path) -> None:
    first = RL2("MlpLstmPolicy", make_task_vec_env(ENV_ID, 2, 0), n_episodes_per_trial=2, n_trials_per_rollout=1)
    first.save(tmp_path / "model")
    again = RL2.load(tmp_path / "model", env=first.get_env())
    other = RL2("MlpLstmPolicy", first.get_env(), n_trials_per_rollout=1)
    for model, n in ((first, 2), (again, 2), (other, 5)):
        assert model.env is not None and model.env.n_episodes == n and model.n_steps == 20 * n
    before = again.env
    with pytest.raises(ValueError, match="give an env of the same time limit"):
        again.set_env(make_task_vec_env(ENV_ID, 2, env_kwargs={"max_episode_steps": 10}))
    assert again.env is before
    env = other.get_env()
    assert env is not None
    first.set_env(env)
    assert first.env is not None and first.env.n_episodes == 2 and other.env is not None and other.env.n_episodes == 5
    first.learn(80)
    other.learn(200)


@RIVALS
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"dones": 0}, r"dones have shape \(\), expected \(1,\), a row for each env"),
        ({"rewards": np.zeros((1, 1))}, r"rewards have shape \(1, 1\), expected \(1,\)"),
        ({"observations": np.zeros(2)}, r"observations have shape \(2,\), expected \(1, 2\)"),
        ({"next_observations": np.full((1, 2), np.nan)}, "next_observations of env 0 are .*expected finite numbers"),
    ],
)
def test_steps_that_are_not_whole_are_no_experience(kind: Any, changed: dict[str, Any], message: str) -> None:
    model = small(kind)
    step = Step(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2)), np.zeros(1, dtype=bool))
    model.start_adaptation(1).observe(step)
    with pytest.raises(ValueError, match=message):
        model.start_adaptation(1).observe(step._replace(**changed))


@RIVALS
def test_an_adaptation_has_a_task(kind: Any) -> None:
    model = small(kind)
    with pytest.raises(ValueError, match="n_envs is 0, expected a whole number of at least 1"):
        model.start_adaptation(0)


@RIVALS
@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (np.zeros((2, 2)), r"The observations have shape \(2, 2\), expected \(3, 2\), a row for each env"),
        (np.full((3, 2), np.nan), "The observations of env 0 are .*expected finite numbers"),
    ],
)
def test_no_action_follows_from_nothing(kind: Any, obs: np.ndarray, message: str) -> None:
    adaptation = small(kind).start_adaptation(3)
    if kind is SACHER:
        adaptation.see_tasks(np.zeros((3, 2), dtype=np.float32))
    with pytest.raises(ValueError, match=message):
        adaptation.act(obs)


@RIVALS
def test_settings_that_follow_are_not_suggested(kind: Any) -> None:
    with pytest.raises(ValueError, match="has no setting 'foo': expected one of") as error:
        kind(kind.DEFAULT_POLICY, ENV_ID, foo=1)
    assert not any(repr(name) in str(error.value) for name in (*kind.FOLLOWS, "_init_setup_model"))


def test_a_replay_shorter_than_a_rollout() -> None:
    model = small(SACHER, buffer_size=39)
    with pytest.raises(ValueError, match="buffer_size is 39, and a rollout has 40 steps"):
        model.learn(400)
    assert model.num_timesteps == 0


def test_who_is_told_the_tasks_must_be() -> None:
    model = small(SACHER)
    with pytest.raises(ValueError, match="call see_tasks"):
        model.start_adaptation(1).act(np.zeros((1, 2)))
    assert not model.start_adaptation(1).exploring().any()


class Broken(VecEnvWrapper):
    """Says NaN from the third step on, of the second env; or where an episode ends."""

    def __init__(self, venv: VecEnv, what: str) -> None:
        super().__init__(venv)
        self.what, self.n_steps = what, 0

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        self.n_steps += 1
        if self.what == "last observation":
            for env in np.flatnonzero(dones):
                infos[env]["terminal_observation"] = np.full(2, np.nan, dtype=np.float32)
        elif self.n_steps >= 3:
            (rewards if self.what == "reward" else cast(np.ndarray, obs))[1] = np.nan
        return obs, rewards, dones, infos


@RIVALS
@pytest.mark.parametrize("what", ["reward", "observation"])
def test_what_is_not_finite_is_not_learnt_from(kind: Any, what: str) -> None:
    model = small(kind, Broken(make_task_vec_env(ENV_ID, 2, 0), what))
    with pytest.raises(ValueError, match=f"The {what} of env 1 is .*nan.*expected finite numbers"):
        model.learn(400)
    assert model.num_timesteps <= 6, "at the step itself"


@RIVALS
def test_nor_is_the_last_observation_of_an_episode(kind: Any) -> None:
    settings: dict[str, Any] = {"n_episodes_per_trial": 1, "n_trials_per_rollout": 2} if kind is RL2 else {}
    model = small(kind, Broken(make_task_vec_env(ENV_ID, 2, 0), "last observation"), **settings)
    with pytest.raises(ValueError, match=r"The observation of env 0 is .*nan.*expected finite numbers"):
        model.learn(400)


class Spoils(BaseCallback):
    """A weight, where a rollout ends."""

    def _on_rollout_end(self) -> None:
        next(self.model.policy.parameters()).data.view(-1)[0] = np.nan

    def _on_step(self) -> bool:
        return True


@RIVALS
def test_networks_that_diverged_end_the_training(kind: Any) -> None:
    model = small(kind, **{RL2: {"n_episodes_per_trial": 1}, SACHER: {"learning_starts": 0}}[kind])
    with pytest.raises(DivergedError, match=r"The weights .* are not finite at env step 40, update \d+: lower learning_rate"):
        model.learn(400, Spoils())


def test_settings_of_her() -> None:
    for strategy in ("futur", 3):
        with pytest.raises(ValueError, match=f"goal_selection_strategy is {strategy!r}, expected one of"):
            SACHER("MultiInputPolicy", ENV_ID, replay_buffer_kwargs={"goal_selection_strategy": strategy})
    small(SACHER, replay_buffer_kwargs={"goal_selection_strategy": GoalSelectionStrategy.FINAL})
    with pytest.raises(ValueError, match="replay_buffer_kwargs has no setting 'copy_info_dict'"):
        SACHER("MultiInputPolicy", ENV_ID, replay_buffer_kwargs={"copy_info_dict": True})
    with pytest.raises(ValueError, match="n_sampled_goal is -1, expected a whole number of at least 0"):
        SACHER("MultiInputPolicy", ENV_ID, replay_buffer_kwargs={"n_sampled_goal": -1})
    with pytest.raises(ValueError, match="replay_buffer_kwargs has no setting 'n_sampled': did you mean n_sampled_goal"):
        SACHER("MultiInputPolicy", ENV_ID, replay_buffer_kwargs={"n_sampled": 1})


@RIVALS
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda model: model.learn(-1), "total_timesteps is -1, expected a number of at least 0"),
        (lambda model: model.learn("1e6"), "total_timesteps is '1e6', expected a number"),
        (lambda model: model.learn(40, log_interval=0), "log_interval is 0, expected a whole number"),
        (lambda model: evaluate_adaptation(model, model.get_env(), n_episodes=1), "shows more than its observations"),
        (lambda model: model.predict(np.zeros((1, 2))), r"acts on .*shape \(1, 2\)\. In an env, call evaluate_adaptation"),
    ],
)
def test_calls(kind: Any, call: Callable[[Any], Any], message: str) -> None:
    model = small(kind)
    with pytest.raises(ValueError, match=message):
        call(model)
    assert model.num_timesteps == 0


@RIVALS
def test_sb3s_evaluation_is_refused_before_training(kind: Any) -> None:
    model = small(kind)
    theirs = EvalCallback(make_task_vec_env(ENV_ID, 1, 0), eval_freq=1)
    for callback in (theirs, [theirs], CallbackList([CallbackList([theirs])])):
        with pytest.raises(ValueError, match=r"does not act on the observations that EvalCallback shows it: pass .*MetaEval"):
            model.learn(40, callback)
    assert model.num_timesteps == 0
    model.learn(40, EvalCallback(model._wrap_env(make_task_vec_env(ENV_ID, 1, 0)), eval_freq=20, n_eval_episodes=1, verbose=0))
    ours = MetaEvalCallback(ENV_ID, n_eval_episodes=1, eval_freq=20, verbose=0)
    model.learn(40, ours)
    assert ours.evaluations_timesteps


class EvaluatesIn(BaseCallback):
    """Where a rollout begins, and at a step."""

    def __init__(self, env: VecEnv, step: int = 0) -> None:
        super().__init__()
        self.env, self.step = env, step

    def _on_rollout_start(self) -> None:
        tasks = get_task_family(self.env).validation_tasks[:2]
        evaluate_adaptation(cast(Any, self.model), self.env, tasks, n_episodes=1)

    def _on_step(self) -> bool:
        if self.n_calls == self.step:
            self._on_rollout_start()
        return True


@RIVALS
def test_an_evaluation_in_the_env_of_training_is_none_of_its_experience(kind: Any) -> None:
    env = make_task_vec_env(ENV_ID, 2, 0)
    model = small(kind, env)
    assert model.learn(400, EvaluatesIn(env)).num_timesteps == 400
    with pytest.raises(ValueError, match=r"task_id'\] of env 0 is -1, expected a training task: .*; give it envs of its own"):
        model.learn(400, EvaluatesIn(env, 7))
    assert model.num_timesteps == 16, "at the next step"


def test_an_evaluation_that_would_show_no_window() -> None:
    with pytest.raises(ValueError, match="An evaluation shows no window: leave render out"):
        MetaEvalCallback(ENV_ID, render=True)
