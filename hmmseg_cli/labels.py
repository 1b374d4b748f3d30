"""`hmmseg segment --write`: copies of recordings with their segmentation, for training and viewers.

Tables (CSV, Parquet) get the columns `subtask_index` (from 0), `subtask`, `object`, `state`, and
`boundary_sd`, the standard deviation [s] of the nearer boundary of the sample's span. An MCAP gets the topic
`/hmmseg/subtask`, with one JSON message per boundary. A LeRobot data set gets rows of style `subtask` in
`language_persistent`, as its own tools write them, and the feature `boundary_sd`.
"""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hmmseg.errors import InputError
from hmmseg.io.formats import kind_of, read_table, split_part
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Segmentation, Span
from hmmseg_cli.console import INPUT_SUFFIXES, Output, check_file, check_folder

KINDS = (".csv", ".parquet", ".mcap")


def check_destination(write: Path | None, paths: Sequence[Path]) -> None:
    """InputError unless labelled copies of these recordings can be written there."""
    if write is None:
        return
    where, given = f"--write {write}", {split_part(path)[0].resolve() for path in paths}
    if write.suffix.lower() in KINDS:
        if len(paths) > 1:
            raise InputError(where, f"is one file for {len(paths)} recordings", "a folder")
        check_file("--write", write, suffixes=KINDS)
    elif write.suffix.lower() in INPUT_SUFFIXES and not write.is_dir():
        raise InputError(where, "unknown kind of file", f"{', '.join(KINDS)}, or a folder")
    else:
        check_folder("--write", write)
        if any(map(_is_set, paths)) and (len(given) > 1 or not all(map(_is_set, paths))):
            raise InputError(where, "mixes a data set with other recordings", "one data set, or none")
    for target in _targets(write, paths):
        if target.resolve() in given or write.resolve() in given:
            raise InputError(where, "would write over its own recording", "another place")


def write_labels(
    out: Output, write: Path, paths: Sequence[Path], trials: Sequence[Trial], found: Sequence[Segmentation]
) -> None:
    """Stage the labelled copies."""
    if _is_set(paths[0]):
        numbers = [int(split_part(path)[1] or 0) for path in paths]
        labelled = {n: (t, s.spans) for n, t, s in zip(numbers, trials, found, strict=True)}
        for place, write_to in lerobot_files(split_part(paths[0])[0], labelled).items():
            write_to(out.stage(write / place))
        return
    for target, path, trial, segmentation in zip(_targets(write, paths), paths, trials, found, strict=True):
        writer = write_mcap if target.suffix.lower() == ".mcap" else write_table
        writer(out.stage(target), path, trial, segmentation.spans)


def _targets(write: Path, paths: Sequence[Path]) -> list[Path]:
    """One file per recording: the one given, or in the folder under the recording's own name."""
    if write.suffix.lower() in KINDS:
        return [write]
    out = []
    for file, part in map(split_part, paths):
        kind = file.suffix.lower() if file.suffix.lower() in KINDS else ".csv"
        out.append(write / f"{file.stem}{f'_{part}' if part else ''}{kind}")
    twice = [name for name in out if out.count(name) > 1]
    if twice:
        problem = f"two recordings would become {twice[0].name}"
        raise InputError(f"--write {write}", problem, "one folder each")
    return out


def _is_set(path: Path) -> bool:
    return kind_of(split_part(path)[0]) == "lerobot"


TOPIC = "/hmmseg/subtask"
ADDED = ("subtask_index", "subtask", "object", "state", "boundary_sd")


def label(t: np.ndarray, spans: Sequence[Span]) -> tuple[np.ndarray, np.ndarray]:
    """Index (num_timesteps,) of the span of each sample at t [s], -1 outside all, and its boundary sd [s].

    Spans are half-open, except for the end of the last."""
    if not spans:
        return np.full(t.size, -1), np.full(t.size, np.nan)
    starts, ends, start_sd, end_sd = np.array([(s.start, s.end, s.start_sd, s.end_sd) for s in spans]).T
    index = np.searchsorted(starts, t, side="right") - 1
    last = (index == len(spans) - 1) & (t == ends[-1])
    index = np.where((index >= 0) & ((t < ends[index]) | last), index, -1)
    sd = np.where(t - starts[index] < ends[index] - t, start_sd[index], end_sd[index])
    return index, np.where(index < 0, np.nan, sd)


