"""Whatever an error says, there is one line of it."""

import shutil
from pathlib import Path

import pytest

from sb3_htr.common.errors import last_line, reason, training_goes_on


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(), "OSError"),
        (ValueError(""), "ValueError"),
        (ValueError("first\n  last "), "last"),
    ],
)
def test_an_error_has_a_last_line(error: Exception, said: str) -> None:
    assert last_line(error) == said


def test_a_failed_write_has_a_reason() -> None:
    assert reason(OSError(28, "full")) == "full" and reason(OSError("first\nlast")) == "last"


def test_an_error_of_a_file_stops_no_training_and_is_told_where_it_is(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"^The folder could not be removed \(No such file.*\)\. Training goes on\.$") as said:
        with training_goes_on("The folder", "removed"):
            shutil.rmtree(tmp_path / "none")
    assert [warning.filename for warning in said] == [__file__]
    with pytest.raises(ValueError, match="no file"), training_goes_on("A file"):
        raise ValueError("no file")
