"""Files that are never half written, and checkpoints made of them."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Write to a temporary name and rename at the end, so that a killed process leaves the old file or the new one.

    :param path: file or folder to make; its parent folders are made too
    :return: path to write to, with the same suffix; removed if writing fails
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        for file in temporary.rglob("*") if temporary.is_dir() else [temporary]:
            with open(file, "rb") as handle:
                os.fsync(handle.fileno())
        if path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


class CheckpointCallback(BaseCallback):
    """
    Saves model and replay buffer together, between rollouts, as ``<save_path>/checkpoints/<steps>_steps/``.

    :param save_freq: smallest number of calls (steps of the VecEnv) between two checkpoints
    :param save_path: folder of the run
    :param name_prefix: name of the model's file
    :param keep: number of checkpoints to keep, the latest ones
    :param verbose: 1 says where checkpoints are written
    """

    def __init__(self, save_freq: int, save_path: str, name_prefix: str = "rl_model", keep: int = 2, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.save_freq = save_freq
        self.folder = Path(save_path) / "checkpoints"
        self.name_prefix = name_prefix
        self.keep = keep
        self._last_calls = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        # A rollout begins with a reset of all envs, so nothing is lost by stopping just before it
        if self.n_calls - self._last_calls < self.save_freq:
            return
        self._last_calls = self.n_calls
        assert isinstance(self.model, OffPolicyAlgorithm)
        with atomic_path(self.folder / f"{self.num_timesteps}_steps") as folder:
            folder.mkdir()
            self.model.save(folder / f"{self.name_prefix}.zip")
            self.model.save_replay_buffer(folder / "replay_buffer.pkl")
        if self.verbose > 0:
            print(f"Checkpoint: {self.folder / f'{self.num_timesteps}_steps'}")
        checkpoints = sorted(self.folder.glob("*_steps"), key=lambda path: int(path.name.split("_")[0]))
        for old in checkpoints[: -self.keep]:
            shutil.rmtree(old)
