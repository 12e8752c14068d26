"""Arguments that the commands about a trained agent share, named as in rl_zoo3."""

import argparse
import ast
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from htr_envs.goal_env import find_hidden
from sb3_htr.adaptation.evaluation import TASK_SETS
from sb3_htr.adaptation.explorers import EXPLORERS
from sb3_htr.common.checks import check_device
from sb3_htr.common.random_state import MAX_SEED
from sb3_htr.common.settings import check_numbers
from sb3_htr.zoo.run.agents import TrainedAgent, agent_at, agent_for
from sb3_htr.zoo.run.trust import check_env_kwargs, import_packages, refuse

OF_PACKAGES = "modules of your own that register envs, methods or experiments"


class KeyValues(argparse.Action):
    """``key:value ...``, where a value is a Python literal, or else text."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        pairs = {}
        if getattr(namespace, self.dest):
            parser.error(f"{option_string} is given twice, and only the last would count: give all pairs behind one")
        for text in values:
            key, colon, value = text.partition(":")
            if not colon:
                parser.error(f"{option_string} has {text!r}, expected key:value")
            if value in ("true", "false", "none", "null"):
                told = f"expected True, False or None, or {key}:\"'{value}'\" for the text"
                parser.error(f"{option_string} has {text!r}, which would be a text: {told}")
            try:
                pairs[key] = ast.literal_eval(value)
            except (ValueError, SyntaxError):
                pairs[key] = value
        setattr(namespace, self.dest, pairs)


def make_parser(
    command: str, description: str, example: str, parents: Sequence[argparse.ArgumentParser] = ()
) -> argparse.ArgumentParser:
    """
    :param command: name of the command
    :param description: what it does
    :param example: command lines
    :param parents: parsers whose arguments it has
    :return: parser without other arguments
    """
    return argparse.ArgumentParser(
        prog=f"sb3-htr {command}",
        description=description,
        epilog=f"examples:\n{example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        parents=parents,
        allow_abbrev=False,
    )


def add_agent_arguments(parser: argparse.ArgumentParser, several: bool = False) -> None:
    """
    :param parser: gets the arguments that say which agent is meant
    :param several: whether more than one may be given
    """
    what = "run folder, folder of runs (the newest is taken), or model file; or give --env"
    if several:
        what = "run folder, folder of runs (the seeds of one curve), or model file; or give --env"
    parser.add_argument("agent", nargs="*" if several else "?", type=Path, help=what)
    group = parser.add_argument_group("which agent")
    group.add_argument("--env", metavar="ID", help="look for an agent of this env in the log folder, then in trained_agents/")
    group.add_argument("-f", "--folder", type=Path, default=Path("logs"), help="log folder (default: logs)")
    group.add_argument("--exp-id", type=int, default=0, metavar="N", help="number of the run, 0 (default) for the latest")
    group.add_argument("--method", metavar="NAME", help="method that it was trained by, such as htr-ec")
    group.add_argument("--algo", help=argparse.SUPPRESS)  # of rl_zoo3's commands
    group.add_argument("--model", choices=["best", "last"], default="best", help="of a run: best on validation tasks, or last")
    group.add_argument("--load-best", dest="model", action="store_const", const="best", help="the same as --model best")
    group.add_argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help=OF_PACKAGES)
    group.add_argument(
        "--env-kwargs", nargs="+", action=KeyValues, default={}, metavar="KEY:VALUE", help="change arguments of the env"
    )
    trust = "let the files of the agent import and unpickle what they name, which can run any code"
    group.add_argument("--trust", action="store_true", help=trust)
    group.add_argument("--device", default="cpu", help="torch device (default: cpu)")


def add_adaptation_arguments(parser: argparse.ArgumentParser, n_episodes: int) -> None:
    """
    :param parser: gets the arguments that say how to adapt
    :param n_episodes: default of the number of episodes
    """
    group = parser.add_argument_group("adaptation")
    group.add_argument("--tasks", choices=TASK_SETS, default="test", help="set of tasks to adapt to (default: test)")
    group.add_argument("--n-episodes", type=int, default=n_episodes, metavar="N", help=f"per task (default: {n_episodes})")
    explorers = f"{', '.join(EXPLORERS)}, or one of your own; by default the model's"
    group.add_argument("--explorer", metavar="NAME", help=explorers)
    group.add_argument("--stochastic", action="store_true", help="sample actions instead of taking their mean")
    group.add_argument("--seed", type=int, default=0, help="of env, z and sampled actions (default: 0)")


def add_task_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: gets the arguments that say which tasks to play
    """
    add_adaptation_arguments(parser, n_episodes=8)
    group = parser.add_argument_group("tasks")
    group.add_argument("--n-tasks", type=int, default=3, metavar="N", help="the first N of the set (default: 3)")
    group.add_argument("--task", type=int, nargs="+", metavar="N", help="numbers of tasks in the set, from 1 on")
    group.add_argument("-n", "--n-timesteps", type=int, metavar="N", help="stop after N steps (default: play all tasks)")
    group.add_argument("--verbose", type=int, default=1, help="0 prints nothing, 1 (default) a line for each episode")


def chosen_agent(parser: argparse.ArgumentParser, args: argparse.Namespace, path: Path | None) -> TrainedAgent:
    """
    :param parser: for the message if arguments are missing
    :param args: of :func:`add_agent_arguments`
    :param path: what was given as agent, if anything
    :return: the agent; its env is registered
    :raises ValueError: if arguments contradict each other, or the device cannot be used
    """
    if args.algo is not None:
        raise ValueError(
            f"--algo {args.algo} chooses nothing here, as each run knows its algorithm: leave it out, or give --method NAME."
        )
    check_device(args.device)
    for name, limits in {"n_episodes": (1,), "n_timesteps": (1,), "fps": (0.1,), "seed": (0, MAX_SEED)}.items():
        if getattr(args, name, None) is not None:
            check_numbers(**{f"--{name.replace('_', '-')}": (getattr(args, name), *limits)})
    import_packages(args.gym_packages)
    if path is not None:
        if args.exp_id or args.method:
            raise ValueError(
                f"{path} says which agent, so --exp-id and --method choose nothing: leave them out, or give -f FOLDER --env "
                "ID in its place, where they choose among runs."
            )
        agent = agent_at(path, args.model, args.env)
        if args.env not in (None, agent.env_id):
            raise ValueError(
                f"{agent.path} was trained on {agent.env_id}, but --env is {args.env}: leave one of the two out "
                f"(-f FOLDER --env ID looks for agents of an env)."
            )
    elif args.env is not None:
        agent = agent_for(args.env, args.folder, args.method, args.exp_id, args.model)
    else:
        parser.error("say which agent: a run folder or model file, or --env ID")
    if not args.trust:
        if ":" in agent.env_id:
            raise refuse(agent.path, f"is for the env {agent.env_id!r}")
        check_env_kwargs(agent.record["env_kwargs"], agent.path, args.gym_packages)
    import_packages(args.gym_packages, agent.record["gym_packages"], agent.path, args.trust)
    find_hidden(agent.env_id)
    return dataclasses.replace(agent, other_env_kwargs=args.env_kwargs, trusted=args.trust)


def parse(parser: argparse.ArgumentParser, argv: Sequence[str]) -> tuple[argparse.Namespace, TrainedAgent]:
    """
    :param parser: with the arguments of :func:`add_agent_arguments`, for one agent
    :param argv: arguments of the command
    :return: them, parsed, and the agent that they name
    """
    args = parser.parse_args(argv)
    return args, chosen_agent(parser, args, args.agent)
