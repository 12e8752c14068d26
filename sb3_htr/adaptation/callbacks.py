"""Evaluation during meta-training."""

import io
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import ArrayLike
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.evaluation import MetaLearner, check_adapts, first_success, record_adaptation, task_set
from sb3_htr.adaptation.explorers import Explorer, to_explorer
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import check_is_env, get_task_family
from sb3_htr.common.digest import is_whole_zip
from sb3_htr.common.errors import training_goes_on
from sb3_htr.common.settings import LOWEST, check_numbers
from sb3_htr.common.vec_env import N_ENVS, make_task_vec_env


class MetaEvalCallback(EvalCallback):
    """
    Evaluates how well the agent adapts, as SB3's ``EvalCallback`` evaluates how well an agent acts.

    The score is the mean return of the last adaptation episode over the tasks. ``best_model.zip`` is chosen by it, on
    validation tasks by default, so that the test tasks stay unseen until the end. ``evaluations.npz`` has ``timesteps``
    (n,), ``results`` (n, n_tasks), the returns of the last episode, and ``returns`` and ``successes``
    (n, n_tasks, n_eval_episodes). A training that ends before its first evaluation is evaluated at its end,
    but not where another callback calls this one, as ``EveryNTimesteps`` does: give it ``eval_freq=1`` there.

    :param eval_env: env of the task family, VecEnv or registered id
    :param tasks: ``"validation"``, ``"test"``, ``"train"`` or task vectors (n_tasks, task_dim)
    :param n_eval_episodes: adaptation episodes per task (PEARL's reference for the sparse point robot: 20)
    :param explorer: an :class:`sb3_htr.adaptation.Explorer`, its name, or its name and settings; the model's own by default
    :param kwargs: arguments of SB3's ``EvalCallback``
    :raises ValueError: for settings that are none, and at the beginning of a training on this very env, or with a model that
        cannot adapt in it, or by this explorer
    """

    def __init__(
        self,
        eval_env: VecEnv | gym.Env | str,
        *,
        tasks: str | ArrayLike = "validation",
        n_eval_episodes: int = 20,
        explorer: Explorer | dict[str, Any] | str | None = None,
        **kwargs: Any,
    ) -> None:
        check_numbers(n_eval_episodes=(n_eval_episodes, 1))
        if kwargs.get("render"):
            raise ValueError("An evaluation shows no window: leave render out, and watch a saved model with `sb3-htr enjoy`.")
        if isinstance(eval_env, str):
            eval_env = make_task_vec_env(eval_env, N_ENVS)
        check_is_env(eval_env)
        super().__init__(eval_env, n_eval_episodes=n_eval_episodes, **kwargs)
        check_numbers(eval_freq=(self.eval_freq, LOWEST))
        if self.eval_freq % 1:  # as of a division: few numbers of calls, or none, are a multiple of it
            raise ValueError(f"eval_freq is {self.eval_freq}, expected a whole number of calls: round it.")
        self.tasks = task_set(get_task_family(self.eval_env), tasks)
        if explorer is not None:
            to_explorer(explorer)  # says now what is wrong with it
        # As it was given: a name means the model's own explorer where that has the name, with its settings
        self.explorer = explorer
        self.returns: list[np.ndarray] = []
        self.successes: list[np.ndarray] = []
        # File of the best model as long as it could not be written
        self._waiting = b""

    def state_dict(self) -> dict[str, Any]:
        """
        :return: results so far
        """
        return {
            "timesteps": list(self.evaluations_timesteps),
            "returns": [th.from_numpy(returns) for returns in self.returns],
            "successes": [th.from_numpy(successes) for successes in self.successes],
            "best_mean_reward": float(self.best_mean_reward),
            "waiting": th.from_numpy(np.frombuffer(self._waiting, np.uint8).copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`; that the best model is gone is warned of
        :raises ValueError: if its evaluations are of other numbers of tasks and episodes, as they go into one file
        """
        shape = len(self.tasks), self.n_eval_episodes
        for returns in state["returns"][:1]:
            if returns.shape != shape:
                (n_tasks, n_episodes), (ours, of_ours) = returns.shape, shape
                raise ValueError(
                    f"This training was begun with evaluations of {n_episodes} episodes on {n_tasks} tasks, and this callback "
                    f"has {of_ours} on {ours}: give n_eval_episodes and tasks as they were."
                )
        self.evaluations_timesteps = list(state["timesteps"])
        self.returns = [returns.numpy() for returns in state["returns"]]
        self.successes = [successes.numpy() for successes in state["successes"]]
        self.best_mean_reward = state["best_mean_reward"]
        self._waiting = state["waiting"].numpy().tobytes() if "waiting" in state else b""  # older checkpoints have none
        saved = self.best_model_save_path and self.best_mean_reward > -np.inf and not self._waiting
        if saved and not is_whole_zip(Path(self._best_model)):
            warnings.warn(
                f"{self._best_model}, the best model so far, is missing or damaged: it is written again when one is better "
                f"than its {self.best_mean_reward:.2f}.",
                stacklevel=2,
            )

    @property
    def _best_model(self) -> str:
        return f"{self.best_model_save_path}/best_model.zip"

    def _init_callback(self) -> None:
        if _share_an_env(self.eval_env, self.model.get_env()):
            raise ValueError(
                "eval_env is the env that is trained on, whose episodes an evaluation would break off: pass another."
            )
        # The first evaluation may be at the end of the training
        check_adapts(self.model)
        model = cast(MetaLearner, self.model)
        model.check_env(self.eval_env)
        model.start_adaptation(1, self.explorer, th.Generator())
        # SB3's warns where training and evaluation envs are of different types, which they may be here
        for folder in (self.best_model_save_path, self.log_path and os.path.dirname(self.log_path)):
            if folder:
                os.makedirs(folder, exist_ok=True)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(self.model)

    def _on_step(self) -> bool:
        return self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0 or self._evaluate()

    def _on_training_end(self) -> None:
        # Of a training that is shorter than the time between two evaluations, and was not interrupted
        if self.eval_freq > 0 and not self.returns and self.num_timesteps >= self.model._total_timesteps:
            self._evaluate()
        # No later one makes up for a file that could not be written
        self._write()

    def _evaluate(self) -> bool:
        """Whether training goes on."""
        record = record_adaptation(
            cast(MetaLearner, self.model),
            self.eval_env,
            self.tasks,
            self.n_eval_episodes,
            explorer=self.explorer,
            deterministic=self.deterministic,
        )
        self.evaluations_timesteps.append(self.num_timesteps)
        self.returns.append(record.returns)
        self.successes.append(record.successes)
        self._write()
        self.last_mean_reward = float(record.returns[:, -1].mean())
        self._log(record.returns, record.successes)
        continue_training = True
        if self.last_mean_reward > self.best_mean_reward:
            if self.best_model_save_path:
                with training_goes_on(self._best_model):
                    self._write_best(new=True)
            else:
                self.best_mean_reward = self.last_mean_reward
            if self.callback_on_new_best is not None:
                continue_training = self.callback_on_new_best.on_step()
        if self.callback is not None:
            continue_training = continue_training and self._on_event()
        return continue_training

    def to_write(self) -> dict[str, Callable[[], None]]:
        """
        :return: files, and what writes them, of all that a full disk may have kept from being written
        """
        results = {f"{self.log_path}.npz": self._write_results} if self.log_path and self.returns else {}
        return results | ({self._best_model: self._write_best} if self._waiting else {})

    def _write(self) -> None:
        for path, write in self.to_write().items():
            with training_goes_on(path):
                write()

    def _write_results(self) -> None:
        # Everything so far, so a file that could not be written is made up for by the next one
        returns, successes = np.stack(self.returns), np.stack(self.successes)
        steps = self.evaluations_timesteps
        with atomic_path(f"{self.log_path}.npz") as path:
            np.savez_compressed(path, timesteps=steps, results=returns[:, :, -1], returns=returns, successes=successes)

    def _write_best(self, new: bool = False) -> None:
        with atomic_path(self._best_model) as temporary:
            if new:
                # Not by a model that a wrong clock keeps from being saved at all, but by one that waits for room
                self.model.save(content := io.BytesIO())
                self._waiting, self.best_mean_reward = content.getvalue(), self.last_mean_reward
            temporary.write_bytes(self._waiting)
        self._waiting = b""

    def _log(self, returns: np.ndarray, successes: np.ndarray) -> None:
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/first_episode_return", float(returns[:, 0].mean()))
        self.logger.record("eval/success_rate", float(successes[:, -1].mean()))
        self.logger.record("eval/episodes_to_first_success", float(first_success(successes).mean()))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        # Within a rollout: what is logged around it is before and after many updates
        seconds = (time.time_ns() - self.model.start_time) / 1e9
        self.logger.record("time/time_elapsed", int(seconds), exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if self.verbose >= 1:
            print(
                f"Eval num_timesteps={self.num_timesteps}: return of adaptation episode 1: {returns[:, 0].mean():.2f}, "
                f"of episode {returns.shape[1]}: {self.last_mean_reward:.2f}, success {successes[:, -1].mean():.0%}"
            )


def _share_an_env(one: VecEnv, other: VecEnv | None) -> bool:
    if other is None:
        return False
    ours, theirs = ({id(env.unwrapped) for env in (venv, *getattr(venv.unwrapped, "envs", ()))} for venv in (one, other))
    return bool(ours & theirs)
