"""``sb3-htr plot``: pictures of one or several runs."""

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_htr.adaptation.adaptation import Adaptation
from sb3_htr.adaptation.evaluation import AdaptationRecord, record_adaptation, task_set
from sb3_htr.adaptation.loop import Adapting
from sb3_htr.common.arrays import load_arrays
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.vec_env import N_ENVS
from sb3_htr.common.versions import differences
from sb3_htr.zoo.commands.arguments import add_adaptation_arguments, add_agent_arguments, chosen_agent, make_parser
from sb3_htr.zoo.plots.adaptation import plot_adaptation_curve, plot_adaptation_paths, start_position
from sb3_htr.zoo.plots.curves import Curve, plot_curves
from sb3_htr.zoo.plots.latent import plot_latent_space
from sb3_htr.zoo.run.agents import TrainedAgent, runs_with_models
from sb3_htr.zoo.run.record import records_in
from sb3_htr.zoo.run.train_arguments import training_facts

EXAMPLE = """  sb3-htr plot --env SparsePointRobot-v0                  an agent that comes with the package
  sb3-htr plot runs/htr runs/sparse -l HTR "no relabelling"    the runs in a folder are the seeds of its curve
  sb3-htr plot runs --only learning -o pictures"""
EVALUATIONS = "evaluations.npz"
PICTURES = ("learning", "adaptation", "paths", "latent")
FORMATS = ("png", "svg", "pdf")


class Latent(NamedTuple):
    """
    Where the tasks of some adaptations are in the latent space, of those whose reward was found.

    :param tasks: (n, task_dim)
    :param mean: (n, latent_dim), posterior means after the last episode
    :param deviation: (n, latent_dim), their standard deviations
    :param known_z: (m, latent_dim), z of training tasks
    """

    tasks: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    known_z: np.ndarray


class Adapted(NamedTuple):
    """
    Adaptations of one agent to a set of tasks.

    :param tasks: (n_tasks, task_dim)
    :param goal_radius: radius of the goals, if the tasks are places with one
    :param start: where all episodes begin, if tasks are points of a plane
    :param explorer: that chose z
    :param record: what happened
    :param latent: None for an agent that has no latent space
    """

    tasks: np.ndarray
    goal_radius: float | None
    start: np.ndarray | None
    explorer: str
    record: AdaptationRecord
    latent: Latent | None


def adapt(agent: TrainedAgent, args: argparse.Namespace) -> Adapted:
    """
    :param agent: to adapt to all tasks of a set
    :param args: which set, and how
    :return: what happened
    """
    print(f"Adapting {agent.path}")
    model = agent.load(args.device)
    env = agent.make_vec_env(N_ENVS)
    family = get_task_family(env)
    tasks = task_set(family, args.tasks)
    latents: list[Latent] = []

    def look(adaptation: Adapting, own_tasks: np.ndarray) -> None:
        if isinstance(adaptation, Adaptation):
            particles = adaptation.knowledge.particles()
            found = ~adaptation.exploring()
            if adaptation.knowledge.tells_rewards:
                found &= adaptation.best_return > 0
            found = np.flatnonzero(found[: len(own_tasks)])
            mean, deviation = adaptation.posterior()
            known_z = particles.z[particles.is_train].cpu().numpy()
            latents.append(Latent(own_tasks[found], mean[found], deviation[found], known_z))

    how = args.n_episodes, args.explorer, not args.stochastic, args.seed
    record = record_adaptation(model, env, tasks, *how, look)
    env.close()
    latent = None
    if latents:
        of_tasks, mean, deviation, known_z = zip(*latents, strict=True)
        latent = Latent(np.concatenate(of_tasks), np.concatenate(mean), np.concatenate(deviation), known_z[0])
    start = None
    if record.achieved.shape[-1] == 2:
        with agent.make_env() as single:
            start = start_position(single)
    explorer = args.explorer or model.explorer.name
    return Adapted(tasks, getattr(family, "goal_radius", None), start, explorer, record, latent)


