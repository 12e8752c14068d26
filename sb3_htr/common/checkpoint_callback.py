"""Writes checkpoints from which a training goes on as if it had never stopped."""

import shutil
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.callback import parts_of
from sb3_htr.common.checkpoint import CHECKPOINTS, check_state, checkpoints, n_steps_at, write_checkpoint
from sb3_htr.common.errors import reason, training_goes_on
from sb3_htr.common.settings import check_numbers, keywords_of

# What is recorded but not written yet
LOGGER_STATE = ("name_to_value", "name_to_count", "name_to_excluded")
# Of a callback's attributes, those that are kept
NUMBERS = (bool, int, float)


@runtime_checkable
class HasState(Protocol):
    """A model or callback whose memory can be put into a file."""

    def state_dict(self) -> dict[str, Any]:
        """Nested dicts and lists of tensors, numbers, strings."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over the result of ``state_dict``."""
        ...


def numbers_of(callback: BaseCallback) -> dict[str, Any]:
    """
    :param callback: that has no state of its own to tell, as SB3's have none
    :return: its numbers, counts among them
    """
    plain = {name: _plain(value) for name, value in vars(callback).items()}
    return {name: value for name, value in plain.items() if type(value) in NUMBERS}


def restore_numbers(callback: BaseCallback, numbers: dict[str, Any]) -> None:
    """
    :param callback: which has these numbers
    :param numbers: of :func:`numbers_of`; what else a file may name stays as it is
    """
    # A default may be an attribute of the class
    known = {name for name in numbers if type(_plain(getattr(callback, name, None))) in NUMBERS}
    vars(callback).update({name: value for name, value in numbers.items() if name in known and type(value) in NUMBERS})


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def cut_monitor_files(files: Sequence[Path], sizes: dict[str, int]) -> None:
    """
    Forget the episodes after a checkpoint.

    :param files: monitor files of a run, but for those that are being written
    :param sizes: of the monitor files when the checkpoint was made
    """
    for path in files:
        if path.name in sizes:
            with atomic_path(path) as temporary:
                temporary.write_bytes(path.read_bytes()[: sizes[path.name]])
        else:
            path.unlink()


