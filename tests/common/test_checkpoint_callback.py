"""What a checkpoint can hold, it holds; what it cannot, nobody learns of when the training is to go on."""

import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.figure
import numpy as np
import pytest
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.logger import Figure, HParam
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers import ENV_ID, ROLLOUT, MakePEARL
from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checkpoint import checkpoints, load_latest
from sb3_htr.common.checkpoint_callback import CheckpointCallback, numbers_of, restore_numbers
from sb3_htr.common.vec_env import make_task_vec_env


class Records(BaseCallback):
    """All that SB3's logger takes."""

    def _on_step(self) -> bool:
        figure = matplotlib.figure.Figure()
        values = {"array": np.zeros(3), "figure": Figure(figure, close=True), "hparams": HParam({"a": 1}, {"b": 2.0})}
        for name, value in {**values, "file": Path("file"), "mean": np.array(0.5), "number": np.float64(2.5)}.items():
            self.logger.record(name, value, exclude=("stdout", "log", "json", "csv"))
        return True


class HasNumbersOfNumpy(BaseCallback):
    def _on_step(self) -> bool:
        return True

    def state_dict(self) -> dict[str, Any]:
        return {"best": np.float64(1.0)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class Somewhere(gym.Wrapper):
    def __init__(self, env: Any, scene: Any) -> None:
        super().__init__(env)
        self.scene = scene

    def step(self, action: Any) -> Any:
        *others, info = self.env.step(action)
        return *others, {**info, "scene": self.scene}


def test_what_waits_for_the_log_does_not_spoil_a_checkpoint(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().learn(2 * ROLLOUT, [Records(), CheckpointCallback(1, str(tmp_path))], log_interval=None)
    _, state = load_latest(tmp_path)
    assert state["logger"]["name_to_value"].items() >= {"mean": 0.5, "number": 2.5}.items()
    assert state["logger"]["name_to_value"].keys() == state["logger"]["name_to_excluded"].keys()


def test_a_callback_that_cannot_be_saved_says_so_at_once(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    callback = HasNumbersOfNumpy()
    model = tiny_pearl()
    with pytest.raises(ValueError, match=r"The state_dict\(\) of HasNumbersOfNumpy cannot be saved"):
        model.learn(2 * ROLLOUT, [callback, CheckpointCallback(1, str(tmp_path), companions=[callback])])
    assert model.num_timesteps == 0


class HasNumbersOfNumpyLater(HasNumbersOfNumpy):
    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() if self.num_timesteps else {}


def test_a_state_that_cannot_be_saved_is_no_full_disk(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Training would go on for days without a checkpoint."""
    callback = HasNumbersOfNumpyLater()
    with pytest.raises(ValueError, match=r"The state_dict\(\) of HasNumbersOfNumpyLater cannot be saved"):
        tiny_pearl().learn(3 * ROLLOUT, [callback, CheckpointCallback(1, str(tmp_path), companions=[callback])])


@pytest.mark.parametrize(
    "scene", ["kitchen", np.str_("kitchen"), None, {"room": 3}, (1, "a"), 2**70, 0.1, np.float32(0.1), np.arange(2)]
)
def test_what_the_monitor_notes_goes_on(scene: Any, tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    def make() -> Any:
        return DummyVecEnv([lambda: Monitor(Somewhere(gym.make(ENV_ID), scene), info_keywords=("scene",))] * 4)

    tiny_pearl(make()).learn(2 * ROLLOUT, CheckpointCallback(1, str(tmp_path)))
    callback, model = CheckpointCallback(1, str(tmp_path)), tiny_pearl(make())
    callback.restore(model, load_latest(tmp_path)[1])
    assert len(model.ep_info_buffer or ()) == 24
    for info in model.ep_info_buffer or ():
        np.testing.assert_equal(info["scene"], scene, strict=True)


def test_a_training_goes_on_with_as_many_envs(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    tiny_pearl().learn(ROLLOUT, CheckpointCallback(1, str(tmp_path)))
    callback, model = CheckpointCallback(1, str(tmp_path)), tiny_pearl(make_task_vec_env(ENV_ID, 2))
    callback.restore(model, load_latest(tmp_path)[1])
    with pytest.raises(ValueError, match="The training had 4 envs, and goes on with 2"):
        model.learn(ROLLOUT, callback, reset_num_timesteps=False)


def test_counts_of_callbacks_of_others_go_on(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """SB3's have no state that they would tell."""
    stopped_at = []
    for parts in ((5,), (2, 3)):
        for i, n_rollouts in enumerate(parts):
            model, stop = tiny_pearl(), StopTrainingOnMaxEpisodes(max_episodes=11)
            callback = CheckpointCallback(1, str(tmp_path / str(parts)), companions=[stop])
            if i > 0:
                callback.restore(model, load_latest(tmp_path / str(parts))[1])
            model.learn(n_rollouts * ROLLOUT, [callback, stop], reset_num_timesteps=i == 0)
        stopped_at.append(model.num_timesteps)
    assert stopped_at[0] == stopped_at[1] < 5 * ROLLOUT
    # A file of a stranger changes numbers, and nothing else
    restore_numbers(stop, {"n_episodes": 3, "max_episodes": "many", "_on_step": 1, "model": 2})
    assert stop.n_episodes == 3 and stop.max_episodes == 11 and "_on_step" not in vars(stop) and stop.model is model


class Anneals(BaseCallback):
    """What it is made with is where it begins."""

    def __init__(self, beta: float, rate: float) -> None:
        super().__init__()
        self.beta, self.rate = beta, rate

    def _on_step(self) -> bool:
        self.beta *= self.rate
        return True


def test_what_a_callback_is_made_with_is_not_what_it_was_made_with_once(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Only what it has counted and changed goes on."""
    before: list[BaseCallback] = [StopTrainingOnMaxEpisodes(100, verbose=1), Anneals(1.0, 0.99)]
    tiny_pearl().learn(ROLLOUT, [*before, CheckpointCallback(1, str(tmp_path), companions=before)])
    stop, anneals = StopTrainingOnMaxEpisodes(500), Anneals(1.0, 0.5)
    CheckpointCallback(1, str(tmp_path), companions=[stop, anneals]).restore(tiny_pearl(), load_latest(tmp_path)[1])
    assert (stop.n_episodes, stop.max_episodes, stop.verbose) == (before[0].n_episodes, 500, 0)  # type: ignore[attr-defined]
    assert anneals.beta == before[1].beta < 1.0 and anneals.rate == 0.5  # type: ignore[attr-defined]


class Highest(BaseCallback):
    """Its number is one of numpy."""

    best: float = -np.inf

    def _on_step(self) -> bool:
        self.best = np.max([self.best, *(self.locals["rewards"] if "rewards" in self.locals else [])])
        return True


def nested() -> tuple[list[BaseCallback], BaseCallback]:
    """Callbacks that call others, and these alone."""
    inner = [StopTrainingOnNoModelImprovement(max_no_improvement_evals=60), Highest(), Highest(), Highest()]
    outer = [
        MetaEvalCallback(
            ENV_ID,
            eval_freq=60,
            n_eval_episodes=1,
            verbose=0,
            callback_after_eval=CallbackList([inner[0]]),
            callback_on_new_best=inner[1],
        ),
        EveryNTimesteps(100, inner[2]),
        CallbackList([inner[3]]),
    ]
    return inner, CallbackList(outer)


def test_numbers_of_callbacks_within_others_go_on(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    (inner, outer), model = nested(), tiny_pearl(learning_rate=0.0)
    model.learn(3 * ROLLOUT, [outer, CheckpointCallback(1, str(tmp_path), companions=[outer])])
    (again, outer), model = nested(), tiny_pearl(learning_rate=0.0)
    CheckpointCallback(1, str(tmp_path), companions=[outer]).restore(model, load_latest(tmp_path)[1])
    assert [numbers_of(callback) for callback in again] == [numbers_of(callback) for callback in inner]
    assert all(callback.n_calls > 0 for callback in again)
    assert again[3].best == inner[3].best > -np.inf  # type: ignore[attr-defined]


def test_a_state_sets_what_goes_on_and_nothing_else(tiny_pearl: MakePEARL) -> None:
    model = tiny_pearl()
    state = model.state_dict()
    state["counters"] |= {"gamma": 0.0, "num_timesteps": 480}
    model.load_state_dict(state)
    assert model.num_timesteps == 480 and model.gamma == 0.9


def test_within_another_callback_it_would_save_nothing(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    within = EveryNTimesteps(ROLLOUT, CheckpointCallback(1, str(tmp_path)))
    with pytest.raises(ValueError, match=r"within EveryNTimesteps hears nothing of rollouts.*pass it beside that one"):
        tiny_pearl().learn(ROLLOUT, within)


def test_a_training_after_one_that_was_stopped_is_none_that_was(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    model, callback = tiny_pearl(), CheckpointCallback(1, str(tmp_path))
    callback.stop()
    model.learn(3 * ROLLOUT, callback)
    stopped = model.num_timesteps
    model.learn(2 * ROLLOUT, callback, reset_num_timesteps=False)
    assert stopped <= ROLLOUT and model.num_timesteps >= stopped + 2 * ROLLOUT


def test_some_checkpoints_are_kept() -> None:
    with pytest.raises(ValueError, match="keep is 0, expected a whole number of at least 1"):
        CheckpointCallback(1, "run", keep=0)
    for save_freq in (-1, 0, None):
        with pytest.raises(ValueError, match=f"save_freq is {save_freq}, expected a number of at least 1"):
            CheckpointCallback(save_freq, "run")  # type: ignore[arg-type]


def damage_all_but(n_whole: int, run: Path) -> None:
    for folder in checkpoints(run)[:-n_whole]:
        shutil.rmtree(folder)
        folder.mkdir()


def test_the_checkpoint_just_written_is_kept(tiny_pearl: MakePEARL, tmp_path: Path) -> None:
    """Behind a later one that is damaged, from which nothing could go on."""
    tiny_pearl().learn(4 * ROLLOUT, CheckpointCallback(1, str(tmp_path), keep=4))
    damage_all_but(2, tmp_path)
    callback, model = CheckpointCallback(ROLLOUT // 4, str(tmp_path), keep=1), tiny_pearl()
    with pytest.warns(UserWarning, match="next older checkpoint"):
        callback.restore(model, load_latest(tmp_path)[1])
    model.learn(ROLLOUT, callback, reset_num_timesteps=False)
    with pytest.warns(UserWarning, match="next older checkpoint"):
        assert load_latest(tmp_path)[0].name == f"{3 * ROLLOUT}_steps"


def test_the_checkpoint_that_a_training_went_on_from_is_kept_until_there_is_another(
    tiny_pearl: MakePEARL, tmp_path: Path
) -> None:
    """Also where the training ends before."""
    tiny_pearl().learn(3 * ROLLOUT, CheckpointCallback(1, str(tmp_path), keep=3))
    damage_all_but(1, tmp_path)
    callback, model = CheckpointCallback(1, str(tmp_path)), tiny_pearl()
    with pytest.warns(UserWarning, match="next older checkpoint"):
        callback.restore(model, load_latest(tmp_path)[1])
    model.learn(ROLLOUT, [callback, ConvertCallback(lambda *_: False)], reset_num_timesteps=False)
    with pytest.warns(UserWarning, match="next older checkpoint"):
        assert load_latest(tmp_path)[0].name == f"{ROLLOUT}_steps"
