"""Readers of files, one module per kind, chosen by `read_table`.

Each has `read(path, part, wanted)`, which returns a `Table` with the columns in `wanted` (all for None) that
the file has. Kinds that hold several recordings also have `parts(path)`; `#` selects one:
`demos.hdf5#demo_3`. Kinds that can be read in pieces have `num_rows` and `read_pieces`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from hmmseg.errors import InputError

if TYPE_CHECKING:
    from hmmseg.io.table import Table

KINDS = {
    ".csv": "delimited", ".tsv": "delimited", ".txt": "delimited", ".dat": "delimited",
    ".parquet": "parquet", ".npz": "npz",
    ".hdf5": "hdf5", ".h5": "hdf5", ".mcap": "mcap", ".bag": "bag", ".db3": "bag",
}  # fmt: skip
NEEDED = {"parquet": ("pyarrow",), "lerobot": ("pyarrow",), "hdf5": ("h5py",),
          "mcap": ("mcap", "mcap_ros2"), "bag": ("rosbags",)}  # fmt: skip
LOGS = ("mcap", "bag")  # logs of messages, which `[topics]` maps
A_TRIAL = "a trial (.csv, .tsv, .parquet, .npz, .mcap, .bag, .hdf5 or a data set's folder)"


def split_part(path: str | Path) -> tuple[Path, str | None]:
    """The file and, after a `#`, one of its recordings, unless a file of that very name exists."""
    path = Path(path)
    if path.exists() or "#" not in path.name:
        return path, None
    name, _, part = path.name.rpartition("#")
    return (path.with_name(name), part) if name else (path, None)


def kind_of(path: Path) -> str:
    """The module that reads this file or folder; InputError if there is none."""
    if path.is_dir():
        if (path / "meta/info.json").is_file():
            return "lerobot"
        if any(path.glob("*.mcap")):
            return "mcap"
        if (path / "metadata.yaml").is_file() or any(path.glob("*.db3")):
            return "bag"
        raise InputError(str(path), "is a folder", A_TRIAL)
    if not path.exists():
        raise InputError(str(path), "no such file", A_TRIAL)
    if not path.is_file():
        raise InputError(str(path), "is not a regular file", A_TRIAL)
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise InputError(str(path), f"unknown kind of file {path.suffix!r}", ", ".join(KINDS))
    return kind


def read_table(path: str | Path, wanted: Sequence[str] | None = None) -> Table:
    """The table of a file; InputError if it cannot be parsed."""
    file, part = split_part(path)
    kind = kind_of(file)
    with _parsing(path, "a table with a header row"):
        table = _module(kind, path).read(file, part, wanted)
    from hmmseg.io.table import MAX_COLUMNS  # loads NumPy, which `hmmseg --help` does without

    if len(table.names) > MAX_COLUMNS:
        raise InputError(table.file, f"has {len(table.names)} columns", f"{MAX_COLUMNS} at most")
    return table


@contextmanager
def _parsing(path: str | Path, expected: str = "") -> Iterator[None]:
    """Turn whatever a parser raises into an InputError: on damaged files they raise anything."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        from hmmseg.io.table import shown  # loads NumPy, which `hmmseg --help` does without

        problem = f"cannot be read ({shown(error) or type(error).__name__})"
        raise InputError(str(path), problem, expected) from error


def rows_of(path: Path, kind: str) -> int | None:
    """Rows of a file that can be read in pieces; None for any other."""
    module = _module(kind, path)
    return module.num_rows(path) if hasattr(module, "read_pieces") else None


def pieces_of(path: str | Path, wanted: Sequence[str], rows: int, least: int) -> Iterator[Table]:
    """Tables of about `rows` rows each, in order, none of fewer than `least`; InputError as `read_table`."""
    from hmmseg.io.table import append

    file, _ = split_part(path)
    waiting: Table | None = None
    with _parsing(path):
        for piece in _module(kind_of(file), path).read_pieces(file, wanted, rows):
            if waiting is not None and len(piece.rows) < least:
                piece = append(waiting, piece)
            elif waiting is not None:
                yield waiting
            waiting = piece
    if waiting is not None:
        yield waiting


def parts_of(path: str | Path) -> list[str]:
    """Names of the recordings in a file; none if the file is a single recording."""
    file, part = split_part(path)
    module = _module(kind_of(file), path)
    if part is not None or not hasattr(module, "parts"):
        return []
    with _parsing(path):
        return module.parts(file)


def _module(kind: str, path: str | Path) -> ModuleType:
    for library in NEEDED.get(kind, ()):
        try:
            importlib.import_module(library)
        except ImportError:
            extra = "parquet" if kind == "lerobot" else kind
            raise InputError(str(path), f"needs {library}, which is not installed",
                             f"pip install 'hmmseg[{extra}]'") from None  # fmt: skip
    return importlib.import_module(f"hmmseg.io.formats.{'logs' if kind in LOGS else kind}")