class CheckpointCallback(BaseCallback):
    """
    Saves all that a training is, between rollouts and at its end, as ``<save_path>/checkpoints/<steps>_steps/``.

    A disk that is full, or an old checkpoint that cannot be removed, stops no training: what failed is tried again before the
    next rollout.

    :param save_freq: smallest number of calls (steps of the VecEnv) between two checkpoints
    :param save_path: folder of the run
    :param keep: number of checkpoints to keep, the latest ones
    :param companions: callbacks of the same training. Saved too, of them and of those that they call, is the state, or, of one
        that has no ``state_dict``, each attribute that is a number, but for arguments of its constructor that did not change
    :param name_prefix: for SB3's signature, not used
    :param verbose: 1 says where checkpoints are written
    :raises ValueError: if none would be kept, or ``save_freq`` is below 1; at the beginning of a training, if another callback
        calls it, as ``EveryNTimesteps`` would
    """

    def __init__(
        self,
        save_freq: int,
        save_path: str,
        keep: int = 2,
        companions: Sequence[BaseCallback] = (),
        name_prefix: str = "",
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_numbers(save_freq=(save_freq, 1.0), keep=(keep, 1))
        self.save_freq = save_freq
        self.run = Path(save_path)
        self.keep = keep
        self.companions = companions
        self._last_calls = 0
        # What was written last, or gone on from: it is whole
        self._whole: Path | None = None
        self._pending: dict[str, Any] | None = None
        # Of each callback, before anything was restored or counted
        self._made_with: list[dict[str, Any]] = []
        self.stopping = self._stopped = self._has_trained = False

    def restore(self, model: HasState, state: dict[str, Any]) -> None:
        """
        Put a training that was just set up, with the same settings, where a checkpoint was.

        :param model: to be trained by ``learn(remaining steps, reset_num_timesteps=False)`` with this callback
        :param state: of :func:`load_latest`
        :raises ValueError: for other callbacks than it was begun with
        """
        callbacks = self._callbacks()
        if len(callbacks) != len(state["callbacks"]):
            raise ValueError(
                f"The training was begun with {len(state['callbacks']) - 1} callbacks beside its CheckpointCallback, those "
                f"within others counted, and goes on with {len(callbacks) - 1}: give it the same ones, in the same order."
            )
        model.load_state_dict(state["model"])
        self._whole = self._folder(state["model"]["counters"]["num_timesteps"])
        self._made_with = [numbers_of(callback) for callback in callbacks]
        for callback, remembered in zip(callbacks, state["callbacks"], strict=True):
            callback.n_calls = remembered["n_calls"]
            if isinstance(callback, HasState):
                callback.load_state_dict(remembered["state"])
            else:
                restore_numbers(callback, remembered["state"] or {})  # older checkpoints have none
        self._last_calls = self.n_calls
        # Setting up the training makes a logger
        self._pending = state

    def _folder(self, n_steps: int) -> Path:
        return self.run / CHECKPOINTS / f"{n_steps}_steps"

    def _callbacks(self) -> list[BaseCallback]:
        return [self, *(part for companion in self.companions for part in parts_of(companion))]

    def stop(self) -> None:
        """Save a checkpoint before the next rollout, and end the training there."""
        self.stopping = True

    def _monitor_files(self) -> dict[str, int]:
        return {path.name: path.stat().st_size for path in self.run.glob("*.monitor.csv")}

    def _on_training_start(self) -> None:
        if self.parent is not None:
            parent, self.parent = self.parent, None  # it may be passed alone next
            raise ValueError(
                f"A CheckpointCallback within {type(parent).__name__} hears nothing of rollouts, between which it saves: "
                "pass it beside that one, with its own save_freq."
            )
        if self._has_trained:  # what stopped a training before this one
            self.stopping = self._stopped = False
        self._has_trained = True
        self._made_with = self._made_with or [numbers_of(callback) for callback in self._callbacks()]
        if self._pending is not None:
            at = self._pending["model"]["counters"]["num_timesteps"]
            if self.num_timesteps != at:
                raise ValueError(
                    f"The training begins at {self.num_timesteps} env steps, and its checkpoint is of {at}: call "
                    "learn(remaining steps, reset_num_timesteps=False)."
                )
            for name in LOGGER_STATE:
                getattr(self.logger, name).update(self._pending["logger"][name])
            outputs, folders = self._tensorboards(), self._pending["tensorboard_folders"]
            if len(outputs) != len(folders):
                raise ValueError(
                    f"The training was logged to {len(folders)} folders of TensorBoard, and goes on with {len(outputs)}: make "
                    "the model with the tensorboard_log that it had."
                )
            for output, folder in zip(outputs, folders, strict=True):
                # Takes back what was logged after the checkpoint
                writer = type(output.writer)(log_dir=folder, purge_step=self.num_timesteps + 1)
                output.writer.close()
                output.writer = writer
            # What is logged goes on, too
            self.model.start_time -= self._pending["elapsed_ns"]
            self.model._num_timesteps_at_start = self._pending["num_timesteps_at_start"]
            self._pending = None
            return
        beyond = [folder for folder in checkpoints(self.run) if n_steps_at(folder) > self.num_timesteps]
        if beyond:
            raise ValueError(
                f"{beyond[0]} is a checkpoint of another training, which went further, and the older checkpoints in a folder "
                "are removed: give another save_path, or go on with that training."
            )

    def _tensorboards(self) -> list[TensorBoardOutputFormat]:
        return [output for output in self.logger.output_formats if isinstance(output, TensorBoardOutputFormat)]

    def _on_step(self) -> bool:
        return not self._stopped

    def _on_rollout_start(self) -> None:
        # A rollout begins with a reset of all envs, so nothing is lost by stopping just before it
        if self.n_calls - self._last_calls >= self.save_freq or self.stopping:
            self._save()
        elif self.n_calls == 0:
            self._state()  # what cannot be saved says so before any work is done

    def _save(self, then: str = "Training goes on, and tries again before the next rollout.") -> None:
        folder = self._folder(self.num_timesteps)
        self._stopped = self.stopping
        try:
            write_checkpoint(folder, self._state())
        except OSError as error:
            if self._stopped:
                then = "Training stops as it was asked to: what was trained since the checkpoint before is lost."
            warnings.warn(f"The checkpoint {folder} could not be written ({reason(error)}). {then}", stacklevel=2)
            return
        self._last_calls = self.n_calls
        if self.verbose > 0:
            print(f"Checkpoint: {folder}")
        self._whole = folder
        self._remove_old()

    def _on_training_end(self) -> None:
        # Not in the middle of a rollout, where a callback may have stopped
        if not self._stopped and self.num_timesteps >= self.model._total_timesteps and self.n_calls > self._last_calls:
            self._save("The training is at its end, and can go on from the checkpoint before alone, if there is one.")
        # A process killed between writing its last checkpoint and cleaning up leaves that to the one that goes on
        self._remove_old()

    def _remove_old(self) -> None:
        # Those of killed processes, too; but never the one that is known to be whole, behind others that may be damaged
        old_ones = [folder for folder in checkpoints(self.run)[self.keep :] if folder != self._whole]
        for old in [*old_ones, *(self.run / CHECKPOINTS).glob(".*_steps.*.tmp")]:
            with training_goes_on(f"The old checkpoint {old}", "removed"):
                shutil.rmtree(old)

    def _state(self) -> dict[str, Any]:
        return {
            "model": cast(HasState, self.model).state_dict(),
            "logger": self._logger_state(),
            "callbacks": self._callback_states(),
            "elapsed_ns": time.time_ns() - int(self.model.start_time),
            "num_timesteps_at_start": self.model._num_timesteps_at_start,
            "monitor_files": self._monitor_files(),
            "tensorboard_folders": [str(output.writer.log_dir) for output in self._tensorboards()],
        }

    def _logger_state(self) -> dict[str, dict[str, Any]]:
        """What is a number or a text; a figure that waits for the next log is not kept."""
        values = {
            key: value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value
            for key, value in self.logger.name_to_value.items()
        }
        values = {key: value for key, value in values.items() if isinstance(value, int | float | str)}
        others = {name: getattr(self.logger, name) for name in LOGGER_STATE[1:]}
        return {LOGGER_STATE[0]: values} | {name: {k: v for k, v in x.items() if k in values} for name, x in others.items()}

    def _callback_states(self) -> list[dict[str, Any]]:
        states = []
        for callback, made_with in zip(self._callbacks(), self._made_with, strict=True):
            settings = keywords_of(type(callback)) & made_with.keys()
            numbers = {k: v for k, v in numbers_of(callback).items() if k not in settings or v != made_with[k]}
            state = None if callback is self else numbers
            if isinstance(callback, HasState):
                state = callback.state_dict()
            check_state(type(callback).__name__, state)
            states.append({"n_calls": callback.n_calls, "state": state})
        return states
