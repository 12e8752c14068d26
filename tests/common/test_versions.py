"""What a result was made with."""

from pathlib import Path

import pytest

from sb3_htr.common.versions import commit


def test_a_path_that_is_no_text_does_not_stop_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Git tells paths as they are, with core.quotePath=false."""
    git = tmp_path / "git"
    git.write_text("#!/bin/sh\nprintf ' M caf\\351.py'\n")
    git.chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit()["clean"] is False
