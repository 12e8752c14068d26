"""rl_zoo3's experiment manager, for runs of task envs."""

import contextlib
import importlib
import shutil
import sys
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
from io import StringIO
from pathlib import Path
from pprint import pprint
from typing import Any, cast

import optuna
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from rl_zoo3.utils import SimpleLinearSchedule
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule, get_device
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr.common.checkpoint import checkpoints, load_latest
from sb3_htr.common.checkpoint_callback import CheckpointCallback, cut_monitor_files
from sb3_htr.common.errors import WRITE_ERRORS, reason
from sb3_htr.common.settings import check_keywords, check_numbers, keywords_of
from sb3_htr.common.vec_env import N_ENVS, make_task_vec_env
from sb3_htr.common.versions import hardware, made_by
from sb3_htr.pearl.divergence import DivergedError
from sb3_htr.zoo.run.callbacks import ProgressCallback
from sb3_htr.zoo.run.folder import SystemLock, claim, lock
from sb3_htr.zoo.run.method import DEFAULT, get_method, merged, names_of
from sb3_htr.zoo.run.record import RECORD, command_to_go_on, read_record, record_going_on, write_record
from sb3_htr.zoo.run.shipped import find_hyperparams
from sb3_htr.zoo.run.soft_interrupt import soft_interrupt
from sb3_htr.zoo.run.study import check_is_of, check_is_there
from sb3_htr.zoo.run.train_arguments import given_arguments
from sb3_htr.zoo.run.trust import check_arguments, plain_settings
from sb3_htr.zoo.run.yaml_checks import checked_kinds

# What a YAML file may have beside the arguments of the algorithm
ZOO_SETTINGS = ("n_envs", "n_timesteps", "env_wrapper", "vec_env_wrapper", "callback", "env_kwargs")
# Arguments of an algorithm that rl_zoo3 gives it itself
OPTIONS = {
    "env": "--env",
    "seed": "--seed",
    "device": "--device",
    "verbose": "--verbose",
    "tensorboard_log": "--tensorboard-log",
}


