"""Memory that is freed stays with the process, up to a bound, instead of being asked for anew.

The C library gives arrays of more than 128 kB back to the system as soon as they are freed, and touching
new pages then takes a tenth of a segmentation. Only for processes of our own: a library leaves its user's
alone.
"""

from __future__ import annotations

import ctypes
import sys

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
