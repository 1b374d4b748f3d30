"""Strict settings for every test: double precision, no silent promotion, shapes checked."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

from hmmseg.jaxconfig import configure

configure()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Before any of these packages is imported: annotations are then checked at every call.
install_import_hook(["hmmseg", "estimation", "simgap"], "typechecker.typechecked")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recordings that lies beside the checkout and is no part of it."""
    path = Path(__file__).resolve().parents[1] / "../shared"
    if not path.exists():
        pytest.skip("the folder ../shared with recordings is absent")
    return path.resolve()
