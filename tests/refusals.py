"""What a call is refused with."""

import pytest

from hmmseg.errors import InputError


def refused(line: str, call, *arguments, **more) -> str:
    """The one line of the InputError that a call raises; `line`: a regular expression that occurs in it."""
    with pytest.raises(InputError, match=line) as caught:
        call(*arguments, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)
