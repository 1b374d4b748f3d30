"""Bad input is refused by an `InputError` of one line."""

import pytest

from hmmseg.errors import InputError


def refused(line: str, call, *given, **more) -> str:
    """The line by which a call is refused, which matches `line`."""
    with pytest.raises(InputError, match=line or None) as told:
        call(*given, **more)
    said = str(told.value)
    assert "\n" not in said and len(said) < 2000
    return said
