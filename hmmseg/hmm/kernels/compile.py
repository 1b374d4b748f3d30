"""How kernels are compiled: without the interpreter's lock, and kept on disk where that is possible.

The first call ever of a kernel compiles it and all its parts, which a user waits for: so parts are neither
wrapped for Python nor kept apart, each has one version, and the garbage collector waits.
"""

from __future__ import annotations

import gc
import hashlib
import inspect
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numba.core.config
from numba import types
from numba.core.caching import FunctionCache

_config: Any = numba.core.config
_KNOWN = "0.68."  # numerics: of numba
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


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
        made: Any = numba.njit(function, cache=True, **_OPTIONS)
        if numba.__version__.startswith(_KNOWN):
            made._cache = _Cache(made.py_func)
            made.compile = _undisturbed(made.compile)
    except (RuntimeError, OSError):  # no folder that could be written to
        made = numba.njit(function, **_OPTIONS)
    finally:
        _config.CACHE_DIR = before
    return _with_plain_arguments(made)


def part(function: Callable) -> Any:
    """`function` to be called by kernels alone, which have it compiled in them."""
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    made: Any = numba.njit(inspect.unwrap(function), **_OPTIONS, **options)

    def refused(*args: Any, **kws: Any) -> None:
        raise TypeError(f"{function.__name__} is called by kernels alone")

    def keep(compiled: Any) -> None:
        made.overloads[tuple(compiled.signature.args)] = compiled

    # What has no wrapper must not be found by a call from Python, which would end the process.
    made.add_overload, made._compile_for_args = keep, refused
    return _with_plain_arguments(made)


def _with_plain_arguments(kernel: Any) -> Any:
    """The kernel with one version for whatever constants others call it with, not one for each."""
    if numba.__version__.startswith(_KNOWN):
        typed = kernel.get_call_template

        def plain(args: tuple, kws: dict) -> Any:
            return typed(tuple(map(types.unliteral, args)), {k: types.unliteral(v) for k, v in kws.items()})

        kernel.get_call_template = plain
    return kernel


def _undisturbed(compile: Callable) -> Callable:
    """The function without garbage collection: compiling allocates for seconds what it needs to the end."""

    def compile_all(signature: Any) -> Any:
        collecting = gc.isenabled()
        gc.disable()
        try:
            return compile(signature)
        finally:
            if collecting:
                gc.enable()

    return compile_all
