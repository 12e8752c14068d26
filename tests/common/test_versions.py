"""What a result was made with."""

import os
import subprocess
from pathlib import Path

import pytest

from sb3_htr.common.versions import commit, differences


def test_a_path_that_is_no_text_does_not_stop_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Git tells paths as they are, with core.quotePath=false."""
    git = tmp_path / "git"
    git.write_text("#!/bin/sh\nprintf ' M caf\\351.py'\n")
    git.chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit()["clean"] is False


def test_a_checkout_is_read_and_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit that is made meanwhile would find git's index locked."""
    code = tmp_path / "code.py"
    code.touch()
    author = ["-c", "user.name=x", "-c", "user.email=x"]
    for command in (["init", "-q"], ["add", "."], [*author, "commit", "-q", "-m", "x"]):
        subprocess.run(["git", *command], check=True, cwd=tmp_path)
    os.utime(code, (1e9, 1e9))  # git looks into the file, and would note that it is the same
    index = (tmp_path / ".git" / "index").read_bytes()
    monkeypatch.setattr("sb3_htr.common.versions.__file__", str(code))
    assert commit()["clean"] is True
    assert (tmp_path / ".git" / "index").read_bytes() == index


@pytest.mark.parametrize("digests", [("a" * 20, None), (None, "a" * 20), ("a" * 20, "a" * 20)])
def test_a_record_without_a_digest_differs_in_nothing(digests: tuple[str | None, str | None]) -> None:
    before, now = ({"commit": "0123456789", **({} if digest is None else {"code": digest})} for digest in digests)
    assert differences(before, now) == []
