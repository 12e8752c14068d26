"""A replay that is ordered by task and what was learnt of it, in a file of its own and in checkpoints."""

import io
import pathlib
import pickle
import zipfile
from typing import IO, Any, cast

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_htr.adaptation.task_bank import TaskBank
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.errors import memory_for
from sb3_htr.common.saving import with_suffix
from sb3_htr.common.training_state import Resumable
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer


class ReplayFiles(Resumable, OffPolicyAlgorithm):
    """An algorithm whose replay buffer is a :class:`sb3_htr.htr.MultiTaskReplayBuffer`."""

    SAVED_APART = dict.fromkeys(("replay_buffer", "task_bank"), "save_replay_buffer")
    #: None if the model has no env
    replay_buffer: MultiTaskReplayBuffer | None
    task_bank: TaskBank | None = None

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save replay and what was learnt of it, as plain arrays.

        :param path: file, ``.pt`` is added to a name without suffix; it is replaced at the end or not at all
        :raises ValueError: for a model that was loaded without an env, or a relabeller of one's own whose ``state_dict`` could
            not be read again
        """
        state = self._replay_state()
        if isinstance(path, io.IOBase):
            return th.save(state, cast(IO[bytes], path))
        with atomic_path(with_suffix(path, ".pt")) as temporary, open(temporary, "wb") as file:
            th.save(state, file)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        :param path: file of ``save_replay_buffer``; reading it runs no code
        :param truncate_last_traj: not used, only whole episodes are stored
        :raises ValueError: if it is no such file, or one of a model with other settings
        :raises MemoryError: if there is too little memory for it
        """
        own_replay, own_task_bank = self._replay()
        file: Any = path if isinstance(path, io.IOBase) else with_suffix(path, ".pt")
        try:
            # torch writes a zip file, and does not look at its checksums
            with zipfile.ZipFile(file) as archive:
                if archive.testzip() is not None:
                    raise EOFError
            if isinstance(file, io.IOBase):
                file.seek(0)
            with memory_for(path):
                state = th.load(file, weights_only=True)
            replay, task_bank = state["replay"], state["task_bank"]
        except (RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError, zipfile.BadZipFile):
            raise ValueError(
                f"{path} is damaged, or no replay buffer of sb3_htr: pass a file that save_replay_buffer has written."
            ) from None
        own_task_bank.check(task_bank)
        try:
            own_replay.load_state_dict(replay)
        except KeyError as missing:
            raise ValueError(f"{path} has no {missing}: make the model with the relabeller that it was saved with.") from None
        own_task_bank.load_state_dict(task_bank)

    def _replay(self) -> tuple[MultiTaskReplayBuffer, TaskBank]:
        if self.replay_buffer is None or self.task_bank is None:
            raise ValueError("This model has no env, so it has no replay buffer: pass env=... to load, or call set_env.")
        return self.replay_buffer, self.task_bank

    def _replay_state(self) -> dict[str, Any]:
        replay, task_bank = self._replay()
        return {"replay": replay.state_dict(), "task_bank": task_bank.state_dict()}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "task_bank"]

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), **self._replay_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        replay, task_bank = self._replay()
        super().load_state_dict(state)
        replay.load_state_dict(state["replay"])
        task_bank.load_state_dict(state["task_bank"])
