"""A Ctrl-C that comes while a compiler calls back into Python, which drops it: it comes again right after."""

from __future__ import annotations

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN = 0.02  # numerics: s; the callback has returned by then, and if not it is told once more


@contextmanager
def heard() -> Iterator[None]:
    """Within it no interrupt is lost, or told of with a traceback."""
    usual, waiting = sys.unraisablehook, []

    def hook(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            usual(unraisable)
            return
        waiting.append(threading.Timer(AGAIN, _thread.interrupt_main))
        waiting[-1].start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual
        for timer in waiting:
            timer.cancel()
