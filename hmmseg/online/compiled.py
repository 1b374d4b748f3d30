"""Compilation, by numba, of the code that runs once for every reading; cached in the user's cache folder.

A reading takes a few thousand scalar steps with branches. A jitted JAX function would need a call per
reading, and an empty call with the table of hypotheses already takes about as long as a whole reading here.
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
except ImportError:  # untested versions of numba manage their files themselves
    IndexDataCacheFile = object  # type: ignore[assignment, misc]

HOME, SHARED = cache_folder(), (densities, levels, equations)
if HOME is not None and not numba.config.CACHE_DIR:  # type: ignore[attr-defined]
    # Numba detects changes of a function's own file only, and its versions cannot read each other's files, so
    # each state of these files has its own folder under each version.
    sources = [*Path(__file__).parent.glob("*.py"), *(Path(str(m.__file__)) for m in SHARED)]
    content = b"".join(path.read_bytes() for path in sorted(sources)) + numba.__version__.encode()
    state = hashlib.sha256(content).hexdigest()[:16]
    keep(HOME / "numba" / state / "writable", b"")
    if kept(HOME / "numba" / state / "writable") is not None:
        numba.config.CACHE_DIR = str(HOME / "numba" / state)  # type: ignore[attr-defined]

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
CACHED = bool(numba.config.CACHE_DIR)  # type: ignore[attr-defined]


class _Kept(IndexDataCacheFile):
    """Cache files of a function that carry a checksum, as numba would run damaged ones."""

    def _load_index(self) -> dict[Any, str]:
        content = kept(Path(self._index_path))
        of, programs = (None, {}) if content is None else pickle.loads(content)
        return programs if of == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        keep(Path(self._index_path), self._dump(((self._version, self._source_stamp), overloads)))  # type: ignore[no-untyped-call]

    def _load_data(self, name: str) -> Any:
        content = kept(Path(self._data_path(name)))  # type: ignore[no-untyped-call]
        if content is None:
            raise OSError(name)  # tells numba to compile
        return pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        keep(Path(self._data_path(name)), self._dump(data))  # type: ignore[no-untyped-call]


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` at its first call, without the interpreter's lock."""
    function = inspect.unwrap(function)  # annotation checkers wrap every function in tests
    made: Any = numba.njit(function, cache=CACHED, **OPTIONS)
    if CACHED:
        with contextlib.suppress(AttributeError, TypeError):
            made._cache._cache_file.__class__ = _Kept
    return made


def _for_numbers(function: Callable[..., Any]) -> None:
    """Let compiled functions call, for single numbers, functions that other packages apply to arrays."""
    plain = inspect.unwrap(function)
    options: Any = OPTIONS
    overload(function, jit_options=options, strict=False)(lambda *_, **__: plain)


for _shared in (densities.log_student, densities.log_student_below, densities.log_between,
                equations.block_width, equations.block_y, equations.inertia_factor):  # fmt: skip
    _for_numbers(_shared)
