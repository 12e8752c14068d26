"""Which results are older than which changes of the code: of a repository that is made up, and of this one's facts of envs."""

import importlib
import json
import subprocess
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import state
import yaml
from tables import RESULTS

import htr_envs  # noqa: F401 registers the envs
from helpers import ENV_ID

CHANGES: list[dict[str, Any]] = [
    {"name": "faster learning", "in": "training", "where": {"methods": ["htr-*"]}},
    {"name": "new belief", "in": "evaluation", "explorers": ["belief"]},
    {"name": "rounding of sums", "in": "training", "rounding": True},
]


def git(repository: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
    return subprocess.run(command, cwd=repository, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def commits(tmp_path: Path) -> list[str]:
    """Three, of a repository with results; the second one is the change."""
    git(tmp_path, "init", "--quiet")
    for name in ("before", "change", "after"):
        git(tmp_path, "commit", "--quiet", "--allow-empty", "-m", name)
    return git(tmp_path, "log", "--reverse", "--format=%h").splitlines()


def table(folder: Path, change: dict[str, Any], **made_by: tuple[str, str]) -> str:
    """Of runs of some methods, trained and evaluated by two commits each."""
    (folder / "numbers").mkdir()
    (folder / "changes.yml").write_text(yaml.safe_dump({"changes": [change], "envs": {ENV_ID: {"steps": 20}}}))
    for method, (trained_by, evaluated_by) in made_by.items():
        method = method.replace("_", "-")
        raw: dict[str, Any] = {"commit": trained_by, "evaluation_commit": evaluated_by, "returns_belief": np.zeros(1)}
        raw["cell"] = json.dumps({"env_id": ENV_ID, "env_kwargs": {}, "method": method, "settings": {}})
        np.savez(folder / "numbers" / f"raw-{method}.npz", **{f"{method}-seed1/{key}": value for key, value in raw.items()})
    return state.state(folder)


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change["name"])
def test_a_table_says_what_its_runs_are_older_than(change: dict[str, Any], tmp_path: Path, commits: list[str]) -> None:
    before, second, after = commits
    change = {"commits": [second], **change}
    text = table(tmp_path, change, htr_ser=(before, after), pearl_sparse=(before, before), htr_ec=(second, after))
    lines = {line.split("|")[1].strip(): line.split("|")[4:6] for line in text.splitlines() if line.startswith("| **")}
    today = text.splitlines()[0]
    match change["name"]:
        case "faster learning":
            assert lines == {"**numbers**: `htr-ser`": [" faster learning ", " - "]}
            assert today == "By today's code: **numbers**: `htr-ec`, `pearl-sparse`."
        case "new belief":
            expected = {"htr-ser": [" - ", " new belief (curves) "], "pearl-sparse": [" - ", " new belief "]}
            assert lines == {f"**numbers**: `{name}`": cells for name, cells in expected.items()}
            assert today == "By today's code: **numbers**: `htr-ec`."
        case _:
            assert not lines and today == "By today's code: **numbers**: `htr-ec`."
            assert "By today's code but for *rounding of sums*: **numbers**: `htr-ser`, `pearl-sparse`." in text


def test_a_commit_that_git_has_not_is_named(tmp_path: Path, commits: list[str]) -> None:
    with pytest.raises(ValueError, match="abcdef1: get all of its history"):
        table(tmp_path, {"commits": commits[1:2], **CHANGES[0]}, htr_ser=("abcdef1", "abcdef1"))


def test_facts_of_envs_are_those_of_their_ids() -> None:
    importlib.import_module("examples.experiments")  # registers some
    envs = yaml.safe_load((RESULTS / "changes.yml").read_text())["envs"]
    for env_id in envs:
        spec = gym.spec(env_id)
        assert envs[env_id]["steps"] == spec.max_episode_steps, env_id
        assert ("stepped singly" in envs[env_id].get("is", [])) == (spec.vector_entry_point is None), env_id
