"""Logs of messages: MCAP, ROS 1 bags (.bag) and ROS 2 bags (a folder, or its .db3).

A column of a log is a topic and a field as Foxglove writes them, `/left/wrench.wrench.force.x` or
`/hand.data[2]`; fields of a message that names its entries (a JointState) carry those names,
`/joint_states.position.left_1`. A topic has all columns that any of its messages names, each at the rate of
those messages. A message's time is the stamp in its header if every wanted topic has stamps of one clock,
else the time of logging: two clocks are never mixed.

All wanted columns are joined on the times of the fastest. Slower ones are interpolated linearly between
neighbouring messages and marked; where these are more than three of the column's usual periods apart, and
before its first and after its last message, they are missing (NaN).

Files are read from the beginning, without index, summary or metadata.yaml: an unfinished recording is read as
far as it goes, with a note. Topics of unknown types are left out, likewise.
"""

import bz2
import dataclasses
import json
import math
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import BufferedIOBase, BufferedReader, BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import Table, shown
from hmmseg.levels import GAP

MAX_ENTRIES = 64  # numerics: of an array in a message; images and clouds are no channels
MAX_MESSAGES = 20_000_000  # limit: more is a damaged or hostile file
MAX_CHUNK = 2**30  # limit: bytes of an unpacked chunk
LATE = 1e9  # limit: ns between a message's stamp and its logging; more is another clock
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of Zstandard data

Message = tuple[str, int, Callable[[], Any]]  # topic, when it was logged [ns since 1970], how to decode it