def write_table(path: Path, source: str | Path, trial: Trial, spans: Sequence[Span]) -> None:
    """Write the source's columns with the labels added, as CSV or Parquet by the path's suffix."""
    table, (index, sd) = read_table(source), label(trial.t, spans)
    for name in ADDED:
        if name in table.names:
            raise InputError(f"{source}: column {name}", "is there already", "a recording without labels")
    columns = {"t": trial.t, **trial.channels} if table.messages else table.columns
    names = {field: np.array([*(getattr(s, field) or "" for s in spans), ""], dtype=object)[index]
             for field in ("subtask", "object", "state")}  # fmt: skip
    frame = pd.DataFrame(columns).assign(subtask_index=index, **names, boundary_sd=sd)
    write = frame.to_parquet if path.suffix.lower() == ".parquet" else frame.to_csv
    write(path, index=False)


FIELDS = {
    "subtask_index": "integer", "subtask": "string", "object": "string", "state": "string",
    "start": "number", "end": "number", "start_sd": "number", "end_sd": "number",
}  # fmt: skip


def write_mcap(path: Path, source: str | Path, trial: Trial, spans: Sequence[Span]) -> None:
    """Write an MCAP with the topic of subtasks, and all messages of the source if it is an MCAP."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    origin, types = trial.origin or 0, {name: {"type": kind} for name, kind in FIELDS.items()}
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start(profile="", library="hmmseg")
        file, _ = split_part(source)
        if file.is_file() and kind_of(file) == "mcap":
            with file.open("rb") as original:
                _copy(make_reader(original), writer)
        described = json.dumps({"title": "hmmseg.Subtask", "type": "object", "properties": types})
        schema = writer.register_schema("hmmseg.Subtask", "jsonschema", described.encode())
        channel = writer.register_channel(TOPIC, "json", schema)
        for number, span in enumerate(spans):
            body = {name: getattr(span, name, None) or "" for name in ("subtask", "object", "state")}
            times = {name: getattr(span, name) for name in ("start", "end", "start_sd", "end_sd")}
            entry = json.dumps({"subtask_index": number} | body | times)
            when = origin + round(span.start * 1e9)
            writer.add_message(channel, when, entry.encode(), when, number)
        writer.finish()  # type: ignore[no-untyped-call]


def _copy(reader: Any, writer: Any) -> None:
    schemas, channels = {0: 0}, dict[int, int]()
    for schema, channel, message in reader.iter_messages():
        if schema is not None and schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
        writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time,
                           message.sequence)  # fmt: skip


def lerobot_files(
    folder: Path, labelled: Mapping[int, tuple[Trial, Sequence[Span]]]
) -> dict[Path, Callable[[Path], object]]:
    """Files of an annotated copy by their place in its folder, each with a function that writes it to a path.
    Episodes without labels get no subtasks. Videos are not copied."""
    from hmmseg.io.formats.lerobot import EVENTS, PERSISTENT, data_files, read_info, read_subtasks

    info = read_info(folder)
    if {"boundary_sd", "subtask_index"} & set(info["features"]) or read_subtasks(folder):
        raise InputError(f"{folder}/meta/info.json", "has subtasks already", "no labels yet")
    for name in (PERSISTENT, EVENTS):
        info["features"].setdefault(name, {"dtype": "language", "shape": [1], "names": None})
    info["features"]["boundary_sd"] = {"dtype": "float32", "shape": [1], "names": None}
    copied = [f for f in (folder / "meta").rglob("*") if f.is_file() and f.name != "info.json"]
    out: dict[Path, Callable[[Path], object]] = {
        file.relative_to(folder): partial(shutil.copyfile, file) for file in sorted(copied)
    }
    text = json.dumps(info, indent=4)
    out[Path("meta/info.json")] = lambda path: path.write_text(text, encoding="utf-8")
    return out | {f.relative_to(folder): partial(_write_episodes, f, labelled) for f in data_files(folder)}


def _write_episodes(file: Path, labelled: Mapping[int, tuple[Trial, Sequence[Span]]], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from hmmseg.io.formats.lerobot import EPISODE, with_subtasks

    table = pq.read_table(file)
    episodes = table.column(EPISODE).to_numpy()
    sd = np.full(len(episodes), np.nan, dtype=np.float32)
    subtasks = {}
    for number, (trial, spans) in labelled.items():
        rows = episodes == number
        if rows.sum() == trial.t.size:
            sd[rows] = label(trial.t, spans)[1]
            stamped = "timestamp" in table.column_names
            since = table.column("timestamp").to_numpy()[rows] if stamped else trial.t
            subtasks[number] = [(float(np.interp(s.start, trial.t, since)), s.label) for s in spans]
    table = with_subtasks(table, subtasks).append_column("boundary_sd", pa.array(sd))
    pq.write_table(table, path)
