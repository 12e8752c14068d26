"""Evaluation during training."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import ENV_ID, ROLLOUT, MakePEARL, with_policy
from helpers.disks import half_written
from htr_envs import PointRobotFamily
from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.adaptation import MetaEvalCallback
from sb3_htr.adaptation.evaluation import AdaptationRecord
from sb3_htr.common.vec_env import make_task_vec_env


def test_meta_eval_logs_keeps_the_best_and_writes_npz(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    env = make_task_vec_env(ENV_ID, 20)
    callback = MetaEvalCallback(
        env, eval_freq=50, log_path=str(tmp_path), best_model_save_path=str(tmp_path), n_eval_episodes=3, verbose=0
    )
    model = tiny_pearl().learn(3 * ROLLOUT, callback=callback)
    data = np.load(tmp_path / "evaluations.npz")
    assert data["timesteps"].tolist() == [200, 400, 600]
    assert data["returns"].shape == data["successes"].shape == (3, 20, 3)
    np.testing.assert_array_equal(data["results"], data["returns"][:, :, -1])
    assert callback.best_mean_reward == data["results"].mean(axis=1).max()
    best = PEARL.load(tmp_path / "best_model")
    returns, _ = evaluate_adaptation(best, env, PointRobotFamily().validation_tasks, n_episodes=3)
    assert returns[:, -1].mean() == callback.best_mean_reward
    assert model.num_timesteps == 3 * ROLLOUT


def test_the_best_model_waits_for_room(tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a checkpoint; a worse one does not take its place."""
    import sb3_htr.adaptation.callbacks as module

    scores, save = iter((5.0, 3.0, 2.0)), dict[str, Any](best_model_save_path=str(tmp_path))
    path = tmp_path / "best_model.zip"

    def scripted(*_: Any, **__: Any) -> AdaptationRecord:
        return AdaptationRecord(np.full((20, 1), next(scores)), np.zeros((20, 1), bool), np.zeros((20, 1, 1, 2)))

    def full(*_: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "record_adaptation", scripted)
    first, then, last = (MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=1, verbose=0, **save) for _ in range(3))
    model = tiny_pearl()
    with monkeypatch.context() as patch:
        patch.setattr("sb3_htr.common.atomic.os.replace", full)
        with pytest.warns(UserWarning, match=r"best_model\.zip could not be written \(No space .*Training goes on"):
            model.learn(ROLLOUT, first)
    assert not path.exists()
    then.load_state_dict(first.state_dict())
    model.learn(ROLLOUT, then, reset_num_timesteps=False)
    assert PEARL.load(path).num_timesteps == ROLLOUT and then.best_mean_reward == 5.0
    written = path.stat().st_mtime_ns
    last.load_state_dict(then.state_dict())
    model.learn(ROLLOUT, last, reset_num_timesteps=False)
    assert path.stat().st_mtime_ns == written, "once"


@pytest.mark.parametrize("damage", [None, b"half"])
def test_a_best_model_that_is_gone_is_told_of_when_a_training_goes_on(
    damage: bytes | None, tiny_pearl: MakePEARL, tmp_path: Path
) -> None:
    before, after = (
        MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=1, verbose=0, best_model_save_path=str(tmp_path))
        for _ in range(2)
    )
    after.load_state_dict(before.state_dict())  # there is none yet
    tiny_pearl().learn(ROLLOUT, before)
    after.load_state_dict(before.state_dict())
    path = tmp_path / "best_model.zip"
    path.unlink() if damage is None else path.write_bytes(damage)
    with pytest.warns(UserWarning, match=rf"{path}, the best model so far, is missing or damaged"):
        after.load_state_dict(before.state_dict())


def test_a_training_shorter_than_the_time_between_evaluations_is_evaluated_at_its_end(
    tiny_pearl: MakePEARL, tmp_path: Path
) -> None:
    """Once, after its last update."""
    callback = MetaEvalCallback(
        make_task_vec_env(ENV_ID, 20), eval_freq=10_000, log_path=str(tmp_path), best_model_save_path=str(tmp_path), verbose=0
    )
    model = tiny_pearl().learn(ROLLOUT, callback=callback)
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [ROLLOUT]
    assert PEARL.load(tmp_path / "best_model")._n_updates == model._n_updates > 0
    callback.on_training_end()
    assert len(callback.returns) == 1


