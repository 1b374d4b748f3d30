"""Progress messages of long computations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[str], None]


def silent(text: str) -> None:
    """Ignore the message."""


_LISTENS: ContextVar[Progress] = ContextVar("listens", default=silent)


@contextmanager
def heard(listen: Progress) -> Iterator[None]:
    """Send progress messages to `listen` within the context."""
    token = _LISTENS.set(listen)
    try:
        yield
    finally:
        _LISTENS.reset(token)


def say(text: str) -> None:
    """Send a progress message to the listener, if any."""
    _LISTENS.get()(text)
