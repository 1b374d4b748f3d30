"""Strict settings for every test: double precision, no silent promotion, shapes checked."""

import os
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

from hmmseg.jaxconfig import configure, keep_programs

configure()
keep_programs()  # one worker's compiled programs are the others'
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Before any of these is imported: annotations are then checked at every call. That takes three times as long,
# so only where they state shapes, and everywhere in `make slow`; the rest is for the static checker.
SHAPED = ["simgap.attribution.problem"]
EVERYWHERE = ["hmmseg", "estimation", "simgap"]
install_import_hook(EVERYWHERE if "CHECK_CALLS" in os.environ else SHAPED, "typechecker.typechecked")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recordings that lies beside the checkout and is no part of it."""
    path = Path(__file__).resolve().parents[1] / "../shared"
    if not path.exists():
        pytest.skip("the folder ../shared with recordings is absent")
    return path.resolve()