class MetaExperimentManager(ExperimentManager):
    """
    rl_zoo3's manager, with task envs stepped as one batch and env arguments of the YAML that reach the evaluation too.
    """

    def __init__(
        self, *args: Any, method: str | None = None, resumed: Path | None = None, trust: bool = False, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.config = find_hyperparams(self.config)
        self.trust = trust
        self._method_name = method
        self._unique = kwargs.get("uuid_str", "")
        self.resumed = resumed
        self._claimed: Path | None = None
        # The record of a run that goes on otherwise than it was begun
        self._going_on: dict[str, Any] | None = None
        self._lock: SystemLock | None = None
        self._interrupted = False

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Those of the env in the YAML file, joined with those of the method, of a trial (``--trial-id``) and of the command line
        (``-params``): later ones win, and dicts are joined in depth.

        :return: hyperparameters, and the same sorted to be saved
        """
        if self.n_timesteps != -1:
            check_numbers(n_timesteps=(self.n_timesteps, 1))
        given, trial_id = dict(self.custom_hyperparams or {}), self.trial_id
        self.custom_hyperparams, self.trial_id = None, None
        with contextlib.redirect_stdout(StringIO()):  # it prints what is not all of it
            try:
                hyperparams, _ = super().read_hyperparameters()
            except (AttributeError, TypeError, KeyError) as error:
                if isinstance(error, KeyError) and error.args != ("hyperparams",):
                    raise
                named = "" if self.config.endswith((".yml", ".yaml")) else ", in a dict named hyperparams"
                raise ValueError(
                    f"{self.config} is no file of hyperparameters: expected ids of envs, with settings{named}."
                ) from None
            except ValueError as error:
                if not str(error).startswith("Hyperparameters not found"):
                    raise
                raise ValueError(
                    f"{self.config} has no block {self.env_name.gym_id}, and none named default: add one with its settings."
                ) from None
            except yaml.YAMLError as error:
                raise ValueError(f"{self.config} cannot be read: {' '.join(str(error).split())}.") from None
        in_file = hyperparams.pop("method", DEFAULT)
        in_params = given.pop("method", in_file)
        self.method = get_method(self._method_name or in_params)
        if self.method.algorithm.name != self.algo:
            raise ValueError(f"{self.method.name} is trained by another algorithm: choose it by --method {self.method.name}.")
        if self.optimize_hyperparameters and self.method.algorithm.search_space is None:
            raise ValueError(
                f"Nothing is known of what to search for {self.method.name}: give register_algorithm a search_space, or "
                "choose another --method."
            )
        checked = partial(plain_settings, trust=self.trust, named=self.args.gym_packages)
        hyperparams = checked_kinds(checked(hyperparams, self.config), self.config)
        if (otherwise := self.method.set_otherwise(hyperparams)) and self.resumed is None:
            warnings.warn(
                f"{self.config} has {', '.join(otherwise)}, which the method {self.method.name} replaces by its own: to have "
                "them, give them by -params, or choose another --method."
            )
        hyperparams = self.method.settings(hyperparams)
        if self.resumed is not None:  # what a user gave comes from a file now
            given = checked(given, self.resumed / RECORD)
        checked_kinds(given, "-params" if self.resumed is None else self.resumed / RECORD)
        self._given = given
        hyperparams = merged(merged(hyperparams, checked(self._trial(trial_id), self.storage)), given)
        if self.n_timesteps > 0:
            hyperparams["n_timesteps"] = self.n_timesteps
        if missing := sorted({"policy", "n_timesteps"} - hyperparams.keys()):
            raise ValueError(
                f"{self.config} has no {' and no '.join(missing)} for {self.env_name}: add it, as pearl.yml has it."
            )
        hyperparams = checked_kinds(hyperparams, self.config)
        check_numbers(n_timesteps=(hyperparams["n_timesteps"], 1.0))
        saved = OrderedDict(sorted(hyperparams.items()))
        print(f"Method {self.method.name}: {self.config} has the settings of the env. With those of the command line:")
        pprint(dict(saved))
        return hyperparams, saved

    def _check_study(self) -> None:
        assert self.storage is not None
        facts: dict[str, Any] = {"env": self.env_name.gym_id, "method": self.method.name}
        if self.optimize_hyperparameters:
            facts |= {"env-kwargs": self.env_kwargs, "n-timesteps": self.n_timesteps, "hyperparams": self._given}
        check_is_of(self.storage, self.study_name, facts, note=self.optimize_hyperparameters)

    def _trial(self, trial_id: int | None) -> dict[str, Any]:
        named = {"--storage": self.storage, "--study-name": self.study_name, "--trial-id": trial_id}
        missing = [option for option, value in named.items() if value is None]
        if self.optimize_hyperparameters and self.storage is not None:
            self._check_study()
        if len(missing) == 3 or self.optimize_hyperparameters:
            return {}
        if missing or trial_id is None or trial_id < 0:
            add = ", ".join(missing) or "another number"
            raise ValueError(f"A trial is named by {', '.join(named)}, from 0 on: add {add}.")
        assert self.storage is not None and self.study_name is not None
        check_is_there(self.storage)
        self._check_study()
        try:
            trial: dict[str, Any] = self.load_trial(self.storage, self.study_name, trial_id)
        except (KeyError, IndexError):
            raise ValueError(
                f"{self.storage} has no study {self.study_name!r} with a trial {trial_id}: `sb3-htr optimize` prints both."
            ) from None
        print(f"With those of trial {trial_id}: {trial}")
        return trial

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable[..., Any] | None, list[BaseCallback], Callable[..., Any] | None]:
        if "normalize" in hyperparams:
            raise ValueError(
                "normalize asks for SB3's VecNormalize, which is not saved with the model: leave it out, the policies of "
                "PEARL and RL2 normalize observations themselves (normalize_observations of policy_kwargs)."
            )
        if elsewhere := sorted(hyperparams.keys() & OPTIONS.keys()):
            raise ValueError(f"{elsewhere[0]} is no hyperparameter: give it by {OPTIONS[elsewhere[0]]}.")
        model_class = self.method.algorithm.model_class
        own = {*keywords_of(model_class), *ZOO_SETTINGS}
        for name, owner in self.method.algorithm.owners.items():
            if misplaced := sorted(hyperparams.keys() & keywords_of(owner) - own):
                raise ValueError(f"{misplaced[0]} is a setting within {name}: -params \"{name}:{{'{misplaced[0]}':...}}\".")
        check_keywords(model_class.__name__, hyperparams, model_class, also=ZOO_SETTINGS)
        check_numbers(n_envs=(hyperparams.get("n_envs", 1), 1))
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
        :return: the envs
        """
        # A search makes envs for a look at their spaces too, which is no run to be logged
        no_log = no_log or self.optimize_hyperparameters or eval_env
        env = make_task_vec_env(
            self.env_name.gym_id,
            N_ENVS if eval_env else n_envs,
            seed=self.seed,
            monitor_dir=None if no_log else self.save_path,
            env_kwargs=self.eval_env_kwargs if eval_env else self.env_kwargs,
            wrapper=self.env_wrapper,
            vec_env_class=SubprocVecEnv if self.args.vec_env == "subproc" else None,
        )
        return env if self.vec_env_wrapper is None else self.vec_env_wrapper(env)

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        :return: the model and its hyperparameters; None for a search
        """
        try:
            return super().setup_experiment()
        except BaseException:
            if self._claimed is not None:  # nothing was trained in it
                shutil.rmtree(self._claimed)
            if self._lock is not None:
                self._lock.release()
            raise

    def create_log_folder(self) -> None:
        """Make the run's folder, or take the one of the run that goes on; a search has none."""
        self.log_path = f"{Path(self.log_folder, self.method.name)}/"  # of an empty folder, not in the root
        if self.optimize_hyperparameters:
            return
        if self.tensorboard_log:
            importlib.import_module("tensorboard")  # missing, it should be said before anything is written
        if self.resumed is None:
            # An env that cannot be trained on should say so before there is a folder
            make_task_vec_env(self.env_name.gym_id, env_kwargs=self.env_kwargs, wrapper=self.env_wrapper).close()
            self._claimed = claim(self.log_path, self.env_name, self._unique)
            self.save_path = str(self._claimed)
            self._lock = lock(self._claimed)
        else:
            self.save_path = str(self.resumed)
            self._lock = lock(self.resumed)
            folder, self._checkpoint = load_latest(self.resumed)
            cut_monitor_files(self.resumed, folder, self._checkpoint["monitor_files"])
            print(f"Going on from {folder}")
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()

    def create_callbacks(self) -> None:
        """Add the log of training, ``progress.csv``."""
        super().create_callbacks()
        self.callbacks.append(ProgressCallback(Path(self.save_path) / "progress.csv"))
        self._checkpointing = next((call for call in self.callbacks if isinstance(call, CheckpointCallback)), None)
        if self._checkpointing is not None:
            self.callbacks.remove(self._checkpointing)
            self._checkpointing.companions = list(self.callbacks)
            # Behind the evaluation at the end of a training, and before the file of the progress is closed
            self.callbacks.insert(-1, self._checkpointing)

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train, from the checkpoint on if a run is resumed. A first interrupt stops before the next rollout, a second at once.

        :param model: as set up
        """
        done = 0
        usual = self.method.algorithm.usual_timesteps(model)
        if self.args.n_timesteps == -1 and self.n_timesteps < usual:
            # The block `default` has the budget of short episodes
            print(
                f"The budget of {self.config} is {self.n_timesteps:,} env steps, that of `learn()` for such episodes "
                f"{usual:,}: -n {usual} takes it."
            )
        if self.resumed is not None:
            assert self._checkpointing is not None, "a run that has a checkpoint makes them"
            self._checkpointing.restore(cast(Any, model), self._checkpoint)
            done = model.num_timesteps
            if self._going_on is not None:  # not before: a run that is refused has the plan that it had
                write_record(Path(self.save_path), self._going_on)
        log_interval = {-1: 1}.get(self.log_interval, self.log_interval if self.log_interval > 0 else None)
        with contextlib.ExitStack() as on_failure, soft_interrupt(self._checkpointing):
            assert self._lock is not None
            on_failure.callback(self._lock.release)
            try:
                n_steps = max(int(self.n_timesteps) - done, 0)
                model.learn(n_steps, self.callbacks, log_interval, reset_num_timesteps=not done)  # type: ignore[arg-type]
            except KeyboardInterrupt:
                print(f"Interrupted at {model.num_timesteps} steps.")
                self._interrupted = True
            except DivergedError as error:
                last = next(iter(checkpoints(Path(self.save_path))), None)
                raise DivergedError(f"{error} The last checkpoint: {last or 'none yet'}.") from None
            finally:
                stopping = self._checkpointing is not None and self._checkpointing.stopping
                self._interrupted |= stopping and model.num_timesteps < self.n_timesteps
                if checkpoints(Path(self.save_path)) and (stopping or model.num_timesteps < self.n_timesteps):
                    print(f"To go on: {self._to_go_on()}")
                assert model.env is not None
                with contextlib.suppress(EOFError, ConnectionError):  # of envs in processes that have died
                    model.env.close()
            # The last model is still to be written
            on_failure.pop_all()

    def _to_go_on(self) -> str:
        packages = self.args.gym_packages
        record = read_record(Path(self.save_path) / RECORD)
        trust = self.trust
        try:
            check_arguments(given_arguments(record["arguments"]), record["gym_packages"], RECORD, trust, packages)
            plain_settings(self._given, RECORD, trust, packages)
        except ValueError:  # what a user may say, the record may not
            trust = True
        return command_to_go_on(Path(self.save_path), record, trust)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.trust:
            return super()._load_pretrained_agent(hyperparams, env)
        print("Loading pretrained agent")
        given = {key: value for key, value in hyperparams.items() if key not in ("policy", "policy_kwargs")}
        logged = {"seed": self.seed, "tensorboard_log": self.tensorboard_log, "verbose": self.verbose}
        model = self.method.algorithm.load_to_train(self.trained_agent, env, self.device, **given, **logged)
        replay_buffer = Path(self.trained_agent).with_name("replay_buffer.pkl")
        if replay_buffer.exists():
            print("Loading replay buffer")
            model.load_replay_buffer(replay_buffer)
        return model

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        :param model: at the end of its training
        :raises OSError: if it cannot be written
        :raises KeyboardInterrupt: when it is written, if the training was interrupted: a script should not go on
        """
        try:
            # As rl_zoo3 does, but that of an id with a dot, what is behind it is no suffix
            model.save(f"{self.save_path}/{self.env_name}.zip")
            if self.save_replay_buffer and hasattr(model, "save_replay_buffer"):
                model.save_replay_buffer(Path(self.save_path, "replay_buffer.pkl"))
        except WRITE_ERRORS as error:
            again = f"`{self._to_go_on()}` goes on from the last checkpoint"
            if not checkpoints(Path(self.save_path)):
                again = "train again, as there is no checkpoint either"
            raise OSError(
                f"The last model could not be written to {self.save_path} ({reason(error)}): mend that, and {again}."
            ) from error
        finally:
            assert self._lock is not None
            self._lock.release()
        if self._interrupted:
            raise KeyboardInterrupt

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: gives the hyperparameters
        :return: mean return of the last adaptation episode on the validation tasks
        :raises optuna.TrialPruned: for hyperparameters that promise little or diverge
        """
        try:
            space = self.method.algorithm.search_space
            assert space is not None
            sampled = space.sample(trial, names_of(self._given) | self.method.not_searched())
            # To rl_zoo3, dicts of the file are gone where the sampler has one
            HYPERPARAMS_SAMPLER[self.algo] = lambda *_: merged(self._hyperparams, self._preprocess_schedules(sampled))
            return super().objective(trial)
        except DivergedError as error:
            print(f"Trial {trial.number} is pruned: {error}")
            raise optuna.TrialPruned from error

    def hyperparameters_optimization(self) -> None:
        """Search. Where the report goes is looked at first."""
        Path(self.log_folder, self.algo).mkdir(parents=True, exist_ok=True)
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if all(frame.name != "best_trial" for frame in traceback.extract_tb(error.__traceback__)):
                raise
            print("none: no trial was finished. The same command goes on.")

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        sampler = super()._create_sampler(sampler_method)
        if self.storage is not None:  # workers of one study, with one command, must not draw alike
            sampler.reseed_rng()
        return sampler

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # As used: -n may have replaced the file's
        used = {**saved_hyperparams, "n_timesteps": self.n_timesteps}
        if self.resumed is not None:
            record = read_record(self.resumed / RECORD)
            n_steps = self._checkpoint["model"]["counters"]["num_timesteps"]
            going_on = record_going_on(record, self.resumed, used, sys.argv[1:], self._hardware(), n_steps)
            self._going_on = going_on if going_on != record else None
            return
        super()._save_config(saved_hyperparams)
        run = {
            "env_id": self.env_name.gym_id,
            "method": self.method.name,
            "env_kwargs": self.env_kwargs,
            "gym_packages": self.args.gym_packages,
            "seed": self.seed,
            "n_timesteps": self.n_timesteps,
            "command": " ".join(sys.argv),
            "arguments": sys.argv[1:],
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "hardware": [self._hardware()],
            **made_by(),
            "hyperparams": used,
        }
        write_record(Path(self.save_path), run)

    def _hardware(self) -> str:
        return hardware(get_device(self.device))
