"""How long work says what it is doing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[str], None]


def silent(text: str) -> None:
    """Say nothing."""


_LISTENS: ContextVar[Progress] = ContextVar("listens", default=silent)


@contextmanager
def heard(listen: Progress) -> Iterator[None]:
    """Within, what a long step is at is said to `listen`."""
    token = _LISTENS.set(listen)
    try:
        yield
    finally:
        _LISTENS.reset(token)


def say(text: str) -> None:
    """What a long step is at, to whoever listens."""
    _LISTENS.get()(text)
