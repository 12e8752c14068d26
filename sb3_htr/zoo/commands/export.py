"""``sb3-htr export``: a small file to share, and what to say about it."""

import argparse
import dataclasses
import json
import zipfile
from collections.abc import Sequence
from contextlib import nullcontext
from operator import attrgetter
from pathlib import Path
from typing import Any

from huggingface_hub.utils import validate_repo_id
from stable_baselines3 import SAC

from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import get_task_family
from sb3_htr.common.settings import keywords_of
from sb3_htr.common.vec_env import N_ENVS
from sb3_htr.zoo.commands.arguments import add_agent_arguments, make_parser, parse
from sb3_htr.zoo.run.agents import TrainedAgent
from sb3_htr.zoo.run.hub import CARD, FILM, files, model_name, push
from sb3_htr.zoo.run.model_card import model_card, training_command
from sb3_htr.zoo.run.record import RECORD

EXAMPLE = """  sb3-htr export runs/htr-ser/SparsePointRobot-v0_1 -o my_agent
  sb3-htr export runs --film --push-to-hub USER                    as USER/pearl-SparsePointRobot-v0
  sb3-htr export runs -o agent.zip                                 the file alone"""
# What a loaded model needs beside the arguments of its class
ALSO_KEPT = (
    *("observation_space", "action_space", "policy_class", "n_envs", "max_episode_steps"),
    *("num_timesteps", "_n_updates"),
)
# Of a run's record, what holds on other machines too
KEPT_OF_RECORD = ("env_id", "method", "env_kwargs", "gym_packages", "seed", "n_timesteps", "hyperparams", "versions")


def export(agent: TrainedAgent, path: Path) -> dict[str, Any]:
    """
    Write a model file without optimizer states, replay, statistics of training and local paths. ``load`` of its class reads
    it, and the commands find in it which env it is for. What acts is exact; the critics of SAC, whose values only rank tasks,
    are kept in half precision, and their targets are the same as they. Of rivals, what only training needs is left at its
    default.

    :param agent: to export
    :param path: file to write
    :return: its record
    """
    model = agent.load()
    for name in model._get_torch_save_params()[0]:
        if name.endswith("optimizer"):
            attrgetter(name)(model).state.clear()
    model.verbose = 0
    if isinstance(model, SAC):
        model.critic.half()
        for target, parameter in zip(model.critic_target.parameters(), model.critic.parameters(), strict=True):
            target.data = parameter.data
    kept = {*keywords_of(type(model)), *ALSO_KEPT} - {"tensorboard_log", *model.ACTS_WITH} | {*model.KEPT_TO_ACT}
    record = {key: agent.record[key] for key in KEPT_OF_RECORD if key in agent.record}
    which = "best on the validation tasks" if agent.path.stem == "best_model" else "last"
    record["command"] = training_command(agent.record)
    record |= {"model": agent.record.get("model", which), "num_timesteps": model.num_timesteps}
    with atomic_path(path) as temporary:
        full = temporary.with_suffix(".full.zip")
        try:
            model.save(full, exclude=[name for name in vars(model) if name not in kept])
            with zipfile.ZipFile(full) as source, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                for name in source.namelist():
                    archive.writestr(name, source.read(name))
                archive.writestr(RECORD, json.dumps(record, indent=1))
        finally:
            full.unlink(missing_ok=True)
    return record


def earlier_export(folder: Path, names: Sequence[str]) -> list[Path]:
    """
    :param folder: to write to
    :param names: of what an export writes
    :return: what an earlier export has left there
    :raises ValueError: if there is anything else in it, as a folder holds one model only
    """
    found = [path.name for path in folder.iterdir() if not path.name.startswith(".")] if folder.is_dir() else []
    others = sorted(set(found) - set(names))
    if others or (found and names[0] not in found):  # a page alone is somebody's own
        others = others or sorted(found)
        raise ValueError(f"{folder} holds other files, such as {others[0]}: give a folder of its own, with -o.")
    return [folder / name for name in found]


def _needs_trust(agent: TrainedAgent, device: str) -> bool:
    """Whether it is loaded in no other way."""
    try:
        dataclasses.replace(agent, trusted=False).load(device)
    except ValueError:
        return True
    return False


def _card(exported: TrainedAgent, args: argparse.Namespace, repo_id: str | None) -> str:
    """With the scores of what was exported."""
    model, env = exported.load(args.device), exported.make_vec_env(N_ENVS)
    tasks = get_task_family(env).test_tasks
    explorers = dict.fromkeys([model.explorer.name, *exported.algorithm.also_explores_by])
    scores = {explorer: record_adaptation(model, env, tasks, args.n_episodes, explorer=explorer) for explorer in explorers}
    return model_card(exported.record, scores, repo_id, args.trust and _needs_trust(exported, args.device))


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    description = "Write an agent as a small model file with a model card: scores after adaptation, how to load it."
    parser = make_parser("export", description, EXAMPLE)
    add_agent_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, help="folder, or .zip for the file alone (default: exported/ENV_ID)")
    parser.add_argument("--n-episodes", type=int, default=20, metavar="N", help="adaptation episodes for the scores (20)")
    parser.add_argument("--film", action="store_true", help="add replay.mp4, which the Hub shows (needs the extra video)")
    parser.add_argument("--push-to-hub", metavar="USER[/NAME]", help="upload; log in with `hf auth login` first")
    parser.add_argument("--private", action="store_true", help="with --push-to-hub: a private repository")
    args, agent = parse(parser, argv)
    if "hyperparams" not in agent.record:  # a model file of one's own, whose env is what is given
        agent = dataclasses.replace(agent, record={**agent.record, "env_kwargs": agent.env_kwargs})
    elif args.env_kwargs:
        raise ValueError(
            "--env-kwargs would make a card of another env than that of the training: leave it out, and see with "
            "`sb3-htr evaluate` what the agent does there."
        )
    output = args.output or Path("exported") / agent.stem
    alone = output.suffix == ".zip"
    if alone and (args.push_to_hub or args.film):
        raise ValueError(f"--push-to-hub and --film need a folder, but the output is the file {output}.")
    if alone and output.exists() and (output.parent / RECORD).exists():
        raise ValueError(f"{output} is a model of a run, which needs all of it to be trained further: give another -o.")
    name = model_name(agent.env_id, agent.algorithm.name)
    left = [] if alone else earlier_export(output, files(name))
    repo_id = args.push_to_hub
    if repo_id is not None:
        repo_id += "" if "/" in repo_id else f"/{name}"
        validate_repo_id(repo_id)
    file = output if alone else output / f"{name}.zip"
    # Both at once, as a model with the card of another is worse than none
    with atomic_path(file) as model_file, nullcontext() if alone else atomic_path(output / CARD) as page:
        record = export(agent, model_file)
        if page is not None:
            exported = dataclasses.replace(agent, path=model_file, record=record, folder=None)
            page.write_text(_card(exported, args, repo_id), encoding="utf-8")
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB, of {agent.path}")
    if alone:
        return
    # Not before there is a new card: what an earlier export has left tells of another model
    for path in left:
        if path not in (file, output / CARD):
            path.unlink()
    print(f"{output / CARD}: model card, with scores on the test tasks")
    if args.film:
        from sb3_htr.zoo.commands import record as recording

        packages = ["--gym-packages", *args.gym_packages] if args.gym_packages else []
        recording.main([str(file), "-o", str(output / FILM), "--verbose", "0", *["--trust"] * args.trust, *packages])
    if repo_id is not None:
        print(f"Uploaded to {push(output, repo_id, name, args.private)}")
