"""Ids of envs that are no plain names."""

import json
from pathlib import Path

from sb3_htr.zoo.run.agents import RECORD, agent_at, agent_for


def test_ids_with_a_namespace_name_files_as_rl_zoo3_does(tmp_path: Path) -> None:
    run = tmp_path / "htr-ser" / "Suite-Robot-v0_2"
    run.mkdir(parents=True)
    (run / RECORD).write_text(json.dumps({"env_id": "Suite/Robot-v0", "env_kwargs": {}, "gym_packages": []}))
    (run / "Suite-Robot-v0.zip").touch()
    assert agent_for("Suite/Robot-v0", tmp_path).path == run / "Suite-Robot-v0.zip"
    assert agent_at(run).stem == "Suite-Robot-v0"
