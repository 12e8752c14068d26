"""rl_zoo3's ``train`` with one of our algorithms, and our manager, in it."""

import argparse
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import optuna
import rl_zoo3.train
from rl_zoo3 import exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER
from rl_zoo3.utils import ALGOS

from sb3_htr.adaptation.callbacks import MetaEvalCallback
from sb3_htr.common.checkpoint_callback import CheckpointCallback
from sb3_htr.common.progress import MetaProgressBarCallback
from sb3_htr.zoo.run.algorithm import Algorithm
from sb3_htr.zoo.run.callbacks import MetaTrialEvalCallback
from sb3_htr.zoo.run.manager import MetaExperimentManager
from sb3_htr.zoo.run.search_manager import SearchManager, pickle_study
from sb3_htr.zoo.run.study import journal
from sb3_htr.zoo.run.training_manager import TrainingManager


def run_rl_zoo(
    program: str,
    algorithm: Algorithm,
    arguments: list[str],
    method: str | None = None,
    resumed: Path | None = None,
    trust: bool = False,
) -> None:
    """
    rl_zoo3's train with one of our algorithms in it.

    :param program: name for its messages
    :param algorithm: the one that ``--algo`` names
    :param arguments: for it
    :param method: name of the method; that of the YAML file by default
    :param resumed: folder of the run that goes on, None for a new one
    :param trust: whether files may have code run
    """
    ALGOS[algorithm.name] = algorithm.model_class
    if algorithm.search_space is not None:
        HYPERPARAMS_CONVERTER[algorithm.name] = algorithm.search_space.convert

    def make_manager(args: argparse.Namespace, *rest: Any, **kwargs: Any) -> MetaExperimentManager:
        manager = SearchManager if args.optimize_hyperparameters else TrainingManager
        return manager(args, *rest, method=method, resumed=resumed, trust=trust, **kwargs)

    # rl_zoo3 looks these names up when it needs them
    replaced: dict[ModuleType, dict[str, Any]] = {
        exp_manager: {
            "EvalCallback": MetaEvalCallback,
            "TrialEvalCallback": MetaTrialEvalCallback,
            "CheckpointCallback": CheckpointCallback,
            "ProgressBarCallback": MetaProgressBarCallback,
            # It pickles studies alone
            "pkl": SimpleNamespace(dump=pickle_study),
        },
        optuna.storages.journal: {"JournalFileBackend": journal},
        rl_zoo3.train: {
            "ExperimentManager": make_manager,
            "ALGOS": {algorithm.name: algorithm.model_class},
            # Records are read by full names
            "argparse": SimpleNamespace(ArgumentParser=partial(argparse.ArgumentParser, allow_abbrev=False)),
        },
    }
    theirs = {module: {name: vars(module)[name] for name in ours} for module, ours in replaced.items()}
    before, sys.argv = sys.argv, [program, *arguments]
    try:
        for module, ours in replaced.items():
            vars(module).update(ours)
        rl_zoo3.train.train()
    finally:
        sys.argv = before
        for module, names in theirs.items():
            vars(module).update(names)
