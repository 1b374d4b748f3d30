"""JAX settings: double precision, and a persistent compilation cache.

Importing this project changes no setting of the process. Forces span 1e-3 to 10 N while log-likelihoods
reach 1e5, so that single precision would displace boundaries: public functions run in double precision
whatever the caller's JAX is set to (`double_precision`). The project's own programs call `configure`, which
also keeps compiled programs in the user's cache folder, as compilation is slow.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from hmmseg.cache import cache_folder, keep, kept

P = ParamSpec("P")
R = TypeVar("R")


class _Programs:
    """Compiled programs in a folder, with the interface of JAX's compilation cache, which itself would run
    the contents of a garbled file, and never replaces one that it cannot read."""

    def __init__(self, folder: str) -> None:
        self._path = Path(folder)

    def get(self, key: str) -> bytes | None:
        return kept(self._path / key)

    def put(self, key: str, value: bytes) -> None:
        keep(self._path / key, value)


def configure(steady: bool = False) -> None:
    """Double precision and the persistent cache for the whole process, before or after JAX is imported.

    `steady`: for programs that call JAX in a loop with a deadline, before its first computation. JAX then
    computes in the calling thread, as handing over to another one delays one step in some 250 by 0.3 ms
    (experiments/benchmarks/haptic_loop.py).
    """
    settings: dict[str, Any] = {
        "jax_enable_x64": True,
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    if steady:
        settings["jax_cpu_enable_async_dispatch"] = False
    for name, value in settings.items():  # read by JAX as it is imported
        os.environ[name.upper()] = str(value)
    if "jax" in sys.modules:
        for name, value in settings.items():
            sys.modules["jax"].config.update(name, value)
    _configured.append(True)


_configured: list[bool] = []


def keep_programs() -> None:
    """Have JAX, once it is imported, keep compiled programs in our cache folder if `configure` was called,
    unless the user has a folder for them."""
    if _configured:
        _keep_programs()


@functools.cache
def _keep_programs() -> None:
    import jax

    folder = cache_folder()
    if folder is None or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        from jax._src import compilation_cache

        setattr(compilation_cache, "get_file_cache", lambda path: (_Programs(path), path))  # noqa: B010
    except (ImportError, AttributeError):  # a version of JAX with other internals
        return
    jax.config.update("jax_compilation_cache_dir", str(folder / "programs"))  # type: ignore[no-untyped-call]


def double_precision(function: Callable[P, R]) -> Callable[P, R]:
    """The function with JAX in double precision while it runs."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        import jax

        keep_programs()
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapped
