"""``sb3-htr train``: rl_zoo3's training with the algorithm of a method in it, and with evaluations that adapt."""

import argparse
import difflib
import traceback
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import gymnasium as gym

from htr_envs.goal_env import NAMESPACE, find_hidden
from sb3_htr.common.checkpoint import n_steps_done
from sb3_htr.common.settings import check_numbers
from sb3_htr.zoo.run.agents import find_runs, is_finished, n_steps_of
from sb3_htr.zoo.run.method import DEFAULT, get_method, methods
from sb3_htr.zoo.run.record import OF_TRAINING, RECORD, arguments_to_go_on, command_to_go_on, read_record
from sb3_htr.zoo.run.rl_zoo import run_rl_zoo
from sb3_htr.zoo.run.study import absolute, check_has_no_password
from sb3_htr.zoo.run.train_arguments import check_options, default_arguments, spelled_out, value_of
from sb3_htr.zoo.run.trust import CONF, WEIGHTS, check_arguments, import_packages, see_working_folder

OWN_ENV = "An env of your own is found once its module is imported, by --gym-packages MODULE."
HELP = """sb3-htr train: rl_zoo3's train (its arguments follow) with evaluations that adapt to validation tasks.

examples:
  sb3-htr train --env SparsePointRobot-v0 -P
  sb3-htr train --env SparsePointRobot-v0 --method htr-ec -f runs --seed 1
  sb3-htr train --env SparsePointRobot-v0 --method rl2
  sb3-htr train --env HiddenGoal/FetchReach-v4
  sb3-htr train --env SparsePointRobot-v0 -params gamma:0.95 "policy_kwargs:{'latent_dim':3}"
  sb3-htr train --resume runs/htr-ser/SparsePointRobot-v0_1

defaults here: -conf, the YAML file in hyperparams/ of the method's algorithm; --num-threads 1 --save-freq 20000
               --eval-episodes 20, adaptation episodes on each validation task
beside rl_zoo3's:
  --method NAME  htr-ser (default), htr-ec, pearl-dense, pearl-sparse; rivals: htr-hfr, htr-hipi, rl2, sac-her. Those of PEARL
                 with -prior behind it under PEARL's own protocol
  --resume RUN   go on with a run from its latest checkpoint, exactly; takes no other arguments but --trust, the
                 --gym-packages of an env of your own, and -n STEPS: so many more than planned; a learning rate that decays
                 does so anew over what is then planned
  --trust        let files (YAML, the record of a run) import and evaluate what they name, which can run any code
no effect here: --n-eval-envs
"""


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of rl_zoo3's train; the YAML is this package's for the method unless given. Or ``--resume``
        and the folder of a run, which goes on from its latest checkpoint
    """
    parser = argparse.ArgumentParser(prog="sb3-htr train", add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--method")
    parser.add_argument("--trust", action="store_true")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--algo")
    parser.add_argument("--env")
    args, rest = parser.parse_known_args(argv)
    env = [] if args.env is None else ["--env", args.env]
    wants_help = bool({"-h", "--help"} & set(rest))
    program = "sb3-htr optimize" if "-optimize" in rest else "sb3-htr train"
    if wants_help and "-optimize" not in rest:
        print(HELP)
    # Before anything else: they may bring the method, too
    import_packages(args.gym_packages)
    algorithm = get_method(args.method or DEFAULT).algorithm
    if args.resume is None and args.algo not in (None, algorithm.name):
        raise ValueError(
            f"--algo is {args.algo!r}, but sb3-htr trains {algorithm.name}: choose a method, --method {', '.join(methods())}; "
            "`python -m rl_zoo3.train` has SB3's algorithms."
        )
    run: Path | None = None
    if args.resume is not None:
        more = argparse.ArgumentParser(prog="sb3-htr train --resume", add_help=False, allow_abbrev=False)
        more.add_argument("-n", "--n-timesteps", type=int, default=0)
        further, rest = more.parse_known_args(rest)
        rest += env
        if rest or args.method or args.algo:
            more_than_run = " ".join(rest) or ("--method" if args.method else "--algo")
            raise ValueError(f"train --resume goes on with the run's own arguments: leave {more_than_run} out.")
        run = find_runs(args.resume)[-1]
        record = read_record(run / RECORD)
        if not {*OF_TRAINING} <= record.keys():
            raise ValueError(f"{run} is no run of sb3-htr train, so there is nothing to go on with: give the folder of one.")
        check_numbers(**{"-n": (further.n_timesteps, 0)})
        planned = record["n_timesteps"] + further.n_timesteps
        if is_finished(run, record["env_id"], planned):
            done = n_steps_done(run)
            to_go_on = f"{command_to_go_on(run, record)} -n {done - record['n_timesteps'] + 1}"
            further_on = f"To train further, by so many steps or more: {to_go_on}"
            print(
                f"{run} is finished, after {n_steps_of(run, record['env_id']):,} env steps. "
                + (further_on if done else "Its checkpoints were removed, so it cannot be trained further.")
            )
            return
        given = [*arguments_to_go_on(record), "--seed", str(record["seed"]), "-n", str(planned)]
        check_arguments(given, record["gym_packages"], run / RECORD, args.trust, args.gym_packages)
        import_packages(args.gym_packages, record["gym_packages"], run / RECORD, args.trust)
        args.method = record["method"]
        algorithm = get_method(args.method).algorithm
        find_hidden(record["env_id"])
    else:
        if not wants_help and not env:
            raise ValueError("--env is missing: give the id of a task env, as in `sb3-htr train --env SparsePointRobot-v0`.")
        see_working_folder()  # for what -params and -conf name
        packages = ["--gym-packages", *args.gym_packages] if args.gym_packages else []
        rest = spelled_out(rest)
        check_options(rest)
        if "--track" in rest:
            check_has_no_password(value_of(rest, "--storage"))
        given = [*env, *_from_anywhere(rest), *packages]
        try:
            find_hidden(args.env or "")
        except gym.error.UnregisteredEnv as error:
            raise type(error)(f"{error} {OWN_ENV}") from None
        if env:
            _check_id(args.env)
    if (weights := value_of(given, *WEIGHTS)) is not None and not Path(weights).is_file():
        raise FileNotFoundError(f"There is no model {weights} to begin with: -i takes a file of `sb3-htr train` or `export`.")
    try:
        run_rl_zoo(program, algorithm, [*default_arguments(algorithm), *given], args.method, run, args.trust)
    except (NameError, SyntaxError) as error:
        # Text that rl_zoo3 evaluates, and no code of an env
        if isinstance(error, NameError) and traceback.extract_tb(error.__traceback__)[-1].filename != "<string>":
            raise
        raise ValueError(
            f"{error}: -params and --env-kwargs take name:value, where a value is Python, with strings in quotes, as in "
            "\"explorer:'prior'\"."
        ) from error


def _from_anywhere(arguments: Sequence[str]) -> list[str]:
    """The same with whole paths, as a run may go on from another folder."""
    words = list(arguments)
    for i, (option, word) in enumerate(pairwise(words), start=1):
        if option in ("-tb", "--tensorboard-log", *WEIGHTS) or (option in CONF and Path(word).is_file()):
            words[i] = str(Path(word).resolve())
        elif option == "--storage":
            words[i] = absolute(word)
    return words


def _check_id(env_id: str) -> None:
    if env_id in gym.registry:
        return
    hidden = f"{NAMESPACE}/" if env_id.startswith(f"{NAMESPACE}/") else ""
    module, colon, name = env_id.removeprefix(hidden).rpartition(":")
    if colon:
        raise ValueError(f"--env is {env_id!r}, with a module: give --gym-packages {module} --env {hidden}{name}.")
    nearest = difflib.get_close_matches(env_id, gym.registry, n=1)
    meant = f"did you mean {nearest[0]}? " if nearest else ""
    raise ValueError(f"There is no env {env_id}: {meant}{OWN_ENV}")
