"""LeRobot data sets, v2 (a file an episode) and v3 (many in a file): Parquet and meta/info.json.

A folder's episodes are its recordings, `dataset#3`. A feature's entries carry the names that
info.json gives them, `observation.state.left_x`, or their number, `observation.state[0]`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from hmmseg.errors import InputError
from hmmseg.io.formats.parquet import to_columns
from hmmseg.io.table import Table, plain_table

EPISODE = "episode_index"


def read_info(folder: Path) -> dict[str, Any]:
    """Table of meta/info.json."""
    path = folder / "meta/info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(str(path), f"cannot be read ({error})", "a LeRobot data set") from None
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise InputError(str(path), "has no features", "a LeRobot data set of version 2 or 3")
    return info


def data_files(folder: Path) -> list[Path]:
    """The Parquet files with samples, in order."""
    files = sorted((folder / "data").glob("chunk-*/*.parquet"))
    if not files:
        raise InputError(str(folder), "has no data/chunk-*/*.parquet", "a LeRobot data set")
    return files


def parts(path: Path) -> list[str]:
    """Numbers of the episodes."""
    read_info(path)
    found: set[int] = set()
    for file in data_files(path):
        found |= set(np.unique(pq.read_table(file, columns=[EPISODE]).column(EPISODE).to_numpy()).tolist())
    return [str(number) for number in sorted(found)]


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of one episode."""
    found = parts(path)
    if part is None and len(found) > 1:
        raise InputError(
            str(path), f"holds {len(found)} recordings", f"{path.name}#{found[0]} for one of them"
        )
    part = found[0] if part is None else part
    if part not in found:
        raise InputError(f"{path}#{part}", "no such recording", f"0 to {found[-1]}")
    info = read_info(path)
    for file in data_files(path):
        table = pq.read_table(file, filters=[(EPISODE, "==", int(part))])
        if table.num_rows:
            columns = _named(to_columns(table), info)
            break
    else:
        raise InputError(f"{path}#{part}", "has no samples", "an episode")
    names = tuple(columns)
    if wanted is not None:
        columns = {name: values for name, values in columns.items() if name in wanted}
    return plain_table(f"{path}#{part}", columns, names)


def _named(columns: dict[str, np.ndarray], info: dict[str, Any]) -> dict[str, np.ndarray]:
    """Entries of features under the names that info.json has for them."""
    out: dict[str, np.ndarray] = {}
    labels = {name: _labels(feature) for name, feature in info["features"].items()}
    for column, values in columns.items():
        name, _, entry = column.partition("[")
        index = entry.rstrip("]")
        known = labels.get(name, [])
        if index.isdigit() and int(index) < len(known):
            column = f"{name}.{known[int(index)]}"
        out[column] = values
    return out


def _labels(feature: Any) -> list[str]:
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict):  # {"motors": [...]}
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) else []
