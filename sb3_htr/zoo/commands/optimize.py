"""``sb3-htr optimize``: search for hyperparameters with rl_zoo3 and Optuna."""

import argparse
import importlib
import logging
import shlex
import time
from collections.abc import Sequence

import optuna
import sqlalchemy

from sb3_htr.zoo.commands import train
from sb3_htr.zoo.run.study import opened, url_of, without_password

HELP = """sb3-htr optimize: rl_zoo3's `train -optimize` (its arguments follow) for methods of ours, with Optuna.

The objective is the mean return of the last adaptation episode on the validation tasks; the test tasks stay unseen.
The search space is that of the method's algorithm, in sb3_htr/zoo/run/search_space.py. What it does not name stays as in
the YAML file. What -params names stays as given, and is not searched.

examples:
  sb3-htr optimize --env SparsePointRobot-v0 -n 60000 --n-trials 20
  sb3-htr optimize --env SparsePointRobot-v0 -n 60000 --study-name htr --storage sqlite:///study.db --max-total-trials 50
  sb3-htr optimize ... -params gradient_steps:200 "policy_kwargs:{'net_arch':[64,64]}"
  sb3-htr optimize ... --method rl2 -n 400000
  sb3-htr optimize ... --study-name htr --storage postgresql+psycopg://user:password@host/database
  sb3-htr train --env SparsePointRobot-v0 --study-name htr --storage sqlite:///study.db --trial-id 7

storages: sqlite:///FILE on one machine, postgresql+psycopg://... on several (pip install 'sb3_htr[postgresql]'), FILE.log on a
shared folder. Start the same command as often as you like: the workers share the study. Without --storage, it is not kept.
defaults here: --n-evaluations 5 (of each trial, for pruning), and those of sb3-htr train
"""
# Workers that begin at once make the same tables, and all but one fail
ATTEMPTS, PAUSE = 6, 0.5


def create_study(storage: str, name: str) -> optuna.Study:
    """
    Make the study if there is none yet, several workers at once if need be.

    :param storage: file of a journal, or URL of a database
    :param name: of the study
    :return: the study
    :raises ValueError: if the database cannot be used
    """
    if (url := url_of(storage)) is not None and url.get_backend_name() == "postgresql":
        importlib.import_module(url.get_driver_name())
    attempt = 1
    while True:
        try:
            return optuna.create_study(study_name=name, storage=opened(storage), direction="maximize", load_if_exists=True)
        except sqlalchemy.exc.SQLAlchemyError as error:
            if attempt == ATTEMPTS:
                reason = " ".join(str(getattr(error, "orig", None) or error).split())
                raise ValueError(f"The storage {without_password(storage)} cannot be used: {reason}") from None
        time.sleep(PAUSE * attempt)
        attempt += 1


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of rl_zoo3's train
    """
    if {"-h", "--help"} & set(argv):
        print(HELP)
    parser = argparse.ArgumentParser(prog="sb3-htr optimize", add_help=False, allow_abbrev=False)
    parser.add_argument("--env")
    parser.add_argument("--storage")
    parser.add_argument("--study-name")
    parser.add_argument("--method")
    parser.add_argument("-params", "--hyperparams", nargs="+")
    parser.add_argument("--env-kwargs", nargs="+")
    parser.add_argument("--gym-packages", nargs="+")
    parser.add_argument("-conf", "--conf-file", nargs=1)
    args, _ = parser.parse_known_args(argv)
    if args.storage and not args.study_name:
        raise ValueError(
            "--storage needs a --study-name, by which other workers and `sb3-htr train --trial-id` find the study."
        )
    study = create_study(args.storage, args.study_name) if args.storage and args.env else None  # which is asked for below
    # It was said above whether the study is new; to rl_zoo3 it never is
    logger = logging.getLogger("optuna.study.study")
    logger.addFilter(_is_news)
    try:
        # Later arguments win, so this is a default
        train.main(["-optimize", "--n-evaluations", "5", *argv])
    finally:
        logger.removeFilter(_is_news)
    if study is None:
        return
    if n_running := len(study.get_trials(states=[optuna.trial.TrialState.RUNNING])):
        print(f"{n_running} trials are running, or their workers were killed: --max-total-trials counts them all the same.")
    values = [trial.value for trial in study.get_trials(states=[optuna.trial.TrialState.COMPLETE])]
    if not values:  # which was said above
        return
    if not any(values):
        print(f"No trial learnt anything: the return after adaptation is 0 in all {len(values)}. Make the trials longer (-n).")
    else:
        command = ["sb3-htr", "train", "--env", args.env, *(["--method", args.method] if args.method else [])]
        command += ["--study-name", args.study_name, "--storage", without_password(args.storage)]
        command += ["--trial-id", str(study.best_trial.number)]
        given = {"--gym-packages": args.gym_packages, "-conf": args.conf_file, "--env-kwargs": args.env_kwargs}
        for option, values in {**given, "-params": args.hyperparams}.items():
            command += [option, *values] if values else []
        print(f"Train with the best trial so far: {shlex.join(command)}")


def _is_news(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith("Using an existing study")
