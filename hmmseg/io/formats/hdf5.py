"""HDF5 in robomimic's layout, `data/demo_0/obs/...`, or with columns at the top level; read with h5py.

A column's name is its path below the demonstration, `obs/robot0_eef_pos[0]`. Robomimic stores no times: `t`
is computed from `control_freq` in the file's `env_args` if present.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, check_part, flat, is_wanted, make_table

MAX_WIDTH = 64  # numerics: numbers per row; images are no channels


def parts(path: Path) -> list[str]:
    """Names of the demonstrations; none if the file is one recording."""
    with h5py.File(path, "r") as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group):
            return []
        names = [str(name) for name in data if isinstance(data.get(name), h5py.Group)]
    return sorted(names, key=lambda name: (len(name), name))


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of one demonstration, or of the file's own columns."""
    found = parts(path)
    check_part(path, part, found)
    with h5py.File(path, "r") as file:
        group = file.get(f"data/{part or found[0]}") if found else file
        if not isinstance(group, h5py.Group):
            raise InputError(str(path), "is no group of columns", "an HDF5 file")
        datasets = dict(_datasets(group, "", 0))
        columns = flat({name: each[()] for name, each in datasets.items() if is_wanted(name, wanted)})
        rate = _control_rate(file)
    if rate is not None and "t" not in datasets and (wanted is None or "t" in wanted):
        lengths = [len(values) for values in columns.values()]
        lengths = lengths or [each.shape[0] for each in datasets.values()]
        columns = {"t": np.arange(max(lengths, key=lengths.count, default=0)) / rate, **columns}
    return make_table(f"{path}#{part}" if part else str(path), columns, datasets, wanted)


def _datasets(group: h5py.Group, prefix: str, depth: int) -> Iterator[tuple[str, h5py.Dataset]]:
    """Numeric data sets by name, one row per sample; links to other files are not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.ExternalLink) or depth > 4:
            continue
        entry = group.get(name)
        if isinstance(entry, h5py.Group):
            yield from _datasets(entry, f"{prefix}{name}/", depth + 1)
        elif isinstance(entry, h5py.Dataset) and entry.dtype.kind in "fiu" and entry.ndim:
            small = entry.shape[0] <= MAX_ROWS and int(np.prod(entry.shape[1:])) <= MAX_WIDTH
            if small and not entry.is_virtual and not entry.external:
                yield f"{prefix}{name}", entry


def _control_rate(file: h5py.File) -> float | None:
    """Sampling rate [Hz], from robomimic's `env_args`."""
    data = file.get("data")
    text = data.attrs.get("env_args") if isinstance(data, h5py.Group) else None
    try:
        rate = float(json.loads(str(text))["env_kwargs"]["control_freq"])
    except (TypeError, ValueError, KeyError):
        return None
    return rate if rate > 0 and np.isfinite(rate) else None