@dataclass
class Stream:
    """Messages of one topic while they are read."""

    topic: str
    logged: list[int] = field(default_factory=list)  # [ns since 1970]
    stamped: list[int] = field(default_factory=list)  # [ns since 1970], 0 without a stamp
    values: list[dict[str, float]] = field(default_factory=list)  # flat fields
    failed: int = 0  # messages that could not be decoded
    reason: str = ""  # of the first of these

    def add(self, logged: int, decode: Callable[[], Any]) -> None:
        """Keep one message, or the reason why it cannot be decoded."""
        try:
            message = decode()
            values = dict(_flatten(message, self.topic))
        except Exception as error:  # decoders raise anything on hostile messages
            self.failed += 1
            self.reason = self.reason or shown(error) or type(error).__name__
            return
        self.logged.append(logged)
        self.stamped.append(_stamp(message))
        self.values.append(values)
        if len(self.logged) > MAX_MESSAGES:
            raise InputError(self.topic, f"has over {MAX_MESSAGES} messages")

    @property
    def names(self) -> list[str]:
        """Columns of this topic: all that any message names."""
        return list(dict.fromkeys(name for each in self.values for name in each))

    def columns(self, by_header: bool) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Columns named by the same messages: distinct increasing times (num_messages,) [ns], values."""
        times = np.array(self.stamped if by_header else self.logged, dtype=np.int64)
        where: dict[str, list[int]] = {}
        for i, each in enumerate(self.values):
            for name in each:
                where.setdefault(name, []).append(i)
        together: dict[tuple[int, ...], list[str]] = {}
        for name, indices in where.items():
            together.setdefault(tuple(indices), []).append(name)
        for indices, names in together.items():
            at = np.array(indices)
            at = at[np.argsort(times[at], kind="stable")]
            at = at[np.append(np.diff(times[at]) > 0, True)]  # the last of simultaneous messages counts
            yield times[at], {n: np.array([self.values[i][n] for i in at], dtype=np.float64) for n in names}


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """The wanted columns on one clock; of other topics only the first message is decoded."""
    streams: dict[str, Stream] = {}
    notes: list[str] = []
    count = 0
    try:
        for topic, logged, decode in _messages(path, notes):
            count += 1
            stream = streams.setdefault(topic, Stream(topic))
            if topic_wanted(topic, wanted) or not (stream.values or stream.failed):
                stream.add(logged, decode)
    except InputError:
        raise
    except Exception as error:  # parsers raise anything on truncated files
        if not any(stream.values for stream in streams.values()):
            raise
        notes.append(f"{path}: breaks off after {count} messages ({shown(error) or type(error).__name__}); "
                     "what comes before is read")  # fmt: skip
    for stream in streams.values():
        if not stream.failed or (wanted is not None and not topic_wanted(stream.topic, wanted)):
            continue
        if wanted is not None and not stream.values:
            raise InputError(f"{path}: topic {stream.topic}", f"cannot be decoded ({stream.reason})",
                             "messages of ROS with a known type, or JSON")  # fmt: skip
        which = f"{stream.failed} messages of topic" if stream.values else "topic"
        notes.append(f"{path}: {which} {stream.topic} cannot be decoded ({stream.reason}) and is left out")
    return join_streams(str(path), list(streams.values()), wanted, notes)


def _messages(path: Path, notes: list[str]) -> Iterator[Message]:
    """All messages of a file or folder, in order; missing parts are reported in `notes`."""
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            notes.append(f"{path}: has no metadata.yaml: the recording was not finished; all files are read")
        files = sorted(file for end in ("mcap", "db3") for file in path.glob(f"*.{end}"))
        if not files:
            yield from _compressed_messages(path)
        for file in files:
            yield from _messages(file, notes)
    elif path.suffix.lower() == ".mcap":
        with path.open("rb") as file:
            yield from _mcap_messages(file, path, notes)
    elif path.suffix.lower() == ".db3":
        yield from _db3_messages(path)
    else:
        with path.open("rb") as file:
            yield from _bag_messages(file, path, notes)


def _mcap_messages(file: BufferedReader, path: Path, notes: list[str]) -> Iterator[Message]:
    from mcap import records
    from mcap.stream_reader import StreamReader
    from mcap_ros2.decoder import DecoderFactory

    schemas: dict[int, records.Schema] = {}
    channels: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
    factory, finished = DecoderFactory(), False

    def decoder(channel: records.Channel) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return json.loads

        def decode(data: bytes) -> Any:
            found = factory.decoder_for(channel.message_encoding, schemas.get(channel.schema_id))
            if found is None:
                raise ValueError(f"is encoded as {channel.message_encoding!r}, not as cdr (ROS 2) or json")
            return found(data)

        return decode

    for record in StreamReader(file, validate_crcs=True).records:
        if isinstance(record, records.Schema):
            schemas[record.id] = record
        elif isinstance(record, records.Channel):
            channels[record.id] = record.topic, decoder(record)
        elif isinstance(record, records.Message):
            topic, decode = channels[record.channel_id]
            yield topic, record.log_time, partial(decode, record.data)
        finished = finished or isinstance(record, records.Footer)
    if not finished:
        notes.append(f"{path}: has no end: the recording was broken off and is read as far as it goes")


def _db3_messages(path: Path) -> Iterator[Message]:
    """Messages of a ROS 2 bag's database, in the order of writing."""
    waiting = Path(f"{path}-wal")  # SQLite's write-ahead log, not yet merged
    how = "mode=ro" if waiting.is_file() and waiting.stat().st_size else "immutable=1"
    with sqlite3.connect(f"file:{quote(str(path.absolute()))}?{how}", uri=True) as base:
        try:
            columns = "topic_type, encoding, encoded_message_definition"
            found = base.execute(f"SELECT {columns} FROM message_definitions")
            definitions = {name: (encoding, text) for name, encoding, text in found}
        except sqlite3.OperationalError:  # older than ROS 2 Iron
            definitions = {}
        topics = {}
        for number, topic, kind in base.execute("SELECT id, name, type FROM topics"):
            topics[number] = topic, _Decoder(kind, *definitions.get(kind, ("", "")))
        for number, logged, data in base.execute("SELECT topic_id, timestamp, data FROM messages"):
            topic, decode = topics[number]
            yield topic, logged, partial(decode, data)


def _compressed_messages(folder: Path) -> Iterator[Message]:
    """Messages of a ROS 2 bag whose files are compressed."""
    from rosbags.rosbag2 import Reader

    with Reader(folder) as reader:
        decoders = {c.id: _Decoder(c.msgtype, f"ros2{c.msgdef.format.name.lower()}", c.msgdef.data)
                    for c in reader.connections}  # fmt: skip
        for connection, logged, data in reader.messages():
            yield connection.topic, logged, partial(decoders[connection.id], data)


