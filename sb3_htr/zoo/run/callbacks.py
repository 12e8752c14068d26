"""Callbacks that only runs of the command line need."""

import contextlib
import os
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from rl_zoo3.callbacks import TrialEvalCallback
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, TensorBoardOutputFormat

from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.errors import training_goes_on


class PatientCSV(CSVOutputFormat):
    """
    A disk that is full stops no training: all rows are in memory, so the next write makes up for one that failed, or for a
    file that somebody has removed.

    :param path: file, which is replaced
    :param keys: columns so far
    :param text: what the file had so far
    """

    file: Any

    def __init__(self, path: Path, keys: Sequence[str] = (), text: str = "") -> None:
        super().__init__(os.devnull)
        self.file.close()
        self.path, self.keys, self.file = path, list(keys), StringIO()
        self.file.write(text)
        self.is_whole = False
        self._put("")

    @property
    def text(self) -> str:
        """All of it, in the file or not."""
        return str(self.file.getvalue())

    def write(self, *args: Any, **kwargs: Any) -> None:
        before = self.text
        super().write(*args, **kwargs)
        self._put(before)

    def _put(self, before: str) -> None:
        """Into the file, which has what was before, unless that failed."""
        can_append = self.is_whole and self.path.exists() and self.text.startswith(before)
        self.is_whole = False
        with training_goes_on(str(self.path)):
            if can_append:
                with self.path.open("ab") as file:
                    file.write(self.text[len(before) :].encode())
            else:  # of a stranger's run it may be a link, to a file that is not the run's
                self.save()
            self.is_whole = True

    def save(self) -> None:
        """Write all of it."""
        with atomic_path(self.path) as temporary:
            temporary.write_bytes(self.text.encode())

    def close(self) -> None:
        if not self.is_whole:
            self._put("")


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
        self.path = Path(path)
        self._written: dict[str, Any] = {"keys": [], "text": ""}
        self._output: PatientCSV | None = None

    def state_dict(self) -> dict[str, Any]:
        """
        :return: what was written so far
        """
        assert self._output is not None, "a training has begun"
        return {"keys": list(self._output.keys), "text": self._output.text}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict`; to be set before the training starts
        """
        self._written = state

    def _on_training_start(self) -> None:
        self._output = PatientCSV(self.path, **self._written)
        outputs = self.logger.output_formats
        outputs[:] = [PatientTensorBoard(out) if isinstance(out, TensorBoardOutputFormat) else out for out in outputs]
        outputs.append(self._output)

    def _on_step(self) -> bool:
        return True

    def to_write(self) -> dict[str, Callable[[], None]]:
        """
        :return: the file, and what writes all of it anew, whatever became of it meanwhile
        """
        return {str(self.path): self._output.save} if self._output is not None else {}

    def _on_training_end(self) -> None:
        assert self._output is not None
        self.logger.output_formats.remove(self._output)
        self._output.close()


class MetaTrialEvalCallback(TrialEvalCallback, MetaEvalCallback):
    """rl_zoo3's for a trial of a hyperparameter search, whose evaluations are those of :class:`MetaEvalCallback`."""
