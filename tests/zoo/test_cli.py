"""The command as a process."""

import os
import subprocess
import sys

import pytest
import torch as th

from sb3_htr.zoo.cli import console


def test_a_command_takes_one_thread_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["sb3-htr", "--version"])
    monkeypatch.setattr("sys.path", [*sys.path])
    before = th.get_num_threads()
    try:
        for told, expected in ((None, 1), ("2", 2)):
            monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
            if told:
                monkeypatch.setenv("OMP_NUM_THREADS", told)
            th.set_num_threads(2)
            assert console() == 0
            assert th.get_num_threads() == expected
    finally:
        th.set_num_threads(before)


@pytest.mark.parametrize(("arguments", "unbuffered"), [(["--version"], "1"), (["evaluate", "--help"], "")])
def test_who_has_read_enough_is_told_nothing(arguments: list[str], unbuffered: str) -> None:
    """As `sb3-htr ... | head -1` does; a container often buffers nothing."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "sb3_htr.zoo.cli", *arguments]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    os.close(writer)
    assert done.stderr == ""
