"""What a training and a search by rl_zoo3 have of ours: hyperparameters, and task envs."""

import contextlib
import warnings
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from io import StringIO
from pathlib import Path
from pprint import pprint
from typing import Any

import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import SimpleLinearSchedule
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import htr_envs  # noqa: F401 registers the envs
from sb3_htr.common.settings import check_keywords, check_numbers, keywords_of
from sb3_htr.common.vec_env import N_ENVS, make_task_vec_env
from sb3_htr.zoo.run.method import DEFAULT, get_method, merged
from sb3_htr.zoo.run.record import RECORD
from sb3_htr.zoo.run.shipped import find_hyperparams
from sb3_htr.zoo.run.study import without_password
from sb3_htr.zoo.run.trust import plain_settings
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
    rl_zoo3's manager: hyperparameters of method, env and user, and task envs that are stepped as one batch, whose arguments in
    the YAML reach the evaluation too. What a training does with them, and what a search, subclasses say.
    """

    def __init__(
        self, *args: Any, method: str | None = None, resumed: Path | None = None, trust: bool = False, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.config = find_hyperparams(self.config)
        self.trust = trust
        self._method_name = method
        self.resumed = resumed

    def _check_use(self) -> None:
        """Refuse what they, or other arguments, are no use for here. Called when :attr:`method` is known."""

    def _settings_of_trial(self, trial_id: int | None) -> dict[str, Any]:
        """Hyperparameters of a trial of a study, if they are asked for."""
        return {}

    def _block_of_env(self) -> dict[str, Any]:
        """Of the YAML file, or of a module of hyperparameters."""
        with contextlib.redirect_stdout(StringIO()):  # it prints what is not all of it
            try:
                return super().read_hyperparameters()[0]
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
        hyperparams = self._block_of_env()
        in_file = hyperparams.pop("method", DEFAULT)
        in_params = given.pop("method", in_file)
        self.method = get_method(self._method_name or in_params)
        self.log_path = f"{Path(self.log_folder, self.method.name)}/"  # of an empty folder, not in the root
        if self.method.algorithm.name != self.algo:
            raise ValueError(f"{self.method.name} is trained by another algorithm: choose it by --method {self.method.name}.")
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
        if self.env_kwargs and "env_kwargs" in given and self.resumed is None:
            raise ValueError("-params has env_kwargs, and there is --env-kwargs: give all arguments of the env by the latter.")
        self._given = given
        self._check_use()
        of = self.storage and without_password(self.storage) if self.resumed is None else self.resumed / RECORD
        of_trial = checked(self._settings_of_trial(trial_id), of)
        hyperparams = merged(merged(hyperparams, of_trial), given)
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
        env = make_task_vec_env(
            self.env_name.gym_id,
            N_ENVS if eval_env else n_envs,
            seed=self.seed,
            monitor_dir=None if no_log or eval_env else self.save_path,
            env_kwargs=self.eval_env_kwargs if eval_env else self.env_kwargs,
            wrapper=self.env_wrapper,
            vec_env_class=SubprocVecEnv if self.args.vec_env == "subproc" else None,
        )
        return env if self.vec_env_wrapper is None else self.vec_env_wrapper(env)
