"""`--write` of `hmmseg segment`: recordings written back with their segmentation, for training and viewers.

Tables (CSV, Parquet) get columns: `subtask_index` (from 0), `subtask`, `object`, `state`, and
`boundary_sd`, the standard deviation [s] of the nearer boundary of the sample's span. An MCAP
gets the topic `/hmmseg/subtask`, one JSON message a boundary. A LeRobot data set gets rows of style
`subtask` in its `language_persistent`, as its own tools have them, and the feature `boundary_sd`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.io.formats import kind_of, read_table, split_part
from hmmseg_cli.console import Output, check_file, check_folder

if TYPE_CHECKING:
    import numpy as np

    from hmmseg.io.trial import Trial
    from hmmseg.segmentation.spans import Span

KINDS = (".csv", ".parquet", ".mcap")


def check_destination(write: Path | None, paths: Sequence[Path]) -> None:
    """InputError unless labelled copies of these recordings can be written there."""
    if write is None:
        return
    where = f"--write {write}"
    if write.suffix.lower() in KINDS:
        if len(paths) > 1:
            raise InputError(where, f"is one file for {len(paths)} recordings", "a folder")
        check_file("--write", write, suffixes=KINDS)
    else:
        check_folder("--write", write)
        sets = {str(split_part(path)[0].resolve()) for path in paths if _is_set(path)}
        if sets and (len(sets) > 1 or not all(_is_set(path) for path in paths)):
            raise InputError(where, "mixes a data set with other recordings", "one data set, or none")
    given = {split_part(path)[0].resolve() for path in paths}
    for target in _targets(write, paths):
        if target.resolve() in given or write.resolve() in given:
            raise InputError(where, "would write over its own recording", "another place")


def write_labels(out: Output, write: Path, paths: Sequence[Path], trials: Sequence[Any],
                 found: Sequence[Any]) -> None:  # fmt: skip
    """Stage the labelled copies."""
    if _is_set(paths[0]):
        labelled = {
            int(split_part(path)[1] or 0): (trial, segmentation.spans)
            for path, trial, segmentation in zip(paths, trials, found, strict=True)
        }
        for place, write_to in lerobot_files(split_part(paths[0])[0], labelled).items():
            write_to(out.stage(write / place))
        return
    for target, path, trial, segmentation in zip(_targets(write, paths), paths, trials, found, strict=True):
        writer = write_mcap if target.suffix.lower() == ".mcap" else write_table
        staged = out.stage(target)
        writer(staged, path, trial, segmentation.spans)


def _targets(write: Path, paths: Sequence[Path]) -> list[Path]:
    """One file a recording: the one given, or in the folder under the recording's own name."""
    if write.suffix.lower() in KINDS:
        return [write]
    out = []
    for path in paths:
        file, part = split_part(path)
        kind = (
            ".mcap" if file.suffix.lower() == ".mcap" else ".parquet" if file.suffix == ".parquet" else ".csv"
        )
        out.append(write / f"{file.stem}{f'_{part}' if part else ''}{kind}")
    twice = [name for name in out if out.count(name) > 1]
    if twice:
        raise InputError(
            f"--write {write}", f"two recordings would become {twice[0].name}", "one folder each"
        )
    return out


def _is_set(path: Path) -> bool:
    return kind_of(split_part(path)[0]) == "lerobot"


TOPIC = "/hmmseg/subtask"
ADDED = ("subtask_index", "subtask", "object", "state", "boundary_sd")


@dataclass(frozen=True)
class Labels:
    """Of every sample (num_timesteps,): index of its span (-1 outside all), and boundary sd [s]."""

    index: np.ndarray
    boundary_sd: np.ndarray
    spans: tuple[Span, ...]

    def names(self, field: str) -> np.ndarray:
        """A field of each sample's span, empty where it has none."""
        import numpy as np

        entries = [getattr(span, field) or "" for span in self.spans]
        return np.array([*entries, ""], dtype=object)[self.index]


def label(t: np.ndarray, spans: Sequence[Span]) -> Labels:
    """Labels of samples at t (num_timesteps,) [s]; spans are half-open, the last keeps its end."""
    import numpy as np  # which `hmmseg --help` does without

    if not spans:
        return Labels(np.full(t.size, -1), np.full(t.size, np.nan), ())
    starts, ends = np.array([s.start for s in spans]), np.array([s.end for s in spans])
    index = np.searchsorted(starts, t, side="right") - 1
    last = (index == len(spans) - 1) & (t == ends[-1])
    index = np.where((index >= 0) & ((t < ends[index]) | last), index, -1)
    start_sd, end_sd = np.array([s.start_sd for s in spans]), np.array([s.end_sd for s in spans])
    sd = np.where(t - starts[index] < ends[index] - t, start_sd[index], end_sd[index])
    return Labels(index, np.where(index < 0, np.nan, sd), tuple(spans))


