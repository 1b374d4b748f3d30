"""How kernels are compiled: without the interpreter's lock, and kept on disk where that is possible."""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numba.core.config
from numba.core.caching import FunctionCache

_config: Any = numba.core.config
_TRIED = "0.68."  # numerics: of numba


class _Cache(FunctionCache):
    """Kernels from the disk, without the registries that only compiling needs.

    Numba fills them before each load (a quarter of a second, scipy.linalg among it); what is compiled fills
    them anyway. Memory management is all that a loaded kernel needs of it. Only where numba is as it was
    when this was tried.
    """

    def load_overload(self, sig, target_context):
        from numba.core.runtime.nrt import rtsys

        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


@cache
def cache_folder(sources: Path = Path(__file__).parent) -> str:
    """Where compiled kernels are kept: one folder for each state of the files in `sources`.

    Numba notices a change of a function's own file alone, not of what the function calls.
    """
    digest = hashlib.sha256()
    for path in sorted(sources.glob("*.py")):
        digest.update(path.read_bytes())
    base = _config.CACHE_DIR or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "hmmseg", "numba"
    )
    return os.path.join(base, digest.hexdigest()[:16])


def compiled(function: Callable) -> Any:
    """`function` compiled at its first call; kept on disk where a folder is writable."""
    function = inspect.unwrap(function)  # checkers of annotations wrap every function when tests run
    before = _config.CACHE_DIR
    _config.CACHE_DIR = cache_folder(Path(inspect.getfile(function)).parent)
    try:
        made: Any = numba.njit(function, nogil=True, error_model="numpy", cache=True)
        if numba.__version__.startswith(_TRIED):
            made._cache = _Cache(made.py_func)
        return made
    except (RuntimeError, OSError):  # no folder that could be written to
        return numba.njit(function, nogil=True, error_model="numpy")
    finally:
        _config.CACHE_DIR = before
