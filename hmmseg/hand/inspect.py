"""What is in a recording's file, and a proposed mapping that would read it.

Channels come with their units, rates, gaps and ranges. Names are split into words: which finger (left,
right, 1, 2), which quantity (position, velocity, force, joint), which axis. If there are three axes, the
plane of the work is inferred from the fingers' motion. The checks of `hmmseg.hand.plausibility` correct the
proposal; a person confirms it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.plausibility import check_clock, entry_text
from hmmseg.hand.read import findings
from hmmseg.io.formats import parts_of, read_table
from hmmseg.io.rig import Rig
from hmmseg.io.table import Table, numbers
from hmmseg.io.trial import (
    CARTESIAN_CHANNELS,
    CARTESIAN_OPTIONAL,
    JOINT_CHANNELS,
    MIN_SAMPLES,
    Trial,
    mapped_times,
    trial_of,
)
from hmmseg.io.units import UNITS, Column, measures, unit_in_name
from hmmseg.levels import GAP
from hmmseg.robust import extent

BUCKETS = 24  # numerics: of a small plot


@dataclass(frozen=True)
class Channel:
    """One column: its unit if the file or its name states one, its rate [Hz] if times are known, how many
    samples are missing or interpolated, its range, and its course as a few means.
    """

    name: str
    unit: str | None
    rate: float | None
    samples: int
    missing: int
    interpolated: int
    minimum: float | None
    maximum: float | None
    course: tuple[float, ...]
    text: bool = False


@dataclass(frozen=True)
class Inspection:
    """One file: its recordings, its clock, gaps [(start, end) in s], channels and proposed mapping.

    `understood`: whether all that a hand needs (this rig's, or one of two fingers) is there under our names.
    """

    file: str
    parts: tuple[str, ...]
    samples: int
    start: float | None
    end: float | None
    rate: float | None
    origin: int | None
    gaps: tuple[tuple[float, float], ...]
    channels: tuple[Channel, ...]
    mapping: dict[str, dict[str, Any]]
    toml: str
    remarks: tuple[str, ...]
    understood: bool


def inspect(path: str | Path, rig: Rig | None = None) -> Inspection:
    """Contents of a file (of several recordings the first), checked with the rig if it is given."""
    parts = parts_of(path)
    table = read_table(f"{path}#{parts[0]}" if parts else path)
    if not table.names or not table.rows.size:
        raise InputError(str(path), "is empty", "a header row and a row for every sample")
    already = {} if rig is None else (rig.topics if table.messages else rig.columns)
    entries = {} if already else propose(table)
    entries, remarks = correct(table, entries, rig)
    by_length: dict[int, list[str]] = {}
    for name, values in table.columns.items():
        by_length.setdefault(len(values), []).append(name)
    others = f"not {table.rows.size} as the others: they are not read together"
    odd = [f"columns {', '.join(names)} have {length} rows, {others}"
           for length, names in by_length.items() if length != table.rows.size]  # fmt: skip
    remarks = [*table.notes, *(f"{path}: {line}" for line in (*odd, *remarks))]
    toml = as_toml(entries, table) if entries else ""
    if set(entries) <= {"t"} and not already and (rig is None or rig.gripper is None):
        toml = propose_gripper(table, entries) or toml
    t, origin, refused = _clock(table, entries, rig)
    remarks += refused
    channels = tuple(_channel(table, name, t) for name in table.names if name in table.columns)
    start, end, rate, gaps = None, None, None, ()
    if t is not None:
        period = np.median(np.diff(t))
        start, end, rate = float(t[0]), float(t[-1]), float(1 / period)
        gaps = tuple((float(t[i]), float(t[i + 1])) for i in np.flatnonzero(np.diff(t) > GAP * period))
    return Inspection(
        str(path), tuple(parts), int(table.rows.size), start, end, rate, origin, gaps, channels, entries,
        toml, tuple(remarks), not toml and _understood(table, None if refused else rig),
    )  # fmt: skip


def _understood(table: Table, rig: Rig | None) -> bool:
    hands = (set(CARTESIAN_CHANNELS) - set(CARTESIAN_OPTIONAL), set(JOINT_CHANNELS))
    if rig is None:
        return any(wanted <= set(table.names) for wanted in hands)
    try:
        return bool(trial_of(table, rig, None).channels)
    except InputError:
        return False


def _clock(table: Table, entries: dict[str, dict[str, Any]], rig: Rig | None
           ) -> tuple[np.ndarray | None, int | None, list[str]]:  # fmt: skip
    """Times [s] by the proposal or the rig, None if the file has none that can be used, and why not."""
    rig = rig or Rig()
    if "t" in entries:
        rig = rig.model_copy(update={"columns": {**rig.columns, "t": Column.model_validate(entries["t"])}})
    try:
        return *mapped_times(table, rig), []
    except InputError as error:
        there = "t" in {*table.names, *rig.columns} and table.rows.size >= MIN_SAMPLES
        return None, None, [str(error)] if there else []


def _channel(table: Table, name: str, t: np.ndarray | None) -> Channel:
    unit = "s" if table.messages and name == "t" else table.units.get(name) or unit_in_name(name)
    between = int(table.interpolated[name].sum()) if name in table.interpolated else 0
    try:
        values = numbers(table, name)
    except InputError:
        return Channel(name, unit, None, len(table.columns[name]), 0, 0, None, None, (), text=True)
    there = values[np.isfinite(values)]
    rate = table.rates.get(name)
    if rate is None and t is not None and there.size:
        rate = float((there.size - 1) / (t[-1] - t[0]))
    low, high = (float(there.min()), float(there.max())) if there.size else (None, None)
    pieces = [p[np.isfinite(p)] for p in np.array_split(values, min(BUCKETS, max(values.size, 1)))]
    course = tuple(float(p.mean()) if p.size else np.nan for p in pieces)
    return Channel(name, unit, rate, values.size, values.size - there.size, between, low, high, course)


TIME = ("t", "time", "timestamp", "stamp", "timestamps", "sec", "seconds", "clock", "times", "zeit",
        "zeitstempel", "elapsed")  # fmt: skip
LEFT = {"left", "l", "lf", "finger1", "f1", "thumb", "1", "lh", "links", "linker"}
RIGHT = {"right", "r", "rf", "finger2", "f2", "index", "2", "rh", "rechts", "rechter"}
QUANTITIES = {
    "v": {"v", "vel", "velocity", "velocities", "speed", "twist", "vx", "vy", "vz", "geschwindigkeit"},
    "f": {"f", "force", "forces", "wrench", "load", "fx", "fy", "fz", "kraft"},
    "dq": {"dq", "qd", "qdot", "jointvel", "dtheta"},
    "q": {"q", "joint", "joints", "angle", "theta", "qpos", "winkel"},
    "p": {"pos", "position", "positions", "pose", "tip", "xyz", "x", "y", "z", "point", "weg", "lage"},
}
VECTORS = {3: "xyz", 4: "xyzw"}
MOVES = 1e-3  # numerics: share of the longest travel; along an axis with less the fingers do not work
AXES = {"x": {"x", "fx", "vx"}, "y": {"y", "fy", "vy"}, "z": {"z", "fz", "vz"}}
TURNING = {"torque", "moment", "mx", "my", "mz", "tx", "ty", "tz", "orientation", "quaternion", "rot"}


def propose(table: Table) -> dict[str, dict[str, Any]]:
    """Entries of `[columns]` (`[topics]` for a log) by our channel; empty if none is needed or found.

    An entry has a unit if the file or the name states one that is not SI.
    """
    names = [name for name in table.names if name != "t" or not table.messages]
    sources: dict[str, str] = {} if table.messages else _time_column(names)
    for channels in (CARTESIAN_CHANNELS, JOINT_CHANNELS):
        found = {channel: channel for channel in channels if channel in names}
        found |= {channel: name for channel, name in _match_channels(names, table).items()
                  if channel in channels and channel not in found}  # fmt: skip
        if len(found) > len(channels) / 2:
            sources |= found
            break
    out: dict[str, dict[str, Any]] = {}
    for channel, source in sources.items():
        unit, fields = table.units.get(source) or unit_in_name(source), {"from": source}
        if unit is not None and UNITS[unit][0] == measures(channel) and UNITS[unit][1] != 1:
            fields["unit"] = unit
        if fields != {"from": channel}:
            out[channel] = fields
    return out


def correct(table: Table, entries: dict[str, dict[str, Any]], rig: Rig | None = None
           ) -> tuple[dict[str, dict[str, Any]], list[str]]:  # fmt: skip
    """The proposal corrected by the checks of the recording, and their findings, line by line.

    Without a rig the lengths of links are unknown, so that a jointed hand is checked only with its rig.
    """
    rig = rig or Rig()
    remarks: list[str] = []
    for _ in range(8):
        mapping = {name: Column.model_validate(fields) for name, fields in entries.items()}
        where = "topics" if table.messages else "columns"
        hand = rig.model_copy(update={where: {**getattr(rig, where), **mapping}})
        try:
            found = findings(trial_of(table, hand, None), hand)
        except InputError:  # not a hand's recording, or incomplete: only its clock can be checked
            try:
                clock = Trial(table.file, mapped_times(table, hand)[0], {})
            except InputError:
                return entries, remarks
            found = [replace(f, certain=True) for f in check_clock(clock, hand, moving=False) if f.changes]
        remarks += [line for f in found if (line := f"column {f.channel} {f.problem}") not in remarks]
        fresh = {k: v for f in found if f.certain or f.channel == "t" for k, v in f.changes.items()}
        if not fresh or all(entries.get(name) == fields for name, fields in fresh.items()):
            return entries, remarks
        entries = {**entries, **fresh}
    return entries, remarks


def as_toml(entries: Mapping[str, Mapping[str, Any]], table: Table) -> str:
    """The proposal as a table of rig.toml."""
    head = "[topics]" if table.messages else "[columns]"
    return "\n".join([head, *(entry_text(name, dict(fields)) for name, fields in entries.items())]) + "\n"


def _time_column(names: Sequence[str]) -> dict[str, str]:
    if "t" in names:
        return {}
    for first in (True, False):  # t counts only as the first word of a name
        for wanted in TIME[not first :]:
            for name in names:
                if wanted in words(name)[: 1 if first else None]:
                    return {"t": name}
    return {}


def _match_channels(names: Sequence[str], table: Table) -> dict[str, str]:
    """The first column that fits each of our channels, with the axes of the work renamed to x and y."""
    found: dict[str, str] = {}
    for name, parts in split_names(names).items():
        channel = _channel_meant(parts)
        if channel is not None:
            found.setdefault(channel, name)
    across, up = _plane(found, table)
    out: dict[str, str] = {}
    for channel, name in found.items():
        axis = re.search("[xyz]", channel)
        if axis is None:
            out[channel] = name
        elif axis[0] in (across, up):
            out[channel.replace(axis[0], "x" if axis[0] == across else "y")] = name
    return out


def _plane(found: Mapping[str, str], table: Table) -> tuple[str, str]:
    """Axes across and up, for fingers whose channels (with z as a third axis) come from these columns.

    Up is z if the fingers move along it (ROS, REP 103) or there is no y; across is where they are farthest
    apart.
    """
    there = [axis for axis in "xyz" if {f"{axis}1", f"{axis}2"} <= set(found)]
    if len(there) < 3:
        return "x", "z" if "z" in there and "y" not in there else "y"
    try:
        pairs = {a: [numbers(table, found[f"{a}{i}"]) for i in (1, 2)] for a in there}
    except (InputError, KeyError):
        return "x", "y"
    if not all(np.isfinite(values).any() for a in there for values in pairs[a]):
        return "x", "y"
    travel = {a: max(map(extent, pairs[a])) for a in there}
    moves = [a for a in there if travel[a] > MOVES * max(travel.values())]
    up = "z" if "z" in moves else "y"
    apart = {a: abs(float(np.nanmedian(pairs[a][1]) - np.nanmedian(pairs[a][0]))) for a in there if a != up}
    return max(apart, key=lambda axis: apart[axis]), up


def split_names(names: Sequence[str]) -> dict[str, list[str]]:
    """Words of each name; entries of a vector of three or four end in their axis instead of their index."""
    out = {}
    for name in names:
        base, _, index = name.removesuffix("]").rpartition("[")
        axes = VECTORS.get(sum(each.startswith(f"{base}[") for each in names)) if index.isdigit() else None
        out[name] = words(name) if axes is None else [*words(base), axes[int(index)]]
    return out


def _channel_meant(words: list[str]) -> str | None:
    """Our channel (with z for a third axis) that the words of a name mean; None if they mean none."""
    known = set(words)
    sides = ("1" if word in LEFT else "2" for word in sorted(words, key=str.isdigit) if word in LEFT | RIGHT)
    finger = next(sides, None)  # a side outweighs a number, and of two numbers the first is the finger
    if finger is None or known & TURNING:
        return None
    quantity = next((name for name, words_ in QUANTITIES.items() if known & words_), None)
    if quantity == "q" and known & QUANTITIES["v"]:
        quantity = "dq"
    if quantity in ("q", "dq"):
        numbers = [word for word in words if word in ("1", "2")]
        return f"{quantity}{finger}{numbers[-1]}" if numbers else None
    axis = next((name for name, words_ in AXES.items() if known & words_), None)
    if quantity is None or axis is None:
        return None
    return f"{'' if quantity == 'p' else quantity}{axis}{finger}"


def words(name: str) -> list[str]:
    """Words of a name, such as `finger_left_x_mm` or `LeftForceX1`, without its unit."""
    name = re.sub(r"[\[(]\s*[^\d\])][^\])]*[\])]", "", name)
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    words = [word for word in re.split(r"[^A-Za-z0-9]+", name.lower()) if word]
    return [part for word in words for part in (re.findall(r"[a-z]+|\d+", word) or [word])]


OPENING = {"width", "opening", "gap", "aperture", "gripper", "finger", "fingers", "oeffnung", "öffnung"}
FORCE = {"f", "force", "forces", "fx", "fy", "fz", "kraft"}
TORQUE = {"torque", "tau", "moment", "tx", "ty", "tz", "mx", "my", "mz"}
TOOL = {"ee", "tcp", "tool", "hand", "eef", "flange"}
PLACE = TOOL | {"pos", "position", "p", "pose", "px", "py", "pz"}
MOVING = {"v", "vel", "velocity", "speed", "twist", "acc", "acceleration", "cmd", "command", "target",
          "desired"}  # fmt: skip
TURN = {"q", "quat", "quaternion", "orientation", "rot", "ori", "qx", "qy", "qz", "qw"}
CURRENT = {"current", "amp", "amps"}


def propose_gripper(table: Table, entries: Mapping[str, Mapping[str, Any]]) -> str:
    """A `[gripper]` table as TOML, with the units of its columns; empty if the names do not tell.

    `entries`: those already proposed for `[columns]` or `[topics]`.
    """
    named = split_names(table.names)
    forces = _by_axis(named, FORCE, TORQUE | MOVING | {"grip", "gripper", "finger"})
    never = FORCE | TORQUE | MOVING | TURN | OPENING - {"gripper"}
    places = _by_axis(named, TOOL, never | {"to", "rel", "relative"}) or _by_axis(named, PLACE, never)
    other = FORCE | TORQUE | MOVING | CURRENT | PLACE - {"pos", "position"}
    openings = [name for name, found in named.items() if set(found) & OPENING and not set(found) & other]
    if len(forces) < 3 or not places or not openings:
        return ""
    torques = _by_axis(named, TORQUE, FORCE | MOVING)
    quaternion = _by_axis(named, TURN, FORCE | TORQUE | MOVING, axes="xyzw")
    lines = ["[gripper]"]
    inner = ", ".join(f"{axis} = {json.dumps(name)}" for axis, name in sorted(places.items()))
    lines.append(f"position = {{{inner}}}  # of the tool [m]; z up unless up says otherwise")
    if len(quaternion) == 4:
        lines.append(f"quaternion = {json.dumps([quaternion[axis] for axis in 'xyzw'])}")
    opening = openings[0] if len(openings) == 1 else openings[:2]
    lines.append(f"opening = {json.dumps(opening)}  # between the pads [m]")
    wrench = [part[axis] for part in (forces, torques) if len(part) == 3 for axis in "xyz"]
    lines.append(f"wrench = {json.dumps(wrench)}")
    lines.append('closing = "y"  # the axis along which the pads close')
    grip = [name for name, found in named.items() if {"grip", "gripper"} & set(found) and "force" in found]
    current = [name for name, found in named.items() if set(found) & CURRENT]
    if grip:
        lines.append(f"grip_force = {json.dumps(grip[0])}  # what each pad presses with [N]")
    elif current:
        lines.append(f"motor_current = {json.dumps(current[0])}")
    used = [*places.values(), *openings[:2], *wrench]
    mapped = {name: dict(fields) for name, fields in entries.items()}
    for name in used:
        unit = table.units.get(name) or unit_in_name(name)
        if unit and UNITS[unit][1] != 1:
            mapped[name] = {"from": name, "unit": unit}
    return "\n".join(lines) + "\n" + (as_toml(mapped, table) if mapped else "")


def _by_axis(
    named: dict[str, list[str]], wanted: set[str], never: set[str], axes: str = "xyz"
) -> dict[str, str]:
    """Columns of a quantity by axis, the last word that ends in one."""
    found: dict[str, str] = {}
    for name, parts in named.items():
        known = set(parts)
        ends = (re.fullmatch(rf"[a-z]?([{axes}])", part) for part in reversed(parts))
        match = next((end for end in ends if end), None)
        if match and known & wanted and not known & never:
            found.setdefault(match.group(1), name)
    return found
