"""JAX settings of the whole project: double precision and a compilation cache that persists.

Import this module before building any JAX array. Forces span 1e-3 to 10 N while log-likelihoods
reach 1e5, so single precision would lose boundaries; compiled programs are kept in the user's
cache folder because compilation is a cost the user feels.
"""

from __future__ import annotations

import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)


def cache_folder() -> Path:
    """The user's cache folder of this project, which may be yet to be made."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "hmmseg"


if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