def groups_of(parser: argparse.ArgumentParser, args: argparse.Namespace) -> dict[str, list[TrainedAgent]]:
    """
    :param parser: for messages
    :param args: of the command
    :return: label and runs of each curve
    :raises ValueError: for runs that do not belong on one curve, or in one picture
    """
    paths = [path.resolve() for path in args.agent]
    labels = args.labels or [path.stem if path.suffix == ".zip" else path.name for path in paths] or [args.env]
    if len(labels) != max(len(args.agent), 1) or len(set(labels)) < len(labels):
        raise ValueError(f"--labels needs one name of its own for each of the {len(args.agent)} folders, got {labels}.")
    groups: dict[str, list[TrainedAgent]] = {}
    for label, path in zip(labels, args.agent or [None], strict=True):
        is_folder_of_runs = path is not None and path.is_dir() and any(records_in(path))
        paths = runs_with_models(path) if is_folder_of_runs else [path]
        groups[label] = [chosen_agent(parser, args, path) for path in paths]
        check_same_settings(label, groups[label])
    envs = {agent.env_id for agents in groups.values() for agent in agents}
    if len(envs) > 1:
        raise ValueError(f"These runs are of several envs, {', '.join(sorted(envs))}: plot one env at a time.")
    of_each = {label: agents[0].env_kwargs for label, agents in groups.items()}
    if any(kwargs != next(iter(of_each.values())) for kwargs in of_each.values()):
        print(f"The envs of these curves have different arguments, {of_each}: their tasks are not the same.", file=sys.stderr)
    records = [agent.record for agents in groups.values() for agent in agents]
    codes = [code for record in records for code in (record, *record.get("resumed_by", ()))]
    if other := dict.fromkeys(difference for code in codes for difference in differences(codes[0], code)):
        print(f"Not all of these runs were made by one code: {', '.join(other)}. Curves may differ by it.", file=sys.stderr)
    return groups


def check_same_settings(label: str, agents: Sequence[TrainedAgent]) -> None:
    """
    :param label: of the curve
    :param agents: runs that should differ in their seed alone
    :raises ValueError: if they differ in anything else, or not in it
    """
    records = [agent.record for agent in agents]
    facts = [training_facts(record.get("hyperparams", {}), record.get("arguments", ())) for record in records]
    settings = [{**of, "env_kwargs": record["env_kwargs"]} for of, record in zip(facts, records, strict=True)]
    different = {key for other in settings for key in {*settings[0], *other} if settings[0].get(key) != other.get(key)}
    different.discard("--eval-freq")  # a curve is of the evaluations that all have
    if different:
        raise ValueError(
            f"The runs in {label} differ in {sorted(different)}: put them into folders of their own, one per curve."
        )
    seeds = Counter(record["seed"] for record in records if "seed" in record)
    if twice := [seed for seed, n in seeds.items() if n > 1]:
        raise ValueError(
            f"Several runs in {label} have the seed {twice[0]}, as a copy of one has, and are no runs of their own: leave one "
            "of them there, or the interval is too narrow."
        )


def about_explorers(names: Iterable[str]) -> str:
    """
    :param names: explorer of each run
    :return: for a title
    """
    different = sorted(set(names))
    return f"explorer{'s' * (len(different) > 1)} {' and '.join(different)}"


