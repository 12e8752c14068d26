"""One training by rl_zoo3: its folder, its checkpoints, its record, and how it ends."""

import contextlib
import errno
import importlib
import shutil
import sys
import warnings
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checkpoint import checkpoints, load_latest, n_steps_done
from sb3_htr.common.checkpoint_callback import CheckpointCallback, cut_monitor_files
from sb3_htr.common.divergence import DivergedError
from sb3_htr.common.errors import reason, training_goes_on
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.common.versions import hardware, made_by
from sb3_htr.zoo.run.callbacks import ProgressCallback
from sb3_htr.zoo.run.folder import SystemLock, claim, lock
from sb3_htr.zoo.run.manager import MetaExperimentManager
from sb3_htr.zoo.run.record import (
    RECORD,
    TRIAL,
    arguments_to_go_on,
    command_to_go_on,
    read_record,
    record_going_on,
    write_record,
)
from sb3_htr.zoo.run.soft_interrupt import soft_interrupt
from sb3_htr.zoo.run.study import check_is_of, check_is_there, without_password
from sb3_htr.zoo.run.trust import check_arguments, plain_settings


class TrainingManager(MetaExperimentManager):
    """A run that is new, or goes on from its latest checkpoint."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._unique = kwargs.get("uuid_str", "")
        self._claimed: Path | None = None
        # Folders above it that were not there before, from the inside out
        self._made: list[Path] = []
        # The record of a run that goes on otherwise than it was begun
        self._going_on: dict[str, Any] | None = None
        self._lock: SystemLock | None = None
        self._trial: dict[str, Any] = {}
        self._interrupted = False

    def _settings_of_trial(self, trial_id: int | None) -> dict[str, Any]:
        if self.resumed is not None and TRIAL in (record := read_record(self.resumed / RECORD)):
            # Its study may be gone
            self._trial = dict(record[TRIAL])
            return self._trial
        named = {"--storage": self.storage, "--study-name": self.study_name, "--trial-id": trial_id}
        missing = [option for option, value in named.items() if value is None]
        if len(missing) == 3:
            return {}
        if missing or trial_id is None or trial_id < 0:
            add = ", ".join(missing) or "another number"
            raise ValueError(f"A trial is named by {', '.join(named)}, from 0 on: add {add}.")
        assert self.storage is not None and self.study_name is not None
        check_is_there(self.storage)
        check_is_of(self.storage, self.study_name, {"env": self.env_name.gym_id, "method": self.method.name})
        try:
            self._trial = self.load_trial(self.storage, self.study_name, trial_id)
        except (KeyError, IndexError):
            raise ValueError(
                f"{without_password(self.storage)} has no study {self.study_name!r} with a trial {trial_id}: "
                "`sb3-htr optimize` prints both."
            ) from None
        print(f"With those of trial {trial_id}: {self._trial}")
        return self._trial

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        :return: the model and its hyperparameters
        """
        try:
            return super().setup_experiment()
        except BaseException as error:
            if self._lock is not None:
                self._lock.release()
            if self._claimed is not None:  # nothing was trained in it
                # Why it is refused matters more than a folder that NFS keeps, as a file in it is still open
                shutil.rmtree(self._claimed, ignore_errors=True)
            for folder in self._made:
                with contextlib.suppress(OSError):  # others may be in it
                    folder.rmdir()
            if isinstance(error, OSError) and error.filename is None and error.errno == errno.ENOSPC:
                raise OSError(error.errno, error.strerror, self.save_path) from error
            raise

    def create_log_folder(self) -> None:
        """Make the run's folder, or take the one of the run that goes on."""
        if self.tensorboard_log:
            importlib.import_module("tensorboard")  # missing, it should be said before anything is written
        if self.resumed is None:
            # An env that cannot be trained on should say so before there is a folder
            make_task_vec_env(self.env_name.gym_id, env_kwargs=self.env_kwargs, wrapper=self.env_wrapper).close()
            self._made = [path for path in (Path(self.log_path), *Path(self.log_path).parents) if not path.exists()]
            self._claimed = claim(self.log_path, self.env_name, self._unique)
            self.save_path = str(self._claimed)
            self._lock = lock(self._claimed)
        else:
            self.save_path = str(self.resumed)
            self._lock = lock(self.resumed)
            for left in self.resumed.glob(".*.tmp*"):  # by a process that was killed
                with training_goes_on(str(left), "removed"):
                    left.unlink()
            folder, self._checkpoint = load_latest(self.resumed)
            self._monitor_files = sorted(self.resumed.glob("*.monitor.csv"))
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
            # Not before: a run that is refused has the episodes and the plan that it had
            cut_monitor_files(self._monitor_files, self._checkpoint["monitor_files"])
            if self._going_on is not None:
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
            check_arguments(arguments_to_go_on(record), record["gym_packages"], RECORD, trust, packages)
            plain_settings(self._given, RECORD, trust, packages)
        except ValueError:  # what a user may say, the record may not
            trust = True
        return command_to_go_on(Path(self.save_path), record, trust)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        networks = hyperparams.get("policy_kwargs") or {}
        model = self._pretrained(hyperparams, env)
        if other := sorted(key for key, value in networks.items() if model.policy_kwargs.get(key) != value):
            warnings.warn(
                f"policy_kwargs ({', '.join(other)}) change nothing, as the networks are those of {self.trained_agent}: leave "
                "-i out to have others."
            )
        return model

    def _pretrained(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
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
        Write the last model, and before it all that could not be written yet: a run that has its last model is finished.

        :param model: at the end of its training
        :raises OSError: if something cannot be written, or the folder was removed during the training
        :raises KeyboardInterrupt: when all is written, if the training was interrupted: a script should not go on
        """
        run = Path(self.save_path)
        # As rl_zoo3 does, but that of an id with a dot, what is behind it is no suffix
        last = f"{run / self.env_name}.zip"
        writes: dict[str, Callable[[], None]] = {last: partial(model.save, last)}
        for callback in self.callbacks:
            if isinstance(callback, MetaEvalCallback | ProgressCallback):
                writes = callback.to_write() | writes
        if self.save_replay_buffer and hasattr(model, "save_replay_buffer"):
            buffer = f"{run / 'replay_buffer.pkl'}"
            writes = {buffer: partial(model.save_replay_buffer, buffer)} | writes
        if not checkpoints(run):  # nothing else has what was learned
            writes = dict(reversed(writes.items()))
        try:
            for path, write in writes.items():
                try:
                    write()
                except OSError as error:
                    raise self._unwritten(path, f" ({reason(error)})") from error
        finally:
            assert self._lock is not None
            self._lock.release()
        if not (run / RECORD).exists():
            raise OSError(f"{run} was removed during the training: it has the last model, and no {RECORD}.")
        if self._interrupted:
            raise KeyboardInterrupt
        if self._checkpointing is not None and n_steps_done(run) < self.n_timesteps <= model.num_timesteps:
            raise self._unwritten(f"The last checkpoint of {run}")

    def _unwritten(self, what: str, why: str = "") -> OSError:
        again = "train again, as there is no checkpoint"
        if checkpoints(Path(self.save_path)):
            again = f"`{self._to_go_on()}` goes on from the last checkpoint"
        return OSError(f"{what} could not be written{why}: mend that, and {again}.")

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # As used: -n may have replaced the file's
        used = {**saved_hyperparams, "n_timesteps": self.n_timesteps}
        if self.resumed is not None:
            record = read_record(self.resumed / RECORD)
            n_steps = self._checkpoint["model"]["counters"]["num_timesteps"]
            going_on = record_going_on(record, self.resumed, used, sys.argv[1:], self._hardware(), n_steps)
            self._going_on = going_on if going_on != record else None
            return
        self.args.storage = None if self.storage is None else without_password(self.storage)
        super()._save_config(saved_hyperparams)
        command = Path(self.params_path, "command.txt")
        command.write_text(self._shown(command.read_text()))
        run = {
            "env_id": self.env_name.gym_id,
            "method": self.method.name,
            "env_kwargs": self.env_kwargs,
            "gym_packages": self.args.gym_packages,
            "seed": self.seed,
            "n_timesteps": self.n_timesteps,
            "command": self._shown(" ".join(sys.argv)),
            "arguments": [self._shown(argument) for argument in sys.argv[1:]],
            **({TRIAL: self._trial} if self._trial else {}),
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "hardware": [self._hardware()],
            **made_by(),
            "hyperparams": used,
        }
        write_record(Path(self.save_path), run)

    def _shown(self, text: str) -> str:
        """Without the password of a database: files of a run are read by others."""
        return text if self.storage is None else text.replace(self.storage, without_password(self.storage))

    def _hardware(self) -> str:
        return hardware(get_device(self.device))
