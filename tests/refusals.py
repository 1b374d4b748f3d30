"""What tests of any package need: calls refused in one line, objects with some of their fields."""

import pytest

from hmmseg.errors import InputError


def refused(line: str, call, *given, error: type[Exception] = InputError, **more) -> str:
    """The line by which a call is refused, which matches `line`; only an InputError's is one and short."""
    with pytest.raises(error, match=line or None) as told:
        call(*given, **more)
    said = str(told.value)
    assert error is not InputError or ("\n" not in said and len(said) < 2000)
    return said


def partly(kind: type, **fields):
    """An object of a class with these fields alone, where nothing reads the others."""
    made = object.__new__(kind)
    vars(made).update(fields)
    return made
