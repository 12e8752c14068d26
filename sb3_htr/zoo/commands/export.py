"""``sb3-htr export``: a small file to share, and what to say about it."""

import json
import zipfile
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from stable_baselines3 import SAC

from sb3_htr.adaptation.evaluation import record_adaptation
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.checks import get_task_family, keywords_of
from sb3_htr.zoo.commands.arguments import add_agent_arguments, make_parser, parse
from sb3_htr.zoo.run.agents import RECORD, TrainedAgent
from sb3_htr.zoo.run.model_card import model_card, training_command

EXAMPLE = """  sb3-htr export runs/htr-ser/SparsePointRobot-v0_1 -o my_agent
  sb3-htr export runs --film --push-to-hub USER/pearl-SparsePointRobot-v0
  sb3-htr export runs -o agent.zip                                 the file alone"""
# What a loaded model needs beside the arguments of its class
ALSO_KEPT = ("observation_space", "action_space", "policy_class", "n_envs", "num_timesteps", "_n_updates", "shown")
# Of a run's record, what holds on other machines too
KEPT_OF_RECORD = ("env_id", "method", "env_kwargs", "gym_packages", "seed", "n_timesteps", "hyperparams", "versions")


def export(agent: TrainedAgent, path: Path, trust: bool = False) -> dict[str, Any]:
    """
    Write a model file without optimizer states, replay, statistics of training and local paths. ``load`` of its class reads
    it, and the commands find in it which env it is for. What acts is exact; critics of SAC, which acting does not need, are
    kept in half precision, and their targets are the same as they.

    :param agent: to export
    :param path: file to write
    :param trust: see :meth:`TrainedAgent.load`
    :return: its record
    """
    model = agent.load(trust=trust)
    for name in model._get_torch_save_params()[0]:
        if name.endswith("optimizer"):
            attrgetter(name)(model).state.clear()
    model.verbose = 0
    if isinstance(model, SAC):
        model.critic.half()
        for target, parameter in zip(model.critic_target.parameters(), model.critic.parameters(), strict=True):
            target.data = parameter.data
    kept = {*keywords_of(type(model)), *ALSO_KEPT} - {"tensorboard_log"}
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


def push_to_hub(folder: Path, repo_id: str, private: bool = False) -> str:
    """
    :param folder: everything in it is uploaded
    :param repo_id: ``user/name``; made if there is none
    :param private: make it private
    :return: address of the model's page
    :raises OSError: if that fails
    """
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    # Its bases are OSError and what the HTTP library raises, which is another one in other versions of huggingface_hub
    failures: tuple[type[Exception], ...] = (ValueError, *HfHubHTTPError.__bases__)
    api = HfApi()
    try:
        repo = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(repo_id=repo.repo_id, folder_path=folder, commit_message="Agent of sb3_htr")
    except failures as error:
        reason = " ".join(str(error).split())
        raise OSError(f"The upload to {repo_id} failed, the files are in {folder}: {reason}") from error
    return str(repo)


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    description = "Write an agent as a small model file with a model card: scores after adaptation, how to load it."
    parser = make_parser("export", description, EXAMPLE)
    add_agent_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, help="folder, or .zip for the file alone (default: exported/ENV_ID)")
    parser.add_argument("--n-episodes", type=int, default=20, metavar="N", help="adaptation episodes for the scores (20)")
    parser.add_argument("--film", action="store_true", help="add replay.mp4, which the Hub shows (needs the extra video)")
    parser.add_argument("--push-to-hub", metavar="USER/NAME", help="upload; log in with `hf auth login` first")
    parser.add_argument("--private", action="store_true", help="with --push-to-hub: a private repository")
    args, agent = parse(parser, argv)
    output = args.output or Path("exported") / agent.stem
    alone = output.suffix == ".zip"
    if alone and (args.push_to_hub or args.film):
        raise ValueError(f"--push-to-hub and --film need a folder, but the output is the file {output}.")
    file = output if alone else output / f"{agent.stem}.zip"
    record = export(agent, file, args.trust)
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB, of {agent.path}")
    if alone:
        return
    exported = TrainedAgent(file, record, None)
    model, env = exported.load(), exported.make_vec_env(20)
    tasks = get_task_family(env).test_tasks
    explorers = dict.fromkeys([model.explorer.name, *exported.algorithm.also_explores_by])
    scores = {explorer: record_adaptation(model, env, tasks, args.n_episodes, explorer=explorer) for explorer in explorers}
    with atomic_path(output / "README.md") as temporary:
        temporary.write_text(model_card(record, scores, args.push_to_hub))
    print(f"{output / 'README.md'}: model card, with scores on the test tasks")
    if args.film:
        from sb3_htr.zoo.commands import record as recording

        recording.main([str(file), "-o", str(output / "replay.mp4"), "--verbose", "0"])
    if args.push_to_hub:
        print(f"Uploaded to {push_to_hub(output, args.push_to_hub, args.private)}")
