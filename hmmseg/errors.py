"""The exception for invalid input; commands print it as one line and exit with 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Input (a file, a row, a column, a key) that cannot be used.

    Its message is a single line: where, what was wrong, what was expected.
    """

    def __init__(self, where: str, problem: str, expected: str = "") -> None:
        text = f"{where}: {problem}"
        if expected:
            text += f"; expected {expected}"
        super().__init__(" ".join(text.split()))
        self.where = where
        self.problem = problem
        self.expected = expected

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), (self.where, self.problem, self.expected)


ALSO_CALLED = {"mass": "weight", "breadth": "width", "thickness": "width", "length": "width", "size": "width"}


def nearest(word: str, known: Iterable[str]) -> str:
    """Phrase naming the known word nearest to `word` in meaning or spelling, for error messages."""
    known = sorted(known)
    meant = ALSO_CALLED.get(word.lower())
    if not known:
        return "no name, as there is none of these"
    close = [meant] if meant in known else difflib.get_close_matches(word, known, n=1, cutoff=0.0)
    return f"one of {', '.join(known)}" + (f" (did you mean {close[0]}?)" if close else "")
