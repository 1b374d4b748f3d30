"""What a process of a command does apart from the rest: it keeps freed memory, and no Ctrl-C is lost.

The C library gives arrays of more than 128 kB back to the system as soon as they are freed, and touching
new pages then takes a tenth of a segmentation. Only for processes of our own: a library leaves its user's
alone. A Ctrl-C that comes while a compiler calls back into Python is dropped there, and sent again.
"""

from __future__ import annotations

import _thread
import ctypes
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# numerics: options of glibc's mallopt(3)
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT = 64 << 20  # chosen: bytes that are kept at most
LARGEST = 4 << 20  # chosen: bytes of an array from which on it is given back at once


def keep_freed_memory() -> None:
    """Set bounds of the C library's heap; nothing happens where there is no glibc."""
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST)
        mallopt(M_TRIM_THRESHOLD, KEPT)


AGAIN = 0.02  # numerics: s; the callback has returned by then, and if not it is sent once more


@contextmanager
def heard() -> Iterator[None]:
    """Within it no interrupt is lost, or reported with a traceback."""
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
