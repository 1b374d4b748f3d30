"""How what runs once for every reading is compiled: by numba, kept in the user's cache folder.

A reading is a few thousand scalar steps with branches. As a jitted JAX function it would cost a call for
each reading, and an empty call with the table of hypotheses takes about as long as a whole reading here.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import inspect
import json
import os
import pickletools
import shutil
import sys
import warnings
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hmmseg import densities, levels
from hmmseg.cache import CacheWarning, cache_folder, keep, kept
from hmmseg.contact import equations

HOME, SHARED = cache_folder(), (densities, levels, equations)


def _digests(folder: Path) -> dict[str, str]:
    """Digests of the programs in a folder, by their paths in it."""
    paths = [path for path in folder.glob("*/*.nb?") if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def _examine(folder: Path) -> None:
    """Empty the folder unless the programs that a run left there are as it left them.

    Numba runs what it finds, and what is cut short or garbled ends in errors of its own. What was added
    since, by a process that runs still, is whole: numba writes a file elsewhere and then moves it. So is an
    index that such a process wrote again, as long as it can be parsed to its end.
    """
    found, left = _digests(folder), json.loads(kept(folder / "digests.json") or b"{}")
    changed = [folder / name for name, digest in left.items() if found.get(name, digest) != digest]
    if found and (not left or not all(path.suffix == ".nbi" and _is_index(path) for path in changed)):
        shutil.rmtree(folder, ignore_errors=True)
        if left:
            warnings.warn(f"{folder}: not as it was written; recomputed", CacheWarning, stacklevel=2)


def _is_index(path: Path) -> bool:
    """Whether a file is two pickles and nothing else, as numba's indices are; nothing of it is run."""
    with contextlib.suppress(OSError, ValueError, UnicodeDecodeError, IndexError), path.open("rb") as file:
        for _ in range(2):
            deque(pickletools.genops(file), maxlen=0)
        return not file.read(1)
    return False


def _leave(folder: Path) -> None:
    found = _digests(folder)
    if found:
        keep(folder / "digests.json", json.dumps(found).encode())


if HOME is not None and "numba" not in sys.modules and "NUMBA_CACHE_DIR" not in os.environ:
    # Numba notices a change of a function's own file alone: a folder for each state of these files.
    sources = [*Path(__file__).parent.glob("*.py"), *(Path(str(m.__file__)) for m in SHARED)]
    state = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources))).hexdigest()[:16]
    folder = HOME / "numba" / state
    keep(folder / "writable", b"")
    if kept(folder / "writable") is not None:
        _examine(folder)
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        atexit.register(_leave, folder)

import numba  # noqa: E402
from numba.extending import overload  # noqa: E402

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
CACHED = bool(numba.config.CACHE_DIR)  # type: ignore[attr-defined]


def compiled(function: Callable) -> Any:
    """`function` compiled at its first call, without the interpreter's lock."""
    function = inspect.unwrap(function)  # checkers of annotations wrap every function when tests run
    return numba.njit(function, cache=CACHED, **OPTIONS)


def _for_numbers(function: Callable) -> None:
    """Let compiled functions call for single numbers what other packages compute of arrays."""
    plain = inspect.unwrap(function)
    options: Any = OPTIONS
    overload(function, jit_options=options, strict=False)(lambda *_, **__: plain)


for _shared in (densities.log_student, densities.log_student_below, densities.log_between,
                equations.block_width, equations.block_y, equations.inertia_factor):  # fmt: skip
    _for_numbers(_shared)
