"""Tables in memory: pandas and polars data frames, dicts of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import Table, plain_table


def frame_table(source: Any, wanted: Sequence[str] | None) -> Table:
    """Table of a frame or dict; rows count from 1. InputError for anything else."""
    where = "DataFrame" if hasattr(source, "columns") else type(source).__name__
    if isinstance(source, Mapping):
        names = [str(name).strip() for name in source]
        values = list(source.values())
    elif hasattr(source, "columns") and hasattr(source, "iloc"):
        names = [str(name).strip() for name in source.columns]
        values = [source.iloc[:, i] for i in range(len(names))]
    elif hasattr(source, "columns") and hasattr(source, "get_column"):
        names = [str(name).strip() for name in source.columns]
        values = [source.get_column(name) for name in source.columns]
    else:
        raise InputError(where, "is no table", "a file, a DataFrame or a dict of arrays")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{where}: column {name}", "appears twice", "one of each name")
    kept = {name: _array(each) for name, each in zip(names, values, strict=True)
            if wanted is None or name in wanted or any(w.startswith(f"{name}[") for w in wanted)}  # fmt: skip
    table = plain_table(where, kept)
    rest = [name for name in names if name not in kept]
    return Table(where, (*table.names, *rest), table.columns, table.rows)


def _array(values: Any) -> np.ndarray:
    if hasattr(values, "dtype") and type(values.dtype).__module__.startswith("pandas"):  # nullable
        if values.dtype.kind in "fiu":
            return values.to_numpy(dtype=np.float64, na_value=np.nan)
        if values.dtype.kind == "M":  # with a time zone
            return values.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()
        return values.to_numpy(dtype=object)
    if hasattr(values, "to_numpy"):
        return values.to_numpy()
    return np.asarray(values)
