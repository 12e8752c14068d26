"""``sb3-htr evaluate``: adapt a trained agent to tasks that it has not seen."""

import argparse
import importlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import htr_envs  # noqa: F401 registers the envs
from sb3_htr import PEARL
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.evaluation import AdaptationRecord, record_adaptation
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.pearl.exploration import Explorer
from sb3_htr.zoo.plots import plot_adaptation_curve, plot_adaptation_paths


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    :param argv: arguments of the command
    :return: them, parsed
    """
    parser = argparse.ArgumentParser(prog="sb3-htr evaluate", description="Adapt a trained agent to unseen tasks.")
    parser.add_argument("run", type=Path, help="run folder; a folder of runs means the newest run in it")
    parser.add_argument("--model", choices=["best", "last"], default="best", help="best on validation tasks, or the last one")
    parser.add_argument("--tasks", choices=["test", "validation", "train"], default="test", help="tasks to adapt to")
    parser.add_argument("--n-episodes", type=int, default=20, help="adaptation episodes per task")
    parser.add_argument("--explorer", choices=[e.value for e in Explorer], help="by default the model's own")
    parser.add_argument("--seed", type=int, default=0, help="seed of the adaptation")
    return parser.parse_args(argv)


def find_run(folder: Path) -> Path:
    """
    :param folder: a run folder, or a folder with runs somewhere in it
    :return: the run folder, the newest one
    :raises FileNotFoundError: if there is none
    """
    runs = sorted(folder.rglob("run.json"), key=lambda path: path.stat().st_mtime)
    if not runs:
        raise FileNotFoundError(f"There is no run in {folder}: give the folder that `sb3-htr train` printed as 'Log path'.")
    return runs[-1].parent


def find_model(run: Path, env_id: str, which: str) -> Path:
    """
    :param run: run folder
    :param env_id: env that it was trained on
    :param which: ``"best"`` or ``"last"``
    :return: model file; where the run has no best model yet or was cut off, what there is
    :raises FileNotFoundError: if it has none at all
    """
    best, last = run / "best_model.zip", run / f"{env_id}.zip"
    checkpoints = sorted(run.glob("checkpoints/*/rl_model.zip"), key=lambda path: path.stat().st_mtime, reverse=True)
    candidates = [best, last, *checkpoints] if which == "best" else [last, *checkpoints, best]
    for path in candidates:
        if path.exists():
            return path
    raise FileNotFoundError(f"{run} has no model yet: train for longer than one evaluation (--eval-freq).")


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
    return "\n".join(lines)


def main(argv: Sequence[str]) -> None:
    """
    :param argv: arguments of the command
    """
    args = parse(argv)
    run = find_run(args.run)
    settings = json.loads((run / "run.json").read_text())
    env_id = settings["env_id"]
    for package in settings["gym_packages"]:
        importlib.import_module(package)
    model_path = find_model(run, env_id, args.model)
    model = PEARL.load(model_path, device="cpu")
    env: VecEnv = make_task_vec_env(env_id, 20, env_kwargs=settings["env_kwargs"])
    statistics = run / env_id / "vecnormalize.pkl"
    if statistics.exists():
        env = VecNormalize.load(str(statistics), env)
        env.training = False
    family = get_task_family(env)
    tasks = getattr(family, f"{args.tasks}_tasks")
    explorer = args.explorer or model.explorer
    record = record_adaptation(model, env, tasks, args.n_episodes, explorer=explorer, seed=args.seed)

    print(f"{model_path}: adapting to {len(tasks)} {args.tasks} tasks of {env_id}, explorer {explorer!r}")
    print(table(record))
    with atomic_path(run / "adaptation.npz") as path:
        np.savez_compressed(path, tasks=tasks, **record._asdict())
    pictures = [run / "adaptation_curve.png"]
    plot_adaptation_curve(record, pictures[0], f"{env_id}: {len(tasks)} {args.tasks} tasks, explorer {explorer!r}")
    if tasks.shape[1] == 2:
        pictures.append(run / "adaptation_paths.png")
        plot_adaptation_paths(record, tasks, getattr(family, "goal_radius", None), pictures[1])
    print("Pictures: " + ", ".join(str(picture) for picture in pictures))
