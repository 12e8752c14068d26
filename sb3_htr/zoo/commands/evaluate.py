"""``sb3-htr evaluate``: adapt a trained agent to tasks that it has not seen."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sb3_htr.adaptation.evaluation import AdaptationRecord, record_adaptation, task_set
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.vec_env import N_ENVS
from sb3_htr.zoo.commands.arguments import add_adaptation_arguments, add_agent_arguments, make_parser, parse
from sb3_htr.zoo.plots.adaptation import plot_adaptation_curve, plot_adaptation_paths, start_position

EXAMPLE = """  sb3-htr evaluate logs
  sb3-htr evaluate --env SparsePointRobot-v0 --explorer prior"""


def table(record: AdaptationRecord) -> str:
    """
    :param record: adaptations
    :return: one line per adaptation episode
    """
    low, high = np.quantile(record.returns, [0.25, 0.75], axis=0)
    found = np.maximum.accumulate(record.successes, axis=1).mean(axis=0)
    lines = ["episode   mean return   middle half of tasks   solved   solved so far"]
    for i in range(record.returns.shape[1]):
        spread = f"{low[i]:.2f} .. {high[i]:.2f}"
        lines.append(
            f"{i + 1:7d}   {record.returns[:, i].mean():11.2f}   {spread:>20}   {record.successes[:, i].mean():6.0%}"
            f"   {found[i]:13.0%}"
        )
    if not record.successes.any():
        lines.append("info['is_success'] tells of none: no task was solved, or the env does not say which are.")
    return "\n".join(lines)


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    parser = make_parser("evaluate", "Adapt a trained agent to unseen tasks: a table, pictures and the data.", EXAMPLE)
    add_agent_arguments(parser)
    add_adaptation_arguments(parser, n_episodes=20)
    parser.add_argument("-o", "--output", type=Path, help="folder for the files (default: the run folder, or ./ENV_ID)")
    args, agent = parse(parser, argv)
    model = agent.load(args.device)
    env = agent.make_vec_env(N_ENVS)
    family = get_task_family(env)
    tasks = task_set(family, args.tasks)
    explorer = args.explorer or model.explorer.name
    output = args.output or agent.folder or Path(agent.stem)
    # What is not by default is in the names, or one evaluation of a run would replace another
    is_last = agent.folder is not None and agent.path.name != "best_model.zip"
    choices = {
        "last" if is_last else "best": parser.get_default("model"),
        args.tasks: parser.get_default("tasks"),
        explorer: model.explorer.name,
    }
    which = "".join(f"-{choice}" for choice, default in choices.items() if choice != default)
    # Around all, as what cannot be written should be known before the work
    with atomic_path(output / f"adaptation{which}.npz") as path:
        record = record_adaptation(
            model, env, tasks, args.n_episodes, explorer=explorer, deterministic=not args.stochastic, seed=args.seed
        )
        print(f"{agent.path}: adapting to {len(tasks)} {args.tasks} tasks of {agent.env_id}, explorer {explorer!r}")
        print(table(record))
        about = {"model": str(agent.path), "env_id": agent.env_id, "explorer": explorer, "set": args.tasks, "seed": args.seed}
        about |= {"env_kwargs": json.dumps(agent.env_kwargs, default=str), "deterministic": not args.stochastic}
        np.savez_compressed(path, tasks=tasks, **record._asdict(), **about)
    env.close()
    pictures = [output / f"adaptation_curve{which}.png"]
    title = (
        f"{agent.env_id}, {len(tasks)} {args.tasks} tasks, explorer {explorer}{', sampled actions' if args.stochastic else ''}"
    )
    title += "".join(f", {name} {value}" for name, value in agent.other_env_kwargs.items())
    plot_adaptation_curve(record, pictures[0], title)
    if record.achieved.shape[-1] == 2:
        pictures.append(output / f"adaptation_paths{which}.png")
        with agent.make_env() as single:
            start = start_position(single)
        plot_adaptation_paths(record, tasks, getattr(family, "goal_radius", None), start, pictures[1], title)
    print("Pictures: " + ", ".join(str(picture) for picture in pictures))
