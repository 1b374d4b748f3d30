"""Logs made of messages: topics at rates of their own, joined on the fastest clock wanted.

A column of a log is a topic and a field as Foxglove writes them, `/left/wrench.wrench.force.x`
or `/hand.data[2]`; fields of a message that names its entries (a JointState) carry those names,
`/joint_states.position.left_1`. A message's time is the stamp in its header where every wanted
topic has one, and else when it was logged: two clocks are never mixed.

Channels of slower topics are interpolated linearly between their two neighbouring messages and
marked; where these lie further apart than three of the topic's usual periods, and before its
first and after its last message, they are missing (NaN).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import Table
from hmmseg.levels import GAP

MAX_ENTRIES = 64  # numerics: of an array in a message: images and clouds are no channels
MAX_MESSAGES = 20_000_000  # limit: more is a damaged or hostile file


@dataclass
class Stream:
    """Messages of one topic while they are read: times [ns since 1970] and flat fields."""

    topic: str
    kind: str
    logged: list[int] = field(default_factory=list)
    stamped: list[int] = field(default_factory=list)
    values: list[dict[str, float]] = field(default_factory=list)

    def add(self, logged: int, message: Any) -> None:
        """Keep one decoded message."""
        self.logged.append(logged)
        stamp = _stamp(message)
        if stamp:
            self.stamped.append(stamp)
        self.values.append(dict(_flat(message, "")))
        if len(self.logged) > MAX_MESSAGES:
            raise InputError(self.topic, f"has over {MAX_MESSAGES} messages")

    @property
    def names(self) -> list[str]:
        """Columns of this topic, in the order of its first message."""
        return [f"{self.topic}{name}" for name in (self.values[0] if self.values else ())]

    def arrays(self, by_header: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Times (num_messages,) [ns] in order, no two alike, and columns (num_messages,)."""
        times = np.array(self.stamped if by_header else self.logged, dtype=np.int64)
        order = np.argsort(times, kind="stable")
        last = np.append(np.diff(times[order]) > 0, True)  # of messages at one time the last counts
        keep = order[last] if times.size else order
        names = dict.fromkeys(name for each in self.values for name in each)
        columns = {
            f"{self.topic}{name}": np.array(
                [self.values[i].get(name, np.nan) for i in keep], dtype=np.float64
            )
            for name in names
        }
        return times[keep], columns


def topic_wanted(topic: str, wanted: Sequence[str] | None) -> bool:
    """Whether any wanted column may be of this topic."""
    return wanted is None or any(each.startswith((f"{topic}.", f"{topic}[")) for each in wanted)


def joined(file: str, streams: Sequence[Stream], wanted: Sequence[str] | None) -> Table:
    """One table of all wanted columns on the clock of the fastest topic among them."""
    names = ("t", *(name for stream in streams for name in stream.names))
    used = [s for s in streams if s.values and (wanted is None or set(s.names) & set(wanted))]
    if not used:
        return Table(file, names, {"t": np.zeros(0)}, np.arange(0), messages=True)
    by_header = all(len(stream.stamped) == len(stream.values) for stream in used)
    read = {stream.topic: stream.arrays(by_header) for stream in used}
    clock = min(read, key=lambda topic: (_period(read[topic][0]), -read[topic][0].size))
    ticks = read[clock][0]
    columns: dict[str, np.ndarray] = {"t": (ticks - ticks[0]) * 1e-9}
    marks: dict[str, np.ndarray] = {}
    rates: dict[str, float] = {}
    for topic, (times, found) in read.items():
        for name, values in found.items():
            if wanted is not None and name not in wanted:
                continue
            rates[name] = 1e9 / _period(times)
            if topic == clock:
                columns[name] = values
            else:
                columns[name], marks[name] = interpolated(ticks, times, values)
    return Table(file, names, columns, np.arange(1, ticks.size + 1), origin=int(ticks[0]),
                 interpolated=marks, messages=True, rates=rates)  # fmt: skip


def interpolated(ticks: np.ndarray, times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values at the ticks (num_ticks,), NaN in gaps, and which lie between two messages.

    `ticks` and `times` are in ns, increasing; `values` (num_messages,), of which NaN are left out.
    """
    there = np.isfinite(values)
    times, values = times[there], values[there]
    if not times.size:
        return np.full(ticks.size, np.nan), np.zeros(ticks.size, dtype=bool)
    after = np.searchsorted(times, ticks, side="left")
    exact = (after < times.size) & (times[np.minimum(after, times.size - 1)] == ticks)
    inside = (after > 0) & (after < times.size)
    low, high = np.clip(after - 1, 0, None), np.minimum(after, times.size - 1)
    span = times[high] - times[low]
    near = inside & (span > 0) & (span <= GAP * _period(times))
    share = np.where(near, (ticks - times[low]) / np.where(near, span, 1), 0.0)
    between = values[low] + share * (values[high] - values[low])
    out = np.where(exact, values[high], np.where(near, between, np.nan))
    return out, near & ~exact


def _period(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) if times.size > 1 else math.inf


def _stamp(message: Any) -> int:
    """The header's stamp [ns], 0 where there is none."""
    stamp = _get(_get(message, "header"), "stamp")
    seconds = _get(stamp, "sec", _get(stamp, "secs", 0))
    fraction = _get(stamp, "nanosec", _get(stamp, "nsec", _get(stamp, "nsecs", 0)))
    return int(seconds) * 1_000_000_000 + int(fraction)


def _get(thing: Any, name: str, default: Any = None) -> Any:
    return thing.get(name, default) if isinstance(thing, dict) else getattr(thing, name, default)


def _members(message: Any) -> Iterator[tuple[str, Any]] | None:
    """Named members of a message of any library, None for what is no message."""
    if isinstance(message, dict):
        return iter(message.items())
    if dataclasses.is_dataclass(message):
        return ((f.name, getattr(message, f.name)) for f in dataclasses.fields(message))
    if hasattr(type(message), "__slots__") and not isinstance(message, str | bytes | np.generic | np.ndarray):
        return ((name, getattr(message, name)) for name in type(message).__slots__ if name[0] != "_")
    return None


def _flat(message: Any, prefix: str, depth: int = 0) -> Iterator[tuple[str, float]]:
    if isinstance(message, bool | str | bytes) or message is None or depth > 12:
        return
    if isinstance(message, int | float | np.number):
        yield prefix, float(message)
        return
    if isinstance(message, list | tuple | np.ndarray):
        if 0 < len(message) <= MAX_ENTRIES:
            for i, entry in enumerate(message):
                yield from _flat(entry, f"{prefix}[{i}]", depth + 1)
        return
    members = _members(message)
    if members is None:
        return
    labels = _get(message, "name")
    labels = (
        list(labels) if isinstance(labels, list | tuple) and all(isinstance(n, str) for n in labels) else []
    )
    for name, value in members:
        if name == "header" or name.startswith("__"):
            continue
        if labels and isinstance(value, list | tuple | np.ndarray) and len(value) == len(labels):
            for label, entry in zip(labels, value, strict=True):
                yield from _flat(entry, f"{prefix}.{name}.{label}", depth + 1)
        else:
            yield from _flat(value, f"{prefix}.{name}", depth + 1)
