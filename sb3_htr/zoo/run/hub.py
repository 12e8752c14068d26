"""Agents on the Hugging Face Hub, under the names that ``huggingface_sb3`` and rl_zoo3 give them."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_htr.common.atomic import atomic_path
from sb3_htr.zoo.run.agents import TrainedAgent, agent_at, file_stem
from sb3_htr.zoo.run.folder import claim
from sb3_htr.zoo.run.method import DEFAULT, methods
from sb3_htr.zoo.run.record import RECORD

CARD, FILM = "README.md", "replay.mp4"


def model_name(env_id: str, algorithm: str = "pearl") -> str:
    """
    :param env_id: env of an agent
    :param algorithm: name of what trained it
    :return: name of its model, which is that of its repository too
    """
    return f"{algorithm}-{file_stem(env_id)}"


def files(name: str) -> list[str]:
    """
    :param name: :func:`model_name` of an agent
    :return: all files that its repository may have
    """
    return [f"{name}.zip", CARD, FILM]


def push(folder: Path, repo_id: str, name: str, private: bool = False) -> str:
    """
    :param folder: whose :func:`files` are uploaded; those that it lacks are deleted there
    :param repo_id: ``user/name``; made if there is none
    :param name: :func:`model_name` of the agent
    :param private: make it private
    :return: address of the model's page
    :raises OSError: if that fails
    """
    from huggingface_hub import HfApi

    api, names = HfApi(), files(name)
    with _one_sentence(f"The upload to {repo_id} failed, the files are in {folder}"):
        repo = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repo.repo_id,
            folder_path=folder,
            commit_message="Agent of sb3_htr",
            allow_patterns=names,
            delete_patterns=names,
        )
    return str(repo)


def pull(repo_id: str, env_id: str, folder: Path, algorithm: str = "pearl") -> TrainedAgent:
    """
    :param repo_id: ``user/name``
    :param env_id: env of the agent
    :param folder: of logs; the agent gets a folder of its own in it, as a run has
    :param algorithm: name of what trained it
    :return: the agent; nothing of the file was run
    :raises OSError: if the download fails
    :raises ValueError: if it is no model file, or one for another env
    """
    from huggingface_hub import hf_hub_download

    with _one_sentence(f"The download from {repo_id} failed"):
        downloaded = Path(hf_hub_download(repo_id, f"{model_name(env_id, algorithm)}.zip"))
    agent = agent_at(downloaded, env_id=env_id)
    if agent.env_id != env_id:
        raise ValueError(f"The model in {repo_id} was trained on {agent.env_id}, expected {env_id}.")
    # A method that is not known here is of another version, or of somebody's own
    method = agent.method if agent.method in methods() else DEFAULT
    run = claim(str(folder / method), file_stem(env_id), "")
    with atomic_path(run / f"{file_stem(env_id)}.zip") as temporary:
        shutil.copyfile(downloaded, temporary)
    with atomic_path(run / RECORD) as temporary:
        temporary.write_text(json.dumps(agent.record, indent=1))
    return agent_at(run)


@contextmanager
def _one_sentence(failure: str) -> Iterator[None]:
    from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError

    # Its bases are OSError and what the HTTP library raises, which is another one in other versions of huggingface_hub
    failures: tuple[type[Exception], ...] = (ValueError, EntryNotFoundError, *HfHubHTTPError.__bases__)
    try:
        yield
    except failures as error:
        raise OSError(f"{failure}: {' '.join(str(error).split())}") from error
