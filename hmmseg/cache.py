"""Files kept between runs in the user's cache folder, without which everything is recomputed.

A file holds a digest, then its content; anything else (truncated, garbled, foreign) is ignored, reported
once and replaced.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import warnings
from pathlib import Path

MAGIC = b"hmmseg cache 1\n"
_said: set[Path] = set()


class CacheWarning(UserWarning):
    """A file of the cache was unreadable."""


def cache_folder() -> Path | None:
    """The project's folder in the user's cache, which need not exist yet; None if there is no home."""
    base = os.environ.get("XDG_CACHE_HOME") or ""
    if os.path.isabs(base):  # the XDG specification requires that other values are ignored
        return Path(base) / "hmmseg"
    try:
        return Path.home() / ".cache" / "hmmseg"
    except RuntimeError:
        return None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically, so that no reader sees part of it; OSError on failure."""
    handle, beside = tempfile.mkstemp(dir=path.parent, prefix=".hmmseg-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise


def keep(path: Path | None, content: bytes) -> None:
    """Keep bytes under a path of the cache, if it can be written."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, MAGIC + hashlib.sha256(content).digest() + content)
    except OSError:
        return


def kept(path: Path | None) -> bytes | None:
    """The bytes kept under a path; None if there are none, or the file is damaged."""
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
    """Warn once per folder, and remove the file."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    if path.parent not in _said:
        _said.add(path.parent)
        warnings.warn(f"{path}: not as it was written; recomputed", CacheWarning, stacklevel=4)
