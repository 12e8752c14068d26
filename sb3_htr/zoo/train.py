"""``sb3-htr train``: rl_zoo3's training with PEARL in it, and with evaluations that adapt."""

import json
import sys
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import rl_zoo3.train
from rl_zoo3 import exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS, SimpleLinearSchedule
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL
from sb3_htr.common.callbacks import MetaEvalCallback, MetaTrialEvalCallback, ProgressCallback
from sb3_htr.common.checkpoint import CheckpointCallback, atomic_path
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import EpisodeClustering
from sb3_htr.zoo.hyperparams import hyperparams_file

PACKAGES = ("sb3_htr", "stable_baselines3", "gymnasium", "rl_zoo3", "torch", "numpy", "mujoco")
# Tasks that an evaluation adapts to side by side
N_EVAL_ENVS = 20


class MetaExperimentManager(ExperimentManager):
    """
    rl_zoo3's manager, with task envs stepped as one batch and env arguments of the YAML that reach the evaluation too.
    """

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable[..., Any] | None, list[BaseCallback], Callable[..., Any] | None]:
        processed = super()._preprocess_hyperparams(hyperparams)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = dict(self.env_kwargs)
        return processed

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        processed = ExperimentManager._preprocess_schedules(hyperparams)
        for key, value in processed.items():
            if isinstance(value, SimpleLinearSchedule):
                # SB3's own schedule is the same, and a model with it can be loaded where rl_zoo3 is not installed
                processed[key] = LinearSchedule(value.initial_value, 0.0, 1.0)
        return processed

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: number of envs
        :param eval_env: whether the envs are for evaluation
        :param no_log: write no monitor file
        :return: the envs, batched if the registration offers that and no wrapper of single envs is asked for
        """
        spec = gym.spec(self.env_name.gym_id)
        if spec.vector_entry_point is None or self.env_wrapper is not None or self.args.vec_env == "subproc":
            return super().create_envs(n_envs, eval_env, no_log)
        env = make_task_vec_env(
            self.env_name.gym_id,
            N_EVAL_ENVS if eval_env else n_envs,
            seed=self.seed,
            monitor_dir=None if eval_env or no_log else self.save_path,
            env_kwargs=self.eval_env_kwargs if eval_env else self.env_kwargs,
        )
        if self.vec_env_wrapper is not None:
            env = self.vec_env_wrapper(env)
        return self._maybe_normalize(env, eval_env)

    def create_callbacks(self) -> None:
        """Add the log of training, ``progress.csv``."""
        super().create_callbacks()
        self.callbacks.append(ProgressCallback(Path(self.save_path) / "progress.csv"))

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        super()._save_config(saved_hyperparams)
        run = {
            "env_id": self.env_name.gym_id,
            "env_kwargs": self.env_kwargs,
            "gym_packages": self.args.gym_packages,
            "seed": self.seed,
            "n_timesteps": self.n_timesteps,
            "command": " ".join(sys.argv),
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "versions": {name: version(name) for name in PACKAGES if _is_installed(name)},
            "hyperparams": saved_hyperparams,
        }
        with atomic_path(Path(self.save_path) / "run.json") as path:
            path.write_text(json.dumps(run, indent=2, default=str))


def _is_installed(name: str) -> bool:
    try:
        version(name)
    except ModuleNotFoundError:
        return False
    return True


def register() -> None:
    """Make PEARL known to rl_zoo3, in this process."""
    ALGOS["pearl"] = PEARL
    # rl_zoo3 looks these names up when it needs them
    replaced: dict[ModuleType, dict[str, type]] = {
        exp_manager: {
            "EvalCallback": MetaEvalCallback,
            "TrialEvalCallback": MetaTrialEvalCallback,
            "CheckpointCallback": CheckpointCallback,
            # so that `replay_buffer_class: EpisodeClustering` in a YAML file is found
            "EpisodeClustering": EpisodeClustering,
        },
        rl_zoo3.train: {"ExperimentManager": MetaExperimentManager},
    }
    for module, classes in replaced.items():
        vars(module).update(classes)


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of rl_zoo3's train; the algorithm is PEARL, the YAML is this package's unless given
    """
    register()
    # Later arguments win, so these are defaults. One thread: two runs on two cores must not fight for them.
    defaults = ["--algo", "pearl", "-conf", str(hyperparams_file()), "--num-threads", "1"]
    arguments, sys.argv = sys.argv, ["sb3-htr train", *defaults, *argv]
    try:
        rl_zoo3.train.train()
    finally:
        sys.argv = arguments
