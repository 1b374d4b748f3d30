"""NumPy archives: one array a column, nothing pickled."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, flat, plain_table

MAX_MEMBER = 16 * MAX_ROWS


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of an archive; only the wanted arrays are unpacked."""
    with path.open("rb") as file:
        arrays = np.load(file, allow_pickle=False)
        if isinstance(arrays, np.ndarray):
            raise InputError(str(path), "holds one array without a name", "one array a column")
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()}
        for name, size in sizes.items():
            if size > MAX_MEMBER:
                raise InputError(
                    f"{path}: column {name}", f"unpacks to {size} bytes", f"at most {MAX_MEMBER}"
                )
        # `pose[2]` is a column of the array `pose`
        chosen = [
            name for name in arrays.files
            if wanted is None or name in wanted or any(each.startswith(f"{name}[") for each in wanted)
        ]  # fmt: skip
        columns = flat({name: arrays[name] for name in chosen})
        rest = [name for name in arrays.files if name not in chosen]
    if wanted is not None:
        columns = {name: values for name, values in columns.items() if name in wanted}
    return plain_table(str(path), columns, [*columns, *rest])
