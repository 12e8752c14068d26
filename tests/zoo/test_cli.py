"""The command as a process."""

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
