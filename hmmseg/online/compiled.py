"""How what runs once for every reading is compiled: by numba, kept in the user's cache folder.

A reading is a few thousand scalar steps with branches. As a jitted JAX function it would cost a call for
each reading, and an empty call with the table of hypotheses takes about as long as a whole reading here.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hmmseg import densities, levels
from hmmseg.cache import cache_folder
from hmmseg.contact import equations

FOLDER, SHARED = cache_folder(), (densities, levels, equations)
if FOLDER is not None and "numba" not in sys.modules and "NUMBA_CACHE_DIR" not in os.environ:
    # Numba notices a change of a function's own file alone: a folder for each state of these files.
    sources = [*Path(__file__).parent.glob("*.py"), *(Path(str(m.__file__)) for m in SHARED)]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources)))
    os.environ["NUMBA_CACHE_DIR"] = str(FOLDER / "numba" / digest.hexdigest()[:16])

import numba  # noqa: E402
from numba.extending import overload  # noqa: E402

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def compiled(function: Callable) -> Any:
    """`function` compiled at its first call, without the interpreter's lock."""
    function = inspect.unwrap(function)  # checkers of annotations wrap every function when tests run
    try:
        made = numba.njit(function, cache=bool(numba.config.CACHE_DIR), **OPTIONS)  # type: ignore[attr-defined]
    except (RuntimeError, OSError):  # no folder that could be written to
        return numba.njit(function, **OPTIONS)
    cache = getattr(made, "_cache", None)
    for name in ("load_overload", "save_overload"):
        if hasattr(cache, name):
            setattr(cache, name, _or_nothing(getattr(cache, name)))
    return made


def _or_nothing(of_cache: Callable) -> Callable:
    """What a cache does, or nothing where its files are not as they were written or cannot be."""

    def tried(*args: Any) -> Any:
        try:
            return of_cache(*args)
        except Exception:
            if FOLDER is not None:  # numba would find them again at every start
                shutil.rmtree(FOLDER / "numba", ignore_errors=True)
            return None

    return tried


def _for_numbers(function: Callable) -> None:
    """Let compiled functions call for single numbers what other packages compute of arrays."""
    plain = inspect.unwrap(function)
    options: Any = OPTIONS
    overload(function, jit_options=options, strict=False)(lambda *_, **__: plain)


for _shared in (densities.log_student, densities.log_student_below, densities.log_between,
                equations.block_width, equations.block_y, equations.inertia_factor):  # fmt: skip
    _for_numbers(_shared)
