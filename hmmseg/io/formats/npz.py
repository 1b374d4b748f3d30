"""NumPy archives: one array a column, nothing pickled, nothing unpacked that claims more than there is."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, flat, plain_table

MAX_MEMBER = 16 * MAX_ROWS  # bytes of one array
MAX_ARCHIVE = 8 * MAX_MEMBER  # bytes of all that are read


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
        # `pose[2]` is a column of the array `pose`
        chosen = [
            name for name in names
            if wanted is None or name in wanted or any(each.startswith(f"{name}[") for each in wanted)
        ]  # fmt: skip
        left = MAX_ARCHIVE
        for name in chosen:
            left -= _claimed(path, archive, name)
            if left < 0:
                raise InputError(str(path), f"unpacks to more than {MAX_ARCHIVE} bytes", "a recording")
        file.seek(0)
        arrays = np.load(file, allow_pickle=False)
        columns = flat({name: arrays[name] for name in chosen})
        rest = [name for name in names if name not in chosen]
    if wanted is not None:
        columns = {name: values for name, values in columns.items() if name in wanted}
    return plain_table(str(path), columns, [*columns, *rest])


def _claimed(path: Path, archive: zipfile.ZipFile, name: str) -> int:
    """Bytes that a member's array has by its own header; InputError where the file has fewer, or too many."""
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        reader = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = reader(member)
    where = f"{path}: column {name}"
    if dtype.hasobject:
        raise InputError(where, "holds Python objects, which are not unpacked", "numbers")
    size = math.prod(shape) * dtype.itemsize
    if size > info.file_size:
        raise InputError(where, f"claims {size} bytes and has {info.file_size}", "a whole array")
    if max(size, info.file_size) > MAX_MEMBER:
        raise InputError(where, f"unpacks to {max(size, info.file_size)} bytes", f"at most {MAX_MEMBER}")
    return size
