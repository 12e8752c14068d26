"""Models whose files are never half written, and loaded as what they are."""

import io
import pathlib
import sys
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv

from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.errors import last_line
from sb3_htr.common.settings import check_keywords, check_mappings, check_numbers, keywords_of

# What SB3's models have in place of the setting ``policy``
POLICY = "policy_class"


@contextmanager
def _settings_are_read(path: object, names: Iterable[str]) -> Iterator[None]:
    """SB3 warns of what cannot be unpickled, and goes on with the default in its place."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", rf"Could not deserialize object ({'|'.join(names)})\.", UserWarning)
        try:
            yield
        except UserWarning as error:
            if not str(error).startswith("Could not deserialize object"):  # where all warnings are errors
                raise
            name = str(error).split(". ")[0].split()[-1]
            given = f"custom_objects={{{name!r}: ...}}" if name == POLICY else f"{name}=..."
            raise ValueError(
                f"{path} has a {name} that cannot be read, as it is of another version of some package "
                f"({last_line(error)}): give all of it, as {given}, or load it by that version."
            ) from error


SelfCheckedFiles = TypeVar("SelfCheckedFiles", bound="CheckedFiles")


def with_suffix(path: Any, suffix: str) -> pathlib.Path:
    """
    :param path: of a file, a string or an ``os.PathLike``
    :param suffix: of such files
    :return: the path, with the suffix if it had none
    """
    path = pathlib.Path(path)
    return path if path.suffix else path.with_suffix(suffix)


def _beside(folder: pathlib.Path) -> pathlib.Path:
    """The model that ``save`` has put beside a folder of its name, where SB3 would try to read the folder."""
    path = with_suffix(folder, ".zip")
    if not path.is_file():
        models = sorted(file.name for file in folder.glob("*.zip"))
        raise IsADirectoryError(
            f"{folder} is a folder, expected a model file{f', such as one of {models} in it' * bool(models)}."
        )
    return path


def _check_is_no_file_of_torch(path: pathlib.Path) -> None:
    """Which is a zip file too. Of one without settings, SB3 does not say what it is."""
    file = path if path.exists() else with_suffix(path, ".zip")
    if not zipfile.is_zipfile(file):
        return
    with zipfile.ZipFile(file) as archive:
        if "data" not in archive.namelist():
            raise ValueError(
                f"{path} is no model: an agent that is adapted to a task is loaded by AdaptedAgent.load, and a replay buffer "
                "by the load_replay_buffer of a model."
            )


class CheckedFiles(BaseAlgorithm):
    """An algorithm whose ``save`` is atomic, and whose ``load`` takes neither files of others nor settings that it lacks."""

    #: Settings of the library's class that are none here, and why
    FOLLOWS: ClassVar[dict[str, str]] = {}
    #: Settings of training, which a model that is exported to act has in place of its own
    ACTS_WITH: ClassVar[dict[str, Any]] = {}
    #: Attributes, beside settings, that it acts by: ``export`` writes them, and loading by ``--trust`` or ``load`` reads them
    KEPT_TO_ACT: ClassVar[tuple[str, ...]] = ()
    #: Attributes that ``load`` makes anew, and what saves them
    SAVED_APART: ClassVar[dict[str, str]] = {}

    @classmethod
    def check_names(cls, given: Iterable[str], also: Iterable[str] = ()) -> None:
        """
        :param given: names of settings
        :param also: names that are known elsewhere
        :raises ValueError: for the first that it does not have
        """
        for name in given:
            if name in cls.FOLLOWS:
                raise ValueError(f"{cls.__name__} has no setting {name!r}: {cls.FOLLOWS[name]}.")
        check_keywords(cls.__name__, given, cls, also, without=cls.FOLLOWS)

    @classmethod
    def load(
        cls: type[SelfCheckedFiles],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfCheckedFiles:
        """
        It unpickles, which can run any code of the file. One of unknown origin is for ``load_untrusted`` of PEARL's.

        :param path: file of :meth:`save`
        :param env: to train on, or None to predict, adapt and evaluate
        :param device: torch device, or ``"auto"``
        :param custom_objects: in place of what the file has by these names
        :param print_system_info: print the system that it was saved on, and this one
        :param force_reset: reset the env before training goes on
        :param kwargs: settings in place of those of the file; of ``replay_buffer_kwargs``, those that are given
        :return: the model
        :raises ValueError: for an unknown setting, one that cannot be read, or a file of another algorithm
        :raises OSError: if there is no such file, or it is a folder
        """
        cls.check_names(kwargs, keywords_of(BaseAlgorithm.load))
        check_mappings(**{name: value for name, value in kwargs.items() if name.endswith("_kwargs")})
        if "stats_window_size" in kwargs:  # has another name in SB3's models
            kwargs["_stats_window_size"] = kwargs.pop("stats_window_size")
        if not isinstance(path, io.IOBase):
            if pathlib.Path(path).is_dir():
                path = _beside(pathlib.Path(path))
            _check_is_no_file_of_torch(pathlib.Path(path))
        if {"ent_coef", "replay_buffer_kwargs"} & kwargs.keys():
            theirs = cls._settings(path, custom_objects)
            if "ent_coef" in kwargs and isinstance(kwargs["ent_coef"], str) != isinstance(theirs.get("ent_coef"), str):
                raise ValueError(
                    f"ent_coef is {kwargs['ent_coef']!r}, and that of the file is of the other kind, a number or learnt "
                    "('auto'), which the rest of the file depends on: leave it out, or train anew."
                )
            if "replay_buffer_kwargs" in kwargs:
                of_both = (theirs.get("replay_buffer_kwargs"), kwargs["replay_buffer_kwargs"])
                kwargs["replay_buffer_kwargs"] = {name: x for given in of_both for name, x in (given or {}).items()}
        with _settings_are_read(path, {POLICY, *keywords_of(cls)} - kwargs.keys()):
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        state = vars(model)
        if "ent_coef_tensor" in state:  # SB3 has put that of the file in the place of one that was given
            state["ent_coef_tensor"] = th.tensor(float(state["ent_coef"]), device=model.device)
        return model

    @staticmethod
    def _settings(path: str | pathlib.Path | io.BufferedIOBase, custom_objects: dict[str, Any] | None) -> dict[str, Any]:
        """Of a file."""
        data, _, _ = load_from_zip_file(path, custom_objects=custom_objects, device="cpu")
        if isinstance(path, io.IOBase):
            path.seek(0)
        return data or {}

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            expected = f"expected one of {[*self.policy_aliases]}, or a class derived from theirs"
            raise ValueError(f"{type(self).__name__} has no policy {policy_name!r}: {expected}.")
        return self.policy_aliases[policy_name]

    def _setup_model(self) -> None:
        # Not in the constructor, as it can be given to load, too; of 0, logs would lack what they are to have
        check_numbers(stats_window_size=(self._stats_window_size, 1))
        self._stats_window_size = int(self._stats_window_size)  # no number of numpy, which a deque does not take
        self._check_policy_class()
        super()._setup_model()  # type: ignore[safe-super]

    def _check_policy_class(self) -> None:
        if not issubclass(self.policy_class, (*self.policy_aliases.values(),)):
            raise ValueError(
                f"{type(self).__name__} has no policies such as {self.policy_class.__name__}: is the file one of another "
                f"algorithm? Expected one of {[*self.policy_aliases]}, or a subclass of theirs."
            )

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
        :raises ValueError: for one that would not be loaded
        """
        include = [*(include or ())]
        for name in include:
            if name in self.SAVED_APART:
                raise ValueError(f"{name} is no part of a model's file, and not loaded: call {self.SAVED_APART[name]}.")
        # Bounds of spaces in full, as who does not trust the file reads them
        with np.printoptions(threshold=sys.maxsize, floatmode="unique", formatter=None):
            if isinstance(path, io.IOBase):
                return super().save(path, exclude, include)
            with atomic_path(with_suffix(path, ".zip")) as temporary:
                super().save(temporary, exclude, include)
