"""Saving and loading of models and replay buffers."""

import inspect
import io
import json
import os
import pathlib
import pickle
import zipfile
from collections.abc import Iterable
from typing import IO, TYPE_CHECKING, Any, cast

import torch as th
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.sac import SAC

from sb3_htr.common.atomic import atomic_path

if TYPE_CHECKING:
    from sb3_htr.pearl.pearl import PEARL
    from sb3_htr.pearl.task_bank import TaskBank

# Arguments of PEARL that a file of unknown origin may set: numbers and names, no classes
POLICY_KWARGS = ("latent_dim", "net_arch", "encoder_arch")


class SavesToFiles(SAC):
    """Files that are replaced at the end or not at all; replay buffers without pickle."""

    task_bank: "TaskBank | None"

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        :param path: file, ``.zip`` is added to a name without suffix; it is replaced at the end or not at all
        :param exclude: attributes to leave out
        :param include: attributes to save that would be left out
        """
        if isinstance(path, io.IOBase):
            return super().save(path, exclude, include)
        path = pathlib.Path(path)
        with atomic_path(path if path.suffix else path.with_suffix(".zip")) as temporary:
            super().save(temporary, exclude, include)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save replay and what was learnt of it, as plain arrays.

        :param path: file, ``.pt`` is added to a name without suffix; it is replaced at the end or not at all
        """
        assert self.replay_buffer is not None and self.task_bank is not None
        state = {"replay": self.replay_buffer.state_dict(), "task_bank": self.task_bank.state_dict()}  # type: ignore[attr-defined]
        if isinstance(path, io.IOBase):
            return th.save(state, cast(IO[bytes], path))
        path = pathlib.Path(path)
        with atomic_path(path if path.suffix else path.with_suffix(".pt")) as temporary:
            th.save(state, temporary)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        :param path: file of ``save_replay_buffer``; reading it runs no code
        :param truncate_last_traj: not used, only whole episodes are stored
        :raises ValueError: if it is no such file, or one of a model with other settings
        """
        if self.replay_buffer is None or self.task_bank is None:
            raise ValueError(
                "This model has no env, so it has no replay buffer to fill: pass env=... to load, or call set_env."
            )
        file: Any = path
        if not isinstance(path, io.IOBase):
            file = pathlib.Path(path)
            file = file if file.suffix else file.with_suffix(".pt")
        try:
            state = th.load(file, weights_only=True)
            replay, task_bank = state["replay"], state["task_bank"]
        except (RuntimeError, EOFError, KeyError, TypeError, pickle.UnpicklingError):
            raise ValueError(
                f"{path} is damaged, or no replay buffer of sb3_htr: pass a file that save_replay_buffer has written."
            ) from None
        try:
            self.replay_buffer.load_state_dict(replay)  # type: ignore[attr-defined]
        except KeyError as missing:
            raise ValueError(
                f"{path} has no {missing}: make the model with the replay_buffer_class that it was saved with."
            ) from None
        self.task_bank.load_state_dict(task_bank)


def load_untrusted(
    path: str | os.PathLike[str], env: GymEnv | str, device: th.device | str = "auto", **kwargs: Any
) -> "PEARL":
    """
    Load a model of unknown origin: weights and plain settings, without running code of the file.

    SB3's ``load`` unpickles what is no plain JSON in the file, and a pickle can run anything. This function reads the numbers
    and names among the settings, makes a new model with them and fills in the weights. Schedules, classes and optimizers are
    left out.

    :param path: file of ``PEARL.save``
    :param env: env of the same spaces; its spaces are not read from the file
    :param device: torch device
    :param kwargs: arguments of PEARL, in place of those of the file
    :return: a model to predict, adapt and evaluate with
    :raises ValueError: if it is no such file, or its weights do not fit
    """
    from sb3_htr.pearl.pearl import PEARL

    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
            weights = th.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError, pickle.UnpicklingError):
        raise ValueError(f"{path} is damaged, or no model saved by PEARL: nothing of it was loaded.") from None
    arguments = set(inspect.signature(PEARL.__init__).parameters) - {"policy", "env", "device", "tensorboard_log"}
    settings = {name: data[name] for name in arguments & data.keys() if isinstance(data[name], int | float | str)}
    given = data.get("policy_kwargs", {})
    settings["policy_kwargs"] = {name: given[name] for name in POLICY_KWARGS if name in given}
    model = PEARL("MlpPolicy", env, device=device, **{**settings, **kwargs})
    try:
        model.policy.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(
            f"The weights in {path} do not fit the env or the settings: {str(error).splitlines()[1].strip()}"
        ) from None
    return model
