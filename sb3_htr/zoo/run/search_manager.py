"""A search for hyperparameters by rl_zoo3 and Optuna."""

import json
import pickle
import traceback
from pathlib import Path
from typing import IO, Any

import optuna
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.divergence import DivergedError
from sb3_htr.zoo.run.manager import MetaExperimentManager
from sb3_htr.zoo.run.method import merged, names_of
from sb3_htr.zoo.run.study import check_is_of


def pickle_study(study: optuna.Study, file: IO[bytes]) -> None:
    """
    In the place of the file that rl_zoo3 opens for it beside its report: that of a storage, which has the study, would have
    the password of a database in it, and is removed.

    :param study: that was searched
    :param file: for it
    """
    if isinstance(study._storage, optuna.storages.InMemoryStorage):
        pickle.dump(study, file)
    else:
        file.close()
        Path(file.name).unlink()


class SearchManager(MetaExperimentManager):
    """One worker of a study."""

    _interrupted = False

    def _check_use(self) -> None:
        if self.method.algorithm.search_space is None:
            raise ValueError(
                f"Nothing is known of what to search for {self.method.name}: give register_algorithm a search_space, or "
                "choose another --method."
            )
        if self.continue_training:
            raise ValueError("The trials of a search begin with new networks: leave -i out.")
        if self.n_jobs != 1:
            raise ValueError(
                f"--n-jobs is {self.n_jobs}, expected 1, as threads would draw from the same seeded generators: start several "
                "workers with one --storage."
            )

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        As in a training. They are what a study is of.

        :return: hyperparameters, and the same sorted to be saved
        """
        hyperparams, saved = super().read_hyperparameters()
        of_study = {"env_kwargs": self.env_kwargs, **saved, "not searched": sorted(names_of(self._given))}
        self._of_study = json.loads(json.dumps(of_study, default=str))
        return hyperparams, saved

    def create_log_folder(self) -> None:
        """Trials have none."""

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: number of envs
        :param eval_env: whether the envs are for evaluation
        :param no_log: whatever it is, no monitor file is written: envs for a look at their spaces are no run
        :return: the envs
        """
        return super().create_envs(n_envs, eval_env, no_log=True)

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: gives the hyperparameters
        :return: mean return of the last adaptation episode on the validation tasks
        :raises optuna.TrialPruned: for hyperparameters that promise little or diverge
        """
        try:
            return super().objective(trial)
        except DivergedError as error:
            print(f"Trial {trial.number} is pruned: {error}")
            raise optuna.TrialPruned from error
        except KeyboardInterrupt:
            self._interrupted = True
            raise

    def hyperparameters_optimization(self) -> None:
        """
        Search. Where the report goes is looked at first.

        :raises KeyboardInterrupt: after the report, if a trial was interrupted: a script should not go on
        """
        Path(self.log_folder, self.algo).mkdir(parents=True, exist_ok=True)
        if self.storage is not None:  # not before: what is refused by itself leaves the study to others
            facts = {"env": self.env_name.gym_id, "method": self.method.name, "settings": self._of_study}
            check_is_of(self.storage, self.study_name, facts, note=True)
        HYPERPARAMS_SAMPLER[self.algo] = lambda trial, *_: self._sampled(trial)
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if all(frame.name != "best_trial" for frame in traceback.extract_tb(error.__traceback__)):
                raise
            print("none: no trial was finished. The same command goes on.")
        if self._interrupted:  # rl_zoo3 ends as usual
            raise KeyboardInterrupt

    def _sampled(self, trial: optuna.Trial) -> dict[str, Any]:
        space = self.method.algorithm.search_space
        assert space is not None
        sampled = space.sample(trial, names_of(self._given) | self.method.not_searched())
        # To rl_zoo3, dicts of the file are gone where the sampler has one
        return merged(self._hyperparams, self._preprocess_schedules(sampled))

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        sampler = super()._create_sampler(sampler_method)
        if self.storage is not None:  # workers of one study, with one command, must not draw alike
            sampler.reseed_rng()
        return sampler