def write_table(path: Path, source: str | Path, trial: Trial, spans: Sequence[Span]) -> None:
    """The source's own columns with the labels added, as CSV or Parquet by the path's ending."""
    import pandas as pd

    table = read_table(source)
    labels = label(trial.t, spans)
    for name in ADDED:
        if name in table.names:
            raise InputError(f"{source}: column {name}", "is there already", "a recording without labels")
    columns = {"t": trial.t, **trial.channels} if table.messages else table.columns
    frame = pd.DataFrame(columns).assign(
        subtask_index=labels.index, subtask=labels.names("subtask"), object=labels.names("object"),
        state=labels.names("state"), boundary_sd=labels.boundary_sd,
    )  # fmt: skip
    if path.suffix.lower() == ".parquet":
        frame.to_parquet(path, index=False)
    else:
        frame.to_csv(path, index=False)


SCHEMA = {
    "title": "hmmseg.Subtask", "type": "object",
    "properties": {
        "subtask_index": {"type": "integer"}, "subtask": {"type": "string"}, "object": {"type": "string"},
        "state": {"type": "string"}, "start": {"type": "number"}, "end": {"type": "number"},
        "start_sd": {"type": "number"}, "end_sd": {"type": "number"},
    },
}  # fmt: skip


def write_mcap(path: Path, source: str | Path, trial: Trial, spans: Sequence[Span]) -> None:
    """A new MCAP with the topic of subtasks, and all messages of the source if it is one."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    origin = trial.origin or 0
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start(profile="", library="hmmseg")
        file, _ = split_part(source)
        if file.is_file() and kind_of(file) == "mcap":
            with file.open("rb") as original:
                _copy(make_reader(original), writer)
        schema = writer.register_schema("hmmseg.Subtask", "jsonschema", json.dumps(SCHEMA).encode())
        channel = writer.register_channel(TOPIC, "json", schema)
        for number, span in enumerate(spans):
            body = {"subtask_index": number, "subtask": span.subtask, "object": span.object or "",
                    "state": span.state, "start": span.start, "end": span.end,
                    "start_sd": span.start_sd, "end_sd": span.end_sd}  # fmt: skip
            when = origin + round(span.start * 1e9)
            writer.add_message(channel, when, json.dumps(body).encode(), when, number)
        writer.finish()


def _copy(reader: Any, writer: Any) -> None:
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    for schema, channel, message in reader.iter_messages():
        if schema is not None and schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
        writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time,
                           message.sequence)  # fmt: skip


def lerobot_files(folder: Path, labelled: Mapping[int, tuple[Trial, Sequence[Span]]]) -> dict[Path, Any]:
    """Files of an annotated copy by their place below its folder, each a function that writes it to a path.

    Episodes that are not labelled have no subtasks. Videos are not copied.
    """
    from hmmseg.io.formats.lerobot import EVENTS, PERSISTENT, data_files, read_info, read_subtasks

    info = read_info(folder)
    if {"boundary_sd", "subtask_index"} & set(info["features"]) or read_subtasks(folder):
        raise InputError(f"{folder}/meta/info.json", "has subtasks already", "no labels yet")
    for name in (PERSISTENT, EVENTS):
        info["features"].setdefault(name, {"dtype": "language", "shape": [1], "names": None})
    info["features"]["boundary_sd"] = {"dtype": "float32", "shape": [1], "names": None}
    out: dict[Path, Any] = {}
    for file in sorted((folder / "meta").rglob("*")):
        if file.is_file() and file.name != "info.json":
            out[file.relative_to(folder)] = lambda path, file=file: shutil.copyfile(file, path)
    text = json.dumps(info, indent=4)
    out[Path("meta/info.json")] = lambda path: path.write_text(text, encoding="utf-8")
    for file in data_files(folder):
        out[file.relative_to(folder)] = lambda path, file=file: _write_episodes(path, file, labelled)
    return out


def _write_episodes(path: Path, file: Path, labelled: Mapping[int, tuple[Trial, Sequence[Span]]]) -> None:
    import numpy as np
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
            sd[rows] = label(trial.t, spans).boundary_sd
            since = (
                table.column("timestamp").to_numpy()[rows] if "timestamp" in table.column_names else trial.t
            )
            subtasks[number] = [(float(np.interp(s.start, trial.t, since)), s.label) for s in spans]
    table = with_subtasks(table, subtasks).append_column("boundary_sd", pa.array(sd))
    pq.write_table(table, path)
