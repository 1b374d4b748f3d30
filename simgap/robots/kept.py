"""What a diagnosis has worked out so far, so that one that was interrupted goes on where it was.

Every step is a function of the inputs and of the steps before it, so a step is known by the inputs' hash and
its name.
"""

from __future__ import annotations

import hashlib
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy
import scipy

from hmmseg.cache import cache_folder, keep_value, kept_value
from simgap.source_digest import source_digest

T = TypeVar("T")
AGE = 7 * 86400  # limit: s: what nobody went on with for a week is taken away


@dataclass(frozen=True)
class Kept:
    """Steps' results in a folder; without one nothing is kept."""

    folder: Path | None = None
    part: str = ""

    def __call__(self, step: str, make: Callable[[], T]) -> T:
        """The result of a step as it was kept, or made now and kept."""
        if self.folder is None:
            return make()
        path = self.folder / f"{self.part}{step}.npz"
        made = kept_value(path)
        if made is None:
            made = make()
            keep_value(path, made)
        return made

    def of(self, part: str) -> Kept:
        """The same folder, with the steps of a part of the diagnosis."""
        return Kept(self.folder, f"{self.part}{part} ")

    @property
    def begun(self) -> bool:
        """Whether there is anything to go on from."""
        return self.folder is not None and self.folder.is_dir() and any(self.folder.glob("*.npz"))

    def forget(self) -> None:
        """Take it all away: the diagnosis is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


NOWHERE = Kept()


def kept_for(inputs: Iterable[bytes]) -> Kept:
    """The folder, in the user's cache, of a diagnosis with these inputs by this code."""
    versions = f"{sys.version} {numpy.__version__} {scipy.__version__} {source_digest()}"
    digest = hashlib.sha256(versions.encode())
    for one in inputs:
        digest.update(hashlib.sha256(one).digest())
    folder = cache_folder()
    if folder is None:
        return NOWHERE
    with suppress(OSError):
        for old in (folder / "robots").glob("*"):
            if time.time() - old.stat().st_mtime > AGE:
                shutil.rmtree(old, ignore_errors=True)
    return Kept(folder / "robots" / digest.hexdigest()[:24])


def modules_beside(file: Path) -> list[bytes]:
    """The text of a Python file and of all that it imported from its own folder or below."""
    folder = file.resolve().parent
    found = {file.resolve()}
    for module in list(sys.modules.values()):
        where = getattr(module, "__file__", None)
        if where and where.endswith(".py") and Path(where).resolve().is_relative_to(folder):
            found.add(Path(where).resolve())
    return [path.read_bytes() for path in sorted(found)]