def learning_curve(label: str, agents: Sequence[TrainedAgent]) -> Curve | None:
    """
    :param label: of the curve
    :param agents: runs
    :return: last adaptation episode on the validation tasks, at the env steps at which all of them were evaluated; None where
        there are no evaluations, as for the agents that come with the package
    :raises ValueError: if they have no evaluation in common
    """
    folders = [agent.folder for agent in agents if agent.folder is not None]
    evaluated = [folder for folder in folders if (folder / EVALUATIONS).exists()]
    runs = [load_arrays(folder / EVALUATIONS, ("timesteps", "returns", "successes")) for folder in evaluated]
    if not runs:
        return None
    for folder in (folder for folder in folders if folder not in evaluated):
        print(f"{folder} has no {EVALUATIONS}, and is not in the learning curve.", file=sys.stderr)
    ends = [int(run["timesteps"].max()) for run in runs]
    for folder, end in zip(evaluated, ends, strict=True):
        if end < max(ends):
            print(
                f"{folder} was evaluated up to {end:,} of {max(ends):,} env steps, where the curve of {label} ends: move it "
                "away to see the others to their end.",
                file=sys.stderr,
            )
    if len({run["returns"].shape[2] for run in runs}) > 1:
        raise ValueError(
            f"The runs in {label} were evaluated after different numbers of adaptation episodes: train them with one "
            "--eval-episodes."
        )
    steps = reduce(np.intersect1d, [run["timesteps"] for run in runs])
    if len(steps) == 0:
        raise ValueError(f"The runs in {label} were never evaluated at the same env step: train them with one --eval-freq.")
    at = [np.isin(run["timesteps"], steps) for run in runs]
    returns = np.stack([run["returns"][i][:, :, -1].mean(axis=1) for run, i in zip(runs, at, strict=True)])
    successes = np.stack([run["successes"][i][:, :, -1].mean(axis=1) for run, i in zip(runs, at, strict=True)])
    return Curve(steps / 1000, returns, successes, agents[0].method)


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    description = "Pictures of one or several runs: learning curves, return per adaptation episode, paths, latent space."
    parser = make_parser("plot", description, EXAMPLE)
    add_agent_arguments(parser, several=True)
    add_adaptation_arguments(parser, n_episodes=20)
    parser.add_argument("-l", "--labels", nargs="+", metavar="NAME", help="names of the curves (default: the folders')")
    parser.add_argument("-o", "--output", type=Path, default=Path("plots"), help="folder for the pictures (default: plots)")
    parser.add_argument("--format", choices=FORMATS, default="png", help="of the pictures (default: png)")
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=PICTURES, help="pictures to draw (default: all)")
    args = parser.parse_args(argv)
    if args.output.suffix[1:] in FORMATS:
        raise ValueError(f"-o is {args.output}, expected a folder: pictures have their own names, and --format is their kind.")
    groups = groups_of(parser, args)
    args.output.mkdir(parents=True, exist_ok=True)  # before any work
    env_id = next(iter(groups.values()))[0].env_id
    written: list[Path] = []

    def new(name: str) -> Path:
        written.append(args.output / f"{name}.{args.format}")
        return written[-1]

    if "learning" in args.only:
        learning = {label: curve for label, agents in groups.items() if (curve := learning_curve(label, agents)) is not None}
        if learning:
            names = [agent.explorer for agents in groups.values() for agent in agents]
            about = f"{env_id}, validation tasks, {about_explorers(names)}"
            x_label, y_label = "thousand env steps of meta-training", "return of the last adaptation episode"
            plot_curves(learning, new("learning_curves"), about, x_label, y_label)
        else:
            print("No learning curves: there is no evaluations.npz of a training.")
    if set(args.only) != {"learning"}:
        label, (first, *_) = next(iter(groups.items()))
        # Paths and latent space are those of the first run alone
        drawn = groups if "adaptation" in args.only else {label: [first]}
        adapted = {label: [adapt(agent, args) for agent in agents] for label, agents in drawn.items()}
        plot_adapted(args, env_id, adapted, {label: agents[0].method for label, agents in drawn.items()}, new)
    print("Pictures: " + (", ".join(str(path) for path in written) or "none"))


def plot_adapted(
    args: argparse.Namespace,
    env_id: str,
    adapted: dict[str, list[Adapted]],
    method_of: dict[str, str],
    new: Callable[[str], Path],
) -> None:
    """
    :param args: of the command
    :param env_id: env
    :param adapted: label and adaptations of the runs of each curve
    :param method_of: label and method of each curve
    :param new: gives the path of a picture
    """
    label, first = next((label, runs[0]) for label, runs in adapted.items())
    used = about_explorers(run.explorer for runs in adapted.values() for run in runs)
    about = f"{env_id}, {len(first.tasks)} {args.tasks} tasks, {used}"
    if "adaptation" in args.only:
        if sum(map(len, adapted.values())) == 1:
            plot_adaptation_curve(first.record, new("adaptation_curve"), about)
        else:
            curves = {}
            for name, runs in adapted.items():
                returns = np.stack([run.record.returns.mean(axis=0) for run in runs])
                successes = np.stack([run.record.successes.mean(axis=0) for run in runs])
                curves[name] = Curve(np.arange(1, args.n_episodes + 1), returns, successes, method_of[name])
            plot_curves(curves, new("adaptation_curve"), about, "adaptation episode", "return")
    if "paths" in args.only and first.record.achieved.shape[-1] == 2:
        # The label of --env is the env
        title = ", ".join(dict.fromkeys((env_id, label, f"{args.tasks} tasks", f"explorer {first.explorer}")))
        plot_adaptation_paths(first.record, first.tasks, first.goal_radius, first.start, new("adaptation_paths"), title)
    latent = first.latent
    if "latent" in args.only and latent is None:
        print(f"No latent space: {label} has none.")
    elif "latent" in args.only and latent is not None:
        found = len(latent.tasks)
        if found < 2:
            print(f"No latent space: {label} found the reward of {found} of {len(first.tasks)} tasks.")
        else:
            which = f"{found} of {len(first.tasks)} {args.tasks} tasks, whose reward was found"
            plot_latent_space(*latent, new("latent_space"), f"{env_id}: posteriors of {which}")
