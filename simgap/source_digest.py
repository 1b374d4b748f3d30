"""A hash of the product's source: cached results are valid only for the code that made them."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import estimation
import hmmseg
import simgap


@cache
def source_digest() -> str:
    """The hash, in hexadecimal."""
    digest = hashlib.sha256()
    for package in (hmmseg, estimation, simgap):
        root = Path(package.__path__[0])
        for file in sorted(root.rglob("*.py")):
            digest.update(f"{package.__name__}/{file.relative_to(root)}\n".encode() + file.read_bytes())
    return digest.hexdigest()
