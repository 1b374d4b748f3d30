"""LeRobot data sets, v2 (a file per episode) and v3 (many in a file): Parquet and meta/info.json.

A folder's episodes are its recordings, `dataset#3`. Entries of a feature have the names in info.json,
`observation.state.left_x`, or their index, `observation.state[0]`. Language rows (version 3.1: LeRobot's
`lerobot.datasets.language`) become one text column per style, such as `language.subtask`: the text that holds
at each sample.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hmmseg.errors import InputError
from hmmseg.io.formats.parquet import to_columns
from hmmseg.io.schema import read_json
from hmmseg.io.table import Table, check_part, make_table

EPISODE = "episode_index"
PERSISTENT, EVENTS = "language_persistent", "language_events"


def read_info(folder: Path) -> dict[str, Any]:
    """Table of meta/info.json."""
    path = folder / "meta/info.json"
    info = read_json(path, "a LeRobot data set")
    if not isinstance(info.get("features"), dict):
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
    check_part(path, part, found)
    part = found[0] if part is None else part
    info = read_info(path)
    for file in data_files(path):
        table = pq.read_table(file, filters=[(EPISODE, "==", int(part))])
        if table.num_rows:
            texts = texts_by_style(table)
            table = table.drop_columns([name for name in (PERSISTENT, EVENTS) if name in table.column_names])
            columns = _rename_entries(to_columns(table), info) | texts
            break
    else:
        raise InputError(f"{path}#{part}", "has no samples", "an episode")
    return make_table(f"{path}#{part}", columns, wanted=wanted)


def language_rows(table: pa.Table) -> list[dict[str, Any]]:
    """Persistent language rows of one episode, which every sample repeats."""
    if PERSISTENT not in table.column_names:
        return []
    return next((rows for rows in table.column(PERSISTENT).to_pylist() if rows), [])


def read_subtasks(folder: Path) -> bool:
    """Whether any episode of a data set has language rows of style `subtask`."""
    for file in data_files(folder):
        if PERSISTENT not in pq.read_schema(file).names:
            continue
        column = pq.read_table(file, columns=[PERSISTENT]).column(PERSISTENT)
        if "subtask" in column.combine_chunks().flatten().field("style").unique().to_pylist():
            return True
    return False


def texts_by_style(table: pa.Table) -> dict[str, np.ndarray]:
    """By style, the text (num_timesteps,) that holds at each sample of an episode; None before the first."""
    out: dict[str, np.ndarray] = {}
    rows = language_rows(table)
    t = table.column("timestamp").to_numpy() if "timestamp" in table.column_names else np.arange(len(table))
    for style in dict.fromkeys(row["style"] for row in rows if row["style"]):
        mine = sorted((row for row in rows if row["style"] == style), key=lambda row: row["timestamp"])
        texts = np.array([None, *(row["content"] for row in mine)], dtype=object)
        since = np.array([row["timestamp"] for row in mine], dtype=np.float32)
        out[f"language.{style}"] = texts[np.searchsorted(since, t.astype(np.float32), side="right")]
    return out


def with_subtasks(table: pa.Table, subtasks: Mapping[int, Sequence[tuple[float, str]]]) -> pa.Table:
    """A table of samples with these subtasks [(start in s, name), ...] by episode in its language rows."""
    fields = [("role", pa.string(), False), ("content", pa.string(), True), ("style", pa.string(), True)]
    more = [("camera", pa.string(), True), ("tool_calls", pa.list_(pa.string()), True)]
    episodes = table.column(EPISODE).to_numpy()
    by_episode: dict[int, list[dict[str, Any]]] = {}
    for number in np.unique(episodes).tolist():
        by_episode[number] = language_rows(table.filter(pa.array(episodes == number)))
        by_episode[number] += [
            {"role": "assistant", "content": name, "style": "subtask", "timestamp": start, "camera": None,
             "tool_calls": None}
            for start, name in subtasks.get(number, ())
        ]  # fmt: skip
    for name, each, filled in (
        (PERSISTENT, [*fields, ("timestamp", pa.float32(), False), *more], by_episode),
        (EVENTS, [*fields, *more], {key: list[dict[str, Any]]() for key in by_episode}),
    ):
        if name == EVENTS and name in table.column_names:
            continue
        kind = pa.list_(pa.struct([pa.field(key, kind, nullable=empty) for key, kind, empty in each]))
        values = pa.array([filled[number] for number in episodes.tolist()], type=kind)
        if hasattr(pa, "json_"):  # as LeRobot has it, where pyarrow knows it
            at = kind.value_type.get_field_index("tool_calls")
            inner = [kind.value_type.field(i) for i in range(kind.value_type.num_fields)]
            inner[at] = pa.field("tool_calls", pa.list_(pa.json_()))
            values = values.cast(pa.list_(pa.struct(inner)))
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, values)
        else:
            table = table.append_column(name, values)
    return table


def _rename_entries(columns: dict[str, np.ndarray], info: dict[str, Any]) -> dict[str, np.ndarray]:
    """Columns renamed to the names of the features' entries in info.json."""
    out: dict[str, np.ndarray] = {}
    labels = {}
    for name, feature in info["features"].items():
        names = feature.get("names") if isinstance(feature, dict) else None
        if isinstance(names, dict):  # {"motors": [...]}
            names = next(iter(names.values()), None)
        labels[name] = [str(each) for each in names] if isinstance(names, list) else []
    for column, values in columns.items():
        name, _, entry = column.partition("[")
        index = entry.rstrip("]")
        known = labels.get(name, [])
        if index.isdigit() and int(index) < len(known):
            column = f"{name}.{known[int(index)]}"
        out[column] = values
    return out
