"""Bad input is refused by an `InputError` of one line."""

import pytest

from hmmseg.errors import InputError


def refused(line: str, call, *given, **more) -> str:
    """The line by which a call is refused, which matches `line`."""
    with pytest.raises(InputError, match=line) as told:
        call(*given, **more)
    assert "\n" not in str(told.value)
    return str(told.value)
