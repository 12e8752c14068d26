"""A warning that is given once says where."""

import warnings

from sb3_htr.common.warn_once import WarnOnce


def test_each_is_warned_of_once_and_where_it_is_called() -> None:
    warn_once, other = WarnOnce(), WarnOnce()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for what, message in (("one", "first"), ("one", "second"), ("two", "third")):
            warn_once(what, message, stacklevel=1)
        other("one", "of another", stacklevel=1)
    assert [str(warning.message) for warning in said] == ["first", "third", "of another"]
    assert {warning.filename for warning in said} == {__file__}
