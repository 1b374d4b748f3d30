"""How what runs once for every reading is compiled: by numba, kept in the user's cache folder.

A reading is a few thousand scalar steps with branches, which a jitted JAX function would pay for with a
call per reading that alone takes as long (docs/watch.md).
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hmmseg.jaxconfig import cache_folder

if "numba" not in sys.modules and "NUMBA_CACHE_DIR" not in os.environ:
    # Numba notices a change of a function's own file alone: a folder for each state of these files.
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(Path(__file__).parent.glob("*.py"))))
    os.environ["NUMBA_CACHE_DIR"] = str(cache_folder() / "numba" / digest.hexdigest()[:16])

import numba


def compiled(function: Callable) -> Any:
    """`function` compiled at its first call, without the interpreter's lock."""
    function = inspect.unwrap(function)  # checkers of annotations wrap every function when tests run
    return numba.njit(function, cache=bool(numba.config.CACHE_DIR), nogil=True, error_model="numpy")  # type: ignore[attr-defined]
