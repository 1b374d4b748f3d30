"""A mapping proposed from the names in another lab's file, mended by what can be seen in it.

Names are taken apart into words: which finger (left, right, 1, 2), which quantity (position,
velocity, force, joint), which axis. Of three axes the plane of the work is looked for in what the fingers do.
It is a proposal: units and signs follow from physics where they can, and a person looks at the rest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.columns import Column
from hmmseg.io.plausibility import entry_text
from hmmseg.io.rig import Rig
from hmmseg.io.table import Table, numbers
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS, Trial, mapped_times, trial_of
from hmmseg.io.units import UNITS, known_unit, measures, unit_in_name

TIME = ("t", "time", "timestamp", "stamp", "timestamps", "sec", "seconds", "clock", "times", "zeit",
        "zeitstempel")  # fmt: skip
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
MOVES = 1e-3  # numerics: of the longest travel; an axis along which fingers move less is none they work in
AXES = {"x": {"x", "fx", "vx"}, "y": {"y", "fy", "vy"}, "z": {"z", "fz", "vz"}}
TURNING = {"torque", "moment", "mx", "my", "mz", "tx", "ty", "tz", "orientation", "quaternion", "rot"}


def propose(table: Table) -> dict[str, dict[str, Any]]:
    """Entries of `[columns]` (`[topics]` for a log) by our channel; empty where none is needed or found.

    Channels come with their unit where the file or the name states one that is not SI.
    """
    names = [name for name in table.names if name != "t" or not table.messages]
    sources: dict[str, str] = {} if table.messages else _clock(names)
    for channels in (CARTESIAN_CHANNELS, JOINT_CHANNELS):
        found = {channel: channel for channel in channels if channel in names}
        found |= {channel: name for channel, name in _matched(names, table).items()
                  if channel in channels and channel not in found}  # fmt: skip
        if len(found) > len(channels) / 2:
            sources |= found
            break
    out: dict[str, dict[str, Any]] = {}
    for channel, source in sources.items():
        unit = table.units.get(source) or unit_in_name(source)
        wanted = measures(channel)
        fits = unit is not None and (wanted is None or UNITS[known_unit(unit) or ""][0] == wanted)
        fields = {"from": source} | ({"unit": unit} if fits and UNITS[unit or ""][1] != 1 else {})
        if fields != {"from": channel}:
            out[channel] = fields
    return out


def mended(table: Table, entries: dict[str, dict[str, Any]], rig: Rig | None = None
           ) -> tuple[dict[str, dict[str, Any]], list[str]]:  # fmt: skip
    """The proposal after what physics says of the recording, and what it said, line by line.

    Where the hand is not told, links of a length of their own cannot be known: a jointed hand is
    judged only with its rig.
    """
    from hmmseg.hand.plausibility import findings  # which reads trials itself
    from hmmseg.io.plausibility import check_clock

    rig = rig or Rig()
    said: list[str] = []
    for _ in range(8):
        mapping = {name: Column.model_validate(fields) for name, fields in entries.items()}
        where = "topics" if table.messages else "columns"
        hand = rig.model_copy(update={where: {**getattr(rig, where), **mapping}})
        try:
            found = findings(trial_of(table, hand, None), hand)
        except InputError:  # not a hand's recording, or not all of it: its clock alone
            try:
                clock = Trial(table.file, mapped_times(table, hand)[0], {})
            except InputError:
                return entries, said
            found = [replace(f, certain=True) for f in check_clock(clock, hand, moving=False) if f.changes]
        said += [line for f in found if (line := f"column {f.channel} {f.problem}") not in said]
        fresh = {k: v for f in found if f.certain or f.channel == "t" for k, v in f.changes.items()}
        if not fresh or all(entries.get(name) == fields for name, fields in fresh.items()):
            return entries, said
        entries = {**entries, **fresh}
    return entries, said


def as_toml(entries: Mapping[str, Mapping[str, Any]], table: Table) -> str:
    """The proposal as a table of rig.toml."""
    head = "[topics]" if table.messages else "[columns]"
    return "\n".join([head, *(entry_text(name, dict(fields)) for name, fields in entries.items())]) + "\n"


def _clock(names: Sequence[str]) -> dict[str, str]:
    if "t" in names:
        return {}
    for wanted in TIME:
        for name in names:
            if re.sub(r"[\[(].*", "", name).strip().lower() == wanted or words(name)[:1] == [wanted]:
                return {"t": name}
    return {}


def _matched(names: Sequence[str], table: Table) -> dict[str, str]:
    """The first column that fits each of our channels, as the axes of the work go by x and y."""
    found: dict[str, str] = {}
    for name, parts in split(names).items():
        channel = _channel(parts)
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
    """Axes across and up of fingers whose channels (with z for a third axis) come from these columns.

    Up is z where the fingers move along it (ROS, REP 103) or there is no y; across is where they stand
    apart most.
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
    travel = {a: max(float(np.nanmax(values) - np.nanmin(values)) for values in pairs[a]) for a in there}
    moves = [a for a in there if travel[a] > MOVES * max(travel.values())]
    up = "z" if "z" in moves else "y"
    apart = {a: abs(float(np.nanmedian(pairs[a][1]) - np.nanmedian(pairs[a][0]))) for a in there if a != up}
    return max(apart, key=lambda axis: apart[axis]), up


def split(names: Sequence[str]) -> dict[str, list[str]]:
    """Words of each name; the entries of a vector of three or four end in their axis instead of a number."""
    out = {}
    for name in names:
        base, _, index = name.removesuffix("]").rpartition("[")
        axes = VECTORS.get(sum(each.startswith(f"{base}[") for each in names)) if index.isdigit() else None
        out[name] = words(name) if axes is None else [*words(base), axes[int(index)]]
    return out


def _channel(words: list[str]) -> str | None:
    """Our channel (with z for a third axis) that a name's words mean."""
    known = set(words)
    finger = "1" if known & LEFT else "2" if known & RIGHT else None
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
    """Words of a name: `finger_left_x_mm` and `LeftForceX1` taken apart, its unit left out."""
    name = re.sub(r"[\[(]\s*[^\d\])][^\])]*[\])]", "", name)
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    words = [word for word in re.split(r"[^A-Za-z0-9]+", name.lower()) if word]
    return [part for word in words for part in (re.findall(r"[a-z]+|\d+", word) or [word])]
