"""NumPy archives: one array a column, nothing pickled, nothing unpacked that claims more than there is."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, is_wanted, plain_table

MAX_MEMBER = 16 * MAX_ROWS  # bytes of one array
MAX_ARCHIVE = 8 * MAX_MEMBER  # bytes of all that are read
BOMB = 2**28  # limit: bytes; an archive that unpacks to more than this
PACKED = 200  # limit: and to so many times its size holds nothing that was measured: readings have noise


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of an archive; only the wanted arrays are unpacked."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            lonely = file.read(6) == b"\x93NUMPY"
        problem = "holds one array without a name" if lonely else "is no archive of NumPy's"
        raise InputError(str(path), problem, "one array a column, as numpy.savez writes them")
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        names = [
            info.filename.removesuffix(".npy")
            for info in archive.infolist()
            if info.filename.endswith(".npy")
        ]
        chosen = [name for name in names if is_wanted(name, wanted)]
        _check_size(path, sum(_claimed(path, archive, name) for name in chosen))
        file.seek(0)
        arrays = np.load(file, allow_pickle=False)
        columns = {name: arrays[name] for name in chosen}
    return plain_table(str(path), columns, [name for name in names if name not in chosen], wanted)


def _header(member: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(member)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(member)
    return np.lib.format.read_array_header_2_0(member)


def unpack(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive by name, with the same checks."""
    with zipfile.ZipFile(path) as archive:
        names = [each.filename.removesuffix(".npy") for each in archive.infolist()]
        _check_size(path, sum(_claimed(path, archive, name) for name in names))
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in names}


def _check_size(path: Path, size: int) -> None:
    packed = path.stat().st_size
    if size > MAX_ARCHIVE or (size > BOMB and size > PACKED * packed):
        raise InputError(str(path), f"unpacks from {packed} to {size} bytes", "a recording")


def _claimed(path: Path, archive: zipfile.ZipFile, name: str) -> int:
    """Bytes that a member's array has by its own header; InputError where the file has fewer, or too many."""
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as member:
        shape, _, dtype = _header(member)
    where = f"{path}: column {name}"
    if dtype.hasobject:
        raise InputError(where, "holds Python objects, which are not unpacked", "numbers")
    size = math.prod(shape) * dtype.itemsize
    if size > info.file_size:
        raise InputError(where, f"claims {size} bytes and has {info.file_size}", "a whole array")
    if max(size, info.file_size) > MAX_MEMBER:
        raise InputError(where, f"unpacks to {max(size, info.file_size)} bytes", f"at most {MAX_MEMBER}")
    return size
