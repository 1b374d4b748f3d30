"""NumPy archives: one array per column, without pickled objects or arrays larger than they claim."""

import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, is_wanted, make_table

MAX_MEMBER = 16 * MAX_ROWS  # bytes of one array
MAX_ARCHIVE = 8 * MAX_MEMBER  # bytes of all that are read
BOMB = 2**28  # limit: bytes; an archive that unpacks to more than this
PACKED = 200  # limit: and to so many times its size holds no measurements: readings have noise


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of an archive; only the wanted arrays are unpacked."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            lonely = file.read(6) == b"\x93NUMPY"
        problem = "holds one array without a name" if lonely else "is no archive of NumPy's"
        raise InputError(str(path), problem, "one array a column, as numpy.savez writes them")
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        names = _names(archive)
        chosen = [name for name in names if is_wanted(name, wanted)]
        _check_size(path, archive, chosen)
        file.seek(0)
        arrays = np.load(file, allow_pickle=False)
        columns = {name: arrays[name] for name in chosen}
    return make_table(str(path), columns, names, wanted)


def num_rows(path: Path) -> int | None:
    """Rows of an archive's first array; None if there is none, or it cannot be read in pieces."""
    if not zipfile.is_zipfile(path):
        return None
    with zipfile.ZipFile(path) as archive:
        names = _names(archive)
        if not names:
            return None
        with archive.open(f"{names[0]}.npy") as member:
            shape, fortran, dtype = _header(member)
        return shape[0] if len(shape) == 1 and dtype.kind in "fiu" and not fortran else None


def read_pieces(path: Path, wanted: Sequence[str] | None, rows: int) -> Iterator[Table]:
    """Tables of at most `rows` rows each, in order: a long file in bounded memory, compressed or not."""
    with zipfile.ZipFile(path) as archive, ExitStack() as open_:
        every, members, kinds, lengths = _names(archive), {}, {}, {}
        for name in every:
            if wanted is not None and name not in wanted:
                continue
            _claimed(path, archive, name)
            members[name] = open_.enter_context(archive.open(f"{name}.npy"))
            shape, _, kinds[name] = _header(members[name])
            if len(shape) != 1:
                raise InputError(f"{path}: column {name}", f"has {len(shape)} axes", "one number a row")
            lengths[name] = shape[0]
        found = sorted(set(lengths.values())) or [0]
        if len(found) > 1:
            raise InputError(str(path), f"has columns of {found} rows", "of one length")
        for first in range(0, found[0], rows):
            count = min(rows, found[0] - first)
            columns = {
                name: np.frombuffer(member.read(count * kinds[name].itemsize), kinds[name])
                for name, member in members.items()
            }
            yield Table(str(path), tuple(every), columns, np.arange(first + 1, first + count + 1))


def _names(archive: zipfile.ZipFile) -> list[str]:
    """Names of an archive's arrays."""
    files = [info.filename for info in archive.infolist()]
    return [name.removesuffix(".npy") for name in files if name.endswith(".npy")]


def _header(member: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(member)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(member)
    return np.lib.format.read_array_header_2_0(member)


def unpack(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive by name, with the same checks."""
    with zipfile.ZipFile(path) as archive:
        names = [each.filename.removesuffix(".npy") for each in archive.infolist()]
        _check_size(path, archive, names)
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in names}


def _check_size(path: Path, archive: zipfile.ZipFile, names: Sequence[str]) -> None:
    packed, size = path.stat().st_size, sum(_claimed(path, archive, name) for name in names)
    if size > MAX_ARCHIVE or (size > BOMB and size > PACKED * packed):
        raise InputError(str(path), f"unpacks from {packed} to {size} bytes", "a recording")


def _claimed(path: Path, archive: zipfile.ZipFile, name: str) -> int:
    """Bytes of a member's array by its own header; InputError if the file has fewer, or too many."""
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
