"""Whatever an error says, there is one line of it."""

import pytest

from sb3_htr.common.errors import last_line, reason


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
