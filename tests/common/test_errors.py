"""Whatever an error says, there is one line of it."""

import pytest

from sb3_htr.common.errors import reason


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(), "OSError"),
        (ValueError(""), "ValueError"),
        (ValueError("first\n  last "), "last"),
        (OSError(28, "full"), "full"),
    ],
)
def test_a_failed_write_has_a_reason(error: Exception, said: str) -> None:
    assert reason(error) == said