def test_evaluations_of_another_shape_are_refused_and_no_full_disk(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    def callback(n_eval_episodes: int) -> MetaEvalCallback:
        return MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=n_eval_episodes, log_path=str(tmp_path), verbose=0)

    begun = callback(2)
    tiny_pearl().learn(ROLLOUT, callback=begun)
    callback(2).load_state_dict(begun.state_dict())
    with pytest.raises(ValueError, match="begun with evaluations of 2 episodes on 20 tasks, and this callback has 3 on 20"):
        callback(3).load_state_dict(begun.state_dict())


def test_the_last_evaluation_is_written_at_the_end_if_it_could_not_be_before(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    callback = MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=1, log_path=str(tmp_path), verbose=0)
    save, broken = np.savez_compressed, iter((False, True))

    def save_if_possible(*args: Any, **kwargs: Any) -> None:
        if next(broken, False):
            raise OSError(28, "No space left on device")
        save(*args, **kwargs)

    monkeypatch.setattr(np, "savez_compressed", save_if_possible)
    with pytest.warns(UserWarning, match=r"evaluations\.npz could not be written \(No space left on device\)"):
        tiny_pearl().learn(2 * ROLLOUT, callback=callback)
    assert len(np.load(tmp_path / "evaluations.npz")["timesteps"]) == len(callback.returns) == 2


@pytest.mark.parametrize("eval_freq", [10_000 / 12, float("nan"), None, "100"])
def test_evaluations_that_would_not_be_due_are_refused_before_the_training(eval_freq: Any) -> None:
    with pytest.raises(ValueError, match=r"eval_freq is .*, expected a "):
        MetaEvalCallback(ENV_ID, eval_freq=eval_freq)
    assert MetaEvalCallback(ENV_ID, eval_freq=10_000 / 20).eval_freq == 500


def test_an_evaluation_without_episodes_is_refused_before_the_training() -> None:
    with pytest.raises(ValueError, match="n_eval_episodes is 0, expected a whole number of at least 1"):
        MetaEvalCallback(ENV_ID, n_eval_episodes=0)


def test_meta_eval_is_on_validation_tasks_unless_told(tmp_path: Path) -> None:
    env, family = make_task_vec_env(ENV_ID, 2), PointRobotFamily()
    assert (MetaEvalCallback(env).tasks == family.validation_tasks).all()
    assert (MetaEvalCallback(env, tasks="test").tasks == family.test_tasks).all()
    with pytest.raises(ValueError, match="tasks is 'tset'"):
        MetaEvalCallback(env, tasks="tset")


def test_meta_eval_explores_as_it_is_told(tiny_pearl: MakePEARL) -> None:
    env, prior = make_task_vec_env(ENV_ID, 20), {"name": "prior", "n_exploration_episodes": 9}
    # Otherwise what observations are normalized by follows the rollout, at whose last step the callback comes
    model = tiny_pearl(learning_starts=1000, policy_kwargs=with_policy(normalize_observations=False))
    callback = MetaEvalCallback(env, explorer=prior, eval_freq=60, n_eval_episodes=2, verbose=0)
    model.learn(ROLLOUT, callback=callback)
    expected, _ = evaluate_adaptation(model, env, callback.tasks, n_episodes=2, explorer=prior)
    np.testing.assert_array_equal(callback.returns[0], expected)
    # Before anything is trained
    with pytest.raises(ValueError, match="explorer is 'nobody', expected one of"):
        MetaEvalCallback(env, explorer="nobody")


def test_evaluations_that_are_half_written_leave_those_before(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    callback = MetaEvalCallback(ENV_ID, eval_freq=60, n_eval_episodes=1, log_path=str(tmp_path), verbose=0)
    tiny_pearl().learn(ROLLOUT, callback)
    monkeypatch.setattr(np, "savez_compressed", half_written)
    with pytest.raises(KeyboardInterrupt):
        tiny_pearl().learn(ROLLOUT, callback)
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [ROLLOUT]


def test_a_best_model_that_could_not_be_written_is_not_the_best(
    tiny_pearl: MakePEARL, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    callback = MetaEvalCallback(
        make_task_vec_env(ENV_ID, 20), eval_freq=60, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0
    )
    model = tiny_pearl()
    save, paths = type(model).save, []

    def failing_once(self: PEARL, path: Path) -> None:
        paths.append(path)
        if len(paths) == 1:
            raise OSError(28, "No space left on device")
        save(self, path)

    monkeypatch.setattr(type(model), "save", failing_once)
    with pytest.warns(UserWarning, match=r"best_model\.zip could not be written"):
        model.learn(3 * ROLLOUT, callback=callback)
    assert len(paths) >= 2 and (tmp_path / "best_model.zip").exists()
