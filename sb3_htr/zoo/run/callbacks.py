"""Callbacks that only runs of the command line need."""

import contextlib
import os
from pathlib import Path
from typing import Any

from rl_zoo3.callbacks import TrialEvalCallback
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, TensorBoardOutputFormat

from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.errors import training_goes_on


class PatientCSV(CSVOutputFormat):
    """Writes as long as that is possible: a disk that is full stops no training."""

    def write(self, *args: Any, **kwargs: Any) -> None:
        with training_goes_on(self.file.name):
            super().write(*args, **kwargs)

    def close(self) -> None:
        with contextlib.suppress(OSError):  # what could not be written before
            super().close()


class PatientTensorBoard(TensorBoardOutputFormat):
    """
    As :class:`PatientCSV`. TensorBoard's writer is of no use any more after an error, so another file is begun in its folder.

    :param output: in whose place it writes
    """

    def __init__(self, output: TensorBoardOutputFormat) -> None:
        self.writer, self._is_closed = output.writer, False

    def write(self, *args: Any, **kwargs: Any) -> None:
        folder = self.writer.log_dir
        with training_goes_on(f"TensorBoard's {folder}"):
            return super().write(*args, **kwargs)
        with contextlib.suppress(OSError):
            self.writer = type(self.writer)(log_dir=folder)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            super().close()


class ProgressCallback(BaseCallback):
    """
    Writes what the algorithm logs to a CSV file too, wherever else it goes, and sees to it that no log stops the training.

    :param path: file
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self.path = os.fspath(path)
        self._written: dict[str, Any] = {"keys": [], "text": ""}

    def state_dict(self) -> dict[str, Any]:
        """
        :return: what was written so far
        """
        # Not by its name: somebody may have removed it
        self._output.file.seek(0)
        self._written = {"keys": list(self._output.keys), "text": self._output.file.read()}
        if not os.path.exists(self.path):
            self._end()
            self._begin()
        return self._written

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`; to be set before the training starts
        """
        self._written = state

    def _begin(self) -> None:
        # A run of a stranger may have a link there, to a file that is not the run's
        Path(self.path).unlink(missing_ok=True)
        self._output = PatientCSV(self.path)
        self._output.keys = list(self._written["keys"])
        self._output.file.write(self._written["text"])
        self._output.file.flush()
        outputs = self.logger.output_formats
        outputs[:] = [PatientTensorBoard(out) if isinstance(out, TensorBoardOutputFormat) else out for out in outputs]
        outputs.append(self._output)

    def _end(self) -> None:
        if self._output in self.logger.output_formats:
            self.logger.output_formats.remove(self._output)
            self._output.close()

    def _on_training_start(self) -> None:
        self._begin()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._end()


class MetaTrialEvalCallback(TrialEvalCallback, MetaEvalCallback):
    """rl_zoo3's for a trial of a hyperparameter search, whose evaluations are those of :class:`MetaEvalCallback`."""