def _bag_messages(file: BufferedIOBase, path: Path, notes: list[str]) -> Iterator[Message]:
    """Messages of a ROS 1 bag (wiki.ros.org/Bags/Format/2.0), record after record, without its index."""
    if not file.readline(20).startswith(b"#ROSBAG V2.0"):
        raise InputError(str(path), "is no ROS 1 bag of version 2.0", "a .bag file")
    topics: dict[bytes, tuple[str, _Decoder]] = {}
    for head, data in _records(file):
        kind = head[b"op"]
        if kind == b"\x03" and head.get(b"index_pos") == bytes(8):
            notes += [f"{path}: has no index: the recording was not finished; it is read as far as it goes"]
        inside = [(head, data)] if kind != b"\x05" else _records(_decompress(head, data))
        for inner, content in inside:
            if inner[b"op"] == b"\x07":
                declared = _parse_fields(content)
                kind_name = declared[b"type"].decode().replace("/", "/msg/")
                decoder = _Decoder(kind_name, "ros1", declared[b"message_definition"].decode())
                topics[inner[b"conn"]] = inner[b"topic"].decode(), decoder
            elif inner[b"op"] == b"\x02":
                seconds, rest = struct.unpack("<II", inner[b"time"])
                topic, decode = topics[inner[b"conn"]]
                yield topic, seconds * 1_000_000_000 + rest, partial(decode, content)


def _records(file: BufferedIOBase) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    while size := file.read(4):
        head = _parse_fields(_read_exactly(file, int.from_bytes(size, "little")))
        yield head, _read_exactly(file, int.from_bytes(_read_exactly(file, 4), "little"))


def _read_exactly(file: BufferedIOBase, size: int) -> bytes:
    data = file.read(size)  # allocates no more than the file has
    if len(data) < size:
        raise EOFError("the file ends within a record")
    return data


def _parse_fields(data: bytes) -> dict[bytes, bytes]:
    out, at = {}, 0
    while at < len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : end].partition(b"=")
        out[name], at = value, end
    return out


def _decompress(head: dict[bytes, bytes], data: bytes) -> BufferedIOBase:
    how, size = head[b"compression"], int.from_bytes(head[b"size"], "little")
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk claims {size} bytes")
    if how == b"bz2":
        data = bz2.BZ2Decompressor().decompress(data, max_length=size)
    elif how == b"lz4":
        from lz4.frame import LZ4FrameDecompressor

        data = LZ4FrameDecompressor().decompress(data, max_length=size)
    elif how != b"none":
        raise ValueError(f"a chunk is packed by {shown(how)}")
    return BytesIO(data)


class _Decoder:
    """Decodes messages of one ROS type; the definition is parsed at the first message."""

    def __init__(self, kind: str, encoding: str, definition: str) -> None:
        self.kind, self.encoding, self.definition = kind, encoding, definition
        self._decode: Callable[[bytes, str], Any] | None = None

    def __call__(self, data: bytes) -> Any:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        if self._decode is None:
            store = get_typestore(Stores.EMPTY if self.definition else Stores.ROS2_HUMBLE)
            if self.definition and self.encoding == "ros2idl":
                store.register(get_types_from_idl(self.definition.split("=" * 80 + "\n")[-1]))
            elif self.definition:
                store.register(get_types_from_msg(self.definition, self.kind))
            if self.kind not in store.types:
                raise ValueError(f"the bag does not define its type {self.kind}")
            self._decode = store.deserialize_ros1 if self.encoding == "ros1" else store.deserialize_cdr
        if data[:4] == ZSTD:
            import zstandard

            data = zstandard.decompress(data, max_output_size=MAX_CHUNK)
        return self._decode(data, self.kind)


def topic_wanted(topic: str, wanted: Sequence[str] | None) -> bool:
    """Whether any wanted column may belong to this topic."""
    return wanted is None or any(each.startswith((f"{topic}.", f"{topic}[")) for each in wanted)


def join_streams(
    file: str, streams: Sequence[Stream], wanted: Sequence[str] | None, notes: Sequence[str] = ()
) -> Table:
    """One table of all wanted columns, on the times of the fastest of them."""
    names = ("t", *(name for stream in streams for name in stream.names))
    used = [s for s in streams if s.values and (wanted is None or set(s.names) & set(wanted))]
    if not used:
        return Table(file, names, {"t": np.zeros(0)}, np.arange(0), messages=True, notes=tuple(notes))
    by_header, clock_notes = _clock_of(file, used)
    read = []
    for stream in used:
        for times, found in stream.columns(by_header):
            kept = {name: v for name, v in found.items() if wanted is None or name in wanted}
            read += [(times, kept)] if kept else []
    ticks = min((times for times, _ in read), key=lambda each: (_period(each), -each.size))
    columns: dict[str, np.ndarray] = {"t": (ticks - ticks[0]) * 1e-9}
    marks: dict[str, np.ndarray] = {}
    rates: dict[str, float] = {}
    for times, found in read:
        for name, values in found.items():
            rates[name] = 1e9 / _period(times)
            if times is ticks:
                columns[name] = values
            else:
                columns[name], marks[name] = interpolated(ticks, times, values)
    return Table(file, names, columns, np.arange(1, ticks.size + 1), origin=int(ticks[0]), interpolated=marks,
                 messages=True, rates=rates, notes=(*notes, *clock_notes))  # fmt: skip


