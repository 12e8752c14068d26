"""``sb3-htr train``: rl_zoo3's training with PEARL in it, and with evaluations that adapt."""

import argparse
import importlib
import json
import signal
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import optuna
import rl_zoo3.train
from rl_zoo3 import exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS, SimpleLinearSchedule
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.callbacks import MetaEvalCallback, MetaTrialEvalCallback, ProgressCallback
from sb3_htr.common.checks import check_keywords, check_numbers
from sb3_htr.common.memory import keep_freed_memory
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.divergence import DivergedError
from sb3_htr.pearl.resume import CheckpointCallback, checkpoints, cut_monitor_files, load_latest
from sb3_htr.zoo.agents import find_run
from sb3_htr.zoo.search_space import convert_pearl_params, sample_pearl_params
from sb3_htr.zoo.shipped import hyperparams_file
from sb3_htr.zoo.yaml_values import without_code

PACKAGES = ("sb3_htr", "stable_baselines3", "gymnasium", "rl_zoo3", "torch", "numpy", "mujoco")
# What a YAML file may have beside the arguments of PEARL
ZOO_SETTINGS = ("n_envs", "n_timesteps", "normalize", "env_wrapper", "vec_env_wrapper", "callback", "env_kwargs")
# Tasks that an evaluation adapts to side by side
N_EVAL_ENVS = 20
HELP = """sb3-htr train: rl_zoo3's train (its arguments follow) with PEARL and evaluations that adapt to validation tasks.

examples:
  sb3-htr train --env SparsePointRobot-v0 -P
  sb3-htr train --env SparsePointRobot-v0 -f runs --seed 1 -params gamma:0.95 "policy_kwargs:{'latent_dim':3}"
  sb3-htr train --resume runs/pearl/SparsePointRobot-v0_1

defaults here: --algo pearl -conf hyperparams/pearl.yml (of this package) --num-threads 1 --save-freq 20000
beside rl_zoo3's: --resume RUN  go on with a run from its latest checkpoint, exactly; takes no other arguments
no effect here: --eval-episodes and --n-eval-envs (an evaluation adapts to each validation task once, in 20 episodes)
"""


