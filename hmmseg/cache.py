"""Files kept between runs in the user's cache folder: a convenience, without which everything is recomputed.

A file holds a digest, then its content; whatever else is found there (cut short, garbled, of somebody else)
counts as nothing, is reported once and replaced. Numbers are kept as JSON, never as code.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

MAGIC = b"hmmseg cache 1\n"
_said: set[Path] = set()


class CacheWarning(UserWarning):
    """A file of the cache was unreadable."""


def cache_folder() -> Path | None:
    """The user's cache folder of this project, which may be yet to be made; None where there is no home."""
    base = os.environ.get("XDG_CACHE_HOME") or ""
    if os.path.isabs(base):  # others are to be ignored, by the specification of these variables
        return Path(base) / "hmmseg"
    try:
        return Path.home() / ".cache" / "hmmseg"
    except RuntimeError:
        return None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically, so that no reader sees half of it; OSError where it fails."""
    handle, beside = tempfile.mkstemp(dir=path.parent, prefix=".hmmseg-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise


def keep(path: Path | None, content: bytes) -> None:
    """Keep bytes under a path of the cache; where they cannot be written they are not kept."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, MAGIC + hashlib.sha256(content).digest() + content)
    except OSError:
        return


def kept(path: Path | None) -> bytes | None:
    """The bytes kept under a path; None where there are none, or not as they were written."""
    if path is None:
        return None
    try:
        found = path.read_bytes()
    except OSError:
        return None
    start = len(MAGIC) + hashlib.sha256().digest_size
    content = found[start:]
    if found[:start] == MAGIC + hashlib.sha256(content).digest():
        return content
    _damaged(path)
    return None


def _damaged(path: Path) -> None:
    """Say so once for a folder, and take the file away."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    if path.parent not in _said:
        _said.add(path.parent)
        warnings.warn(f"{path}: not as it was written; recomputed", CacheWarning, stacklevel=4)


def keep_numbers(path: Path | None, numbers: Sequence[float]) -> None:
    """Keep numbers under a path of the cache."""
    keep(path, json.dumps(list(numbers)).encode())


def kept_numbers(path: Path | None) -> list[float]:
    """The numbers kept under a path; none where there are none, or not as they were written."""
    content = kept(path)
    if content is None or path is None:
        return []
    with contextlib.suppress(ValueError, RecursionError):
        found = json.loads(content)
        if isinstance(found, list) and all(isinstance(each, float | int) for each in found):
            return [float(each) for each in found]
    _damaged(path)  # whole, and yet nothing that this code writes
    return []