def _clock_of(file: str, used: Sequence[Stream]) -> tuple[bool, list[str]]:
    """Whether the headers' stamps are of one clock, and a note if they are of several. Messages of one
    recorder are logged by one clock, soon after they are stamped. Their stamps lag by much the same, even if
    they count from another zero (simulated time)."""
    if not all(all(stream.stamped) for stream in used):
        return False, []
    late = {s.topic: np.quantile(np.array(s.logged) - np.array(s.stamped), [0.05, 0.5, 0.95]) for s in used}
    first, last = min(late, key=lambda t: late[t][0]), max(late, key=lambda t: late[t][2])
    if late[last][2] - late[first][0] <= LATE:
        return True, []
    (low, one, high), (_, other, _) = late[first] / 1e9, late[last] / 1e9
    text = (f"stamps of {first} lie {one:.4g} s behind the times of logging, those of {last} {other:.4g} s: "
            "two clocks; the times of logging are used")  # fmt: skip
    if first == last:
        text = (f"the stamps of {first} lie {low:.4g} to {high:.4g} s behind the times of logging: their "
                "clock was set meanwhile; the latter are used")  # fmt: skip
    return False, [f"{file}: {text}"]


def interpolated(ticks: np.ndarray, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values at the ticks (num_ticks,), NaN in gaps, and which of them lie between two messages. `ticks` and
    `times` are in ns (or s), increasing; NaN among `values` (num_messages,) are skipped."""
    there = np.isfinite(values)
    times, values = times[there], values[there]
    if not times.size:
        return np.full(ticks.size, np.nan), np.zeros(ticks.size, dtype=bool)
    exact = np.isin(ticks, times)
    span = np.pad(np.diff(times), 1)[np.searchsorted(times, ticks)]  # 0 before the first and after the last
    near = ~exact & (span > 0) & (span <= GAP * _period(times))
    # Times in ns exceed the precision of floating-point numbers, their differences do not.
    out = np.interp(ticks - times[0], times - times[0], values)
    return np.where(exact | near, out, np.nan), near


def _period(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if times.size > 1 else math.inf


def _stamp(message: Any) -> int:
    """The header's stamp [ns], 0 if there is none."""
    stamp = _get(_get(message, "header"), "stamp")
    seconds = _get(stamp, "sec", _get(stamp, "secs", 0))
    fraction = _get(stamp, "nanosec", _get(stamp, "nsec", _get(stamp, "nsecs", 0)))
    return int(seconds) * 1_000_000_000 + int(fraction)


def _get(thing: Any, name: str, default: Any = None) -> Any:
    return thing.get(name, default) if isinstance(thing, dict) else getattr(thing, name, default)


def _members(message: Any) -> Iterator[tuple[str, Any]] | None:
    """Named members of a message of any library, None for anything else."""
    if isinstance(message, dict):
        return iter(message.items())
    if dataclasses.is_dataclass(message):
        return ((f.name, getattr(message, f.name)) for f in dataclasses.fields(message))
    if hasattr(type(message), "__slots__") and not isinstance(message, str | bytes | np.generic | np.ndarray):
        return ((name, getattr(message, name)) for name in type(message).__slots__ if name[0] != "_")
    return None


def _flatten(message: Any, prefix: str, depth: int = 0) -> Iterator[tuple[str, float]]:
    if isinstance(message, bool | str | bytes) or message is None or depth > 12:
        return
    if isinstance(message, int | float | np.number):
        yield prefix, float(message)
        return
    if isinstance(message, list | tuple | np.ndarray):
        if 0 < len(message) <= MAX_ENTRIES:
            for i, entry in enumerate(message):
                yield from _flatten(entry, f"{prefix}[{i}]", depth + 1)
        return
    members = _members(message)
    if members is None:
        return
    labels = _get(message, "name")
    if not isinstance(labels, list | tuple) or not all(isinstance(n, str) for n in labels):
        labels = []
    for name, value in members:
        if name == "header" or name.startswith("__"):
            continue
        if labels and isinstance(value, list | tuple | np.ndarray) and len(value) == len(labels):
            for label, entry in zip(labels, value, strict=True):
                yield from _flatten(entry, f"{prefix}.{name}.{label}", depth + 1)
        else:
            yield from _flatten(value, f"{prefix}.{name}", depth + 1)