class MetaExperimentManager(ExperimentManager):
    """
    rl_zoo3's manager, with task envs stepped as one batch and env arguments of the YAML that reach the evaluation too.
    """

    # Folder of the run that goes on, None for a new one
    resumed: Path | None = None

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        rl_zoo3's; but settings of a trial (``--trial-id``) join those of the file where both are dicts, instead of replacing
        them all, and trial 0 can be asked for.

        :return: hyperparameters, and the same sorted to be saved
        """
        if self.n_timesteps != -1:
            check_numbers(n_timesteps=(self.n_timesteps, 1, float("inf")))
        trial_id, self.trial_id = self.trial_id, None
        hyperparams, saved = super().read_hyperparameters()
        if self.storage and self.study_name and trial_id is not None:
            try:
                trial = self.load_trial(self.storage, self.study_name, trial_id)
            except (KeyError, IndexError):
                raise ValueError(
                    f"{self.storage} has no study {self.study_name!r} with a trial {trial_id}: `sb3-htr optimize` prints both."
                ) from None
            for key in trial.keys() - (self.custom_hyperparams or {}).keys():
                value, given = trial[key], hyperparams.get(key)
                hyperparams[key] = {**given, **value} if isinstance(value, dict) and isinstance(given, dict) else value
            saved = OrderedDict(sorted(hyperparams.items()))
            print(f"With those of trial {trial_id}: {trial}")
        return hyperparams, saved

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable[..., Any] | None, list[BaseCallback], Callable[..., Any] | None]:
        check_keywords("PEARL", hyperparams, PEARL, also=ZOO_SETTINGS)
        check_numbers(n_envs=(hyperparams.get("n_envs", 1), 1, float("inf")))
        processed = super()._preprocess_hyperparams(without_code(hyperparams))
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
        # A search makes envs for a look at their spaces too, which is no run to be logged
        no_log = no_log or self.optimize_hyperparameters
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

    def create_log_folder(self) -> None:
        """Make the run's folder, or take the one of the run that goes on; a search has none."""
        if self.optimize_hyperparameters:
            return
        if self.tensorboard_log:
            importlib.import_module("tensorboard")  # missing, it should be said before anything is written
        if self.resumed is not None:
            self.save_path = str(self.resumed)
            self.params_path = f"{self.save_path}/{self.env_name}"
            folder, self._checkpoint = load_latest(self.resumed)
            cut_monitor_files(self.resumed, folder, self._checkpoint["monitor_files"])
            print(f"Going on from {folder}")
        super().create_log_folder()

    def create_callbacks(self) -> None:
        """Add the log of training, ``progress.csv``; a run shorter than ``--eval-freq`` is evaluated at its end."""
        self.eval_freq = min(self.eval_freq, self.n_timesteps)
        super().create_callbacks()
        self.callbacks.append(ProgressCallback(Path(self.save_path) / "progress.csv"))
        self._checkpointing = next((call for call in self.callbacks if isinstance(call, CheckpointCallback)), None)
        if self._checkpointing is not None:
            self._checkpointing.companions = [call for call in self.callbacks if call is not self._checkpointing]

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train, from the checkpoint on if a run is resumed. A first interrupt stops before the next rollout, a second at once.

        :param model: as set up
        """
        assert isinstance(model, PEARL)
        done = 0
        if self.resumed is not None:
            assert self._checkpointing is not None, "a run that has a checkpoint makes them"
            self._checkpointing.restore(model, self._checkpoint)
            done = model.num_timesteps
        log_interval = {-1: 1}.get(self.log_interval, self.log_interval if self.log_interval > 0 else None)
        with _soft_interrupt(self._checkpointing):
            try:
                model.learn(max(int(self.n_timesteps) - done, 0), self.callbacks, log_interval, reset_num_timesteps=not done)
            except KeyboardInterrupt:
                print(f"Interrupted at {model.num_timesteps} steps.")
            except DivergedError as error:
                last = next(iter(checkpoints(Path(self.save_path))), None)
                raise DivergedError(f"{error} The last checkpoint: {last or 'none yet'}.") from None
            finally:
                stopping = self._checkpointing is not None and self._checkpointing.stopping
                if checkpoints(Path(self.save_path)) and (stopping or model.num_timesteps < self.n_timesteps):
                    print(f"To go on: sb3-htr train --resume {self.save_path}")
                assert model.env is not None
                model.env.close()

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: gives the hyperparameters
        :return: mean return of the last adaptation episode on the validation tasks
        :raises optuna.TrialPruned: for hyperparameters that promise little or diverge
        """
        try:
            return super().objective(trial)
        except DivergedError as error:
            print(f"Trial {trial.number} is pruned: {error}")
            raise optuna.TrialPruned from error

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # As used: -n may have replaced the file's
        used = {**saved_hyperparams, "n_timesteps": self.n_timesteps}
        if self.resumed is not None:
            before = json.loads((self.resumed / "run.json").read_text())["hyperparams"]
            now = json.loads(json.dumps(used))
            if before != now:
                changed = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
                raise ValueError(
                    f"The hyperparameters {changed} have changed since {self.resumed} was begun: a run goes on with the "
                    "settings that it has. Restore the YAML file, or begin a new run."
                )
            return
        super()._save_config(saved_hyperparams)
        run = {
            "env_id": self.env_name.gym_id,
            "env_kwargs": self.env_kwargs,
            "gym_packages": self.args.gym_packages,
            "seed": self.seed,
            "n_timesteps": self.n_timesteps,
            "command": " ".join(sys.argv),
            "arguments": sys.argv[1:],
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "versions": {name: version(name) for name in PACKAGES if _is_installed(name)},
            "hyperparams": used,
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
    HYPERPARAMS_SAMPLER["pearl"] = sample_pearl_params
    HYPERPARAMS_CONVERTER["pearl"] = convert_pearl_params
    # rl_zoo3 looks these names up when it needs them
    replaced: dict[ModuleType, dict[str, type]] = {
        exp_manager: {
            "EvalCallback": MetaEvalCallback,
            "TrialEvalCallback": MetaTrialEvalCallback,
            "CheckpointCallback": CheckpointCallback,
        },
        rl_zoo3.train: {"ExperimentManager": MetaExperimentManager},
    }
    for module, classes in replaced.items():
        vars(module).update(classes)


@contextmanager
def _soft_interrupt(checkpointing: CheckpointCallback | None) -> Iterator[None]:
    """Let the first Ctrl-C end the training before the next rollout, with a checkpoint, and the second one at once."""
    if checkpointing is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(signum: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, before)
        print("Stopping after this rollout, with a checkpoint. Press Ctrl-C again to stop at once.")
        checkpointing.stop()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _arguments(argv: Sequence[str]) -> tuple[list[str], Path | None]:
    """Those for rl_zoo3, and the run to go on with."""
    parser = argparse.ArgumentParser(prog="sb3-htr train", add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--algo", default="pearl")
    args, rest = parser.parse_known_args(argv)
    if args.algo != "pearl":
        raise ValueError(f"--algo is {args.algo!r}, but sb3-htr trains pearl: `python -m rl_zoo3.train` has SB3's algorithms.")
    if args.resume is None:
        if not {"-h", "--help"} & set(rest) and not any(argument.split("=")[0] == "--env" for argument in rest):
            raise ValueError("--env is missing: give the id of a task env, as in `sb3-htr train --env SparsePointRobot-v0`.")
        # Later arguments win, so these are defaults. One thread: two runs on two cores must not fight for them.
        defaults = ["--algo", "pearl", "-conf", str(hyperparams_file()), "--num-threads", "1", "--save-freq", "20000"]
        return [*defaults, *rest], None
    if rest:
        raise ValueError(f"train --resume goes on with the run's own arguments: leave {' '.join(rest)} away.")
    run = find_run(args.resume)
    record = json.loads((run / "run.json").read_text())
    return [*record["arguments"], "--seed", str(record["seed"])], run


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of rl_zoo3's train; the algorithm is PEARL, the YAML is this package's unless given. Or ``--resume``
        and the folder of a run, which goes on from its latest checkpoint
    """
    register()
    if {"-h", "--help"} & set(argv):
        print(HELP)
    keep_freed_memory()
    arguments, run = _arguments(argv)
    before, sys.argv = sys.argv, ["sb3-htr train", *arguments]
    MetaExperimentManager.resumed = run
    try:
        rl_zoo3.train.train()
    except (NameError, SyntaxError) as error:
        raise ValueError(
            f"{error}: the values of -params and --env-kwargs are Python, with strings in quotes, as in \"explorer:'prior'\"."
        ) from error
    finally:
        sys.argv = before
        MetaExperimentManager.resumed = None
