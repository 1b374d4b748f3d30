"""How what runs once for every reading is compiled: by numba, kept in the user's cache folder.

A reading is a few thousand scalar steps with branches. As a jitted JAX function it would cost a call for
each reading, and an empty call with the table of hypotheses takes about as long as a whole reading here.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.extending import overload

from hmmseg import densities, levels
from hmmseg.cache import cache_folder, keep, kept
from hmmseg.contact import equations

try:
    from numba.core.caching import IndexDataCacheFile
except ImportError:  # another numba than those that this was tried with keeps its files itself
    IndexDataCacheFile: Any = object

HOME, SHARED = cache_folder(), (densities, levels, equations)
if HOME is not None and not numba.config.CACHE_DIR:  # type: ignore[attr-defined]
    # Numba notices a change of a function's own file alone: a folder for each state of these files.
    sources = [*Path(__file__).parent.glob("*.py"), *(Path(str(m.__file__)) for m in SHARED)]
    state = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources))).hexdigest()[:16]
    keep(HOME / "numba" / state / "writable", b"")
    if kept(HOME / "numba" / state / "writable") is not None:
        numba.config.CACHE_DIR = str(HOME / "numba" / state)  # type: ignore[attr-defined]

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
CACHED = bool(numba.config.CACHE_DIR)  # type: ignore[attr-defined]


class _Kept(IndexDataCacheFile):
    """A function's programs as files that say themselves whether they are whole: numba runs what it finds."""

    def _load_index(self) -> dict[Any, str]:
        content = kept(Path(self._index_path))
        of, programs = (None, {}) if content is None else pickle.loads(content)
        return programs if of == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        keep(Path(self._index_path), self._dump(((self._version, self._source_stamp), overloads)))

    def _load_data(self, name: str) -> Any:
        content = kept(Path(self._data_path(name)))
        if content is None:
            raise OSError(name)  # by which numba knows that it is to compile
        return pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        keep(Path(self._data_path(name)), self._dump(data))


def compiled(function: Callable) -> Any:
    """`function` compiled at its first call, without the interpreter's lock."""
    function = inspect.unwrap(function)  # checkers of annotations wrap every function when tests run
    made: Any = numba.njit(function, cache=CACHED, **OPTIONS)
    if CACHED:
        with contextlib.suppress(AttributeError, TypeError):
            made._cache._cache_file.__class__ = _Kept
    return made


def _for_numbers(function: Callable) -> None:
    """Let compiled functions call for single numbers what other packages compute of arrays."""
    plain = inspect.unwrap(function)
    options: Any = OPTIONS
    overload(function, jit_options=options, strict=False)(lambda *_, **__: plain)


for _shared in (densities.log_student, densities.log_student_below, densities.log_between,
                equations.block_width, equations.block_y, equations.inertia_factor):  # fmt: skip
    _for_numbers(_shared)
