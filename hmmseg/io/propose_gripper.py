"""The `[gripper]` table proposed from the names of columns in a log of an arm with a wrist sensor."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from hmmseg.io.propose import as_toml
from hmmseg.io.propose import split as split_names
from hmmseg.io.table import Table
from hmmseg.io.units import UNITS, known_unit, unit_in_name

OPENING = {"width", "opening", "gap", "aperture", "gripper", "finger", "fingers", "oeffnung", "öffnung"}
FORCE = {"f", "force", "forces", "fx", "fy", "fz", "kraft"}
TORQUE = {"torque", "tau", "moment", "tx", "ty", "tz", "mx", "my", "mz"}
TOOL = {"ee", "tcp", "tool", "hand", "eef", "flange"}
PLACE = TOOL | {"pos", "position", "p", "pose", "px", "py", "pz"}
MOVING = {
    "v",
    "vel",
    "velocity",
    "speed",
    "twist",
    "acc",
    "acceleration",
    "cmd",
    "command",
    "target",
    "desired",
}
TURN = {"q", "quat", "quaternion", "orientation", "rot", "ori", "qx", "qy", "qz", "qw"}
CURRENT = {"current", "amp", "amps"}


def propose_gripper(table: Table, entries: Mapping[str, Mapping[str, Any]]) -> str:
    """A `[gripper]` table as TOML with the units of its columns; empty where the names do not tell.

    `entries` are those of `[columns]` or `[topics]` that are proposed already.
    """
    split = split_names(table.names)
    forces = _by_axis(split, FORCE, TORQUE | MOVING | {"grip", "gripper", "finger"})
    never = FORCE | TORQUE | MOVING | TURN | OPENING - {"gripper"}
    places = _by_axis(split, TOOL, never | {"to", "rel", "relative"}) or _by_axis(split, PLACE, never)
    other = FORCE | TORQUE | MOVING | CURRENT | PLACE - {"pos", "position"}
    openings = [name for name, found in split.items() if set(found) & OPENING and not set(found) & other]
    if len(forces) < 3 or not places or not openings:
        return ""
    torques = _by_axis(split, TORQUE, FORCE | MOVING)
    quaternion = _by_axis(split, TURN, FORCE | TORQUE | MOVING, axes="xyzw")
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
    grip = [name for name, found in split.items() if {"grip", "gripper"} & set(found) and "force" in found]
    current = [name for name, found in split.items() if set(found) & CURRENT]
    if grip:
        lines.append(f"grip_force = {json.dumps(grip[0])}  # what each pad presses with [N]")
    elif current:
        lines.append(f"motor_current = {json.dumps(current[0])}")
    used = [*places.values(), *openings[:2], *wrench]
    mapped = {name: dict(fields) for name, fields in entries.items()}
    for name in used:
        unit = table.units.get(name) or unit_in_name(name)
        if unit and UNITS.get(known_unit(unit) or "", ("", 1.0))[1] != 1:
            mapped[name] = {"from": name, "unit": unit}
    return "\n".join(lines) + "\n" + (as_toml(mapped, table) if mapped else "")


def _by_axis(
    split: dict[str, list[str]], wanted: set[str], never: set[str], axes: str = "xyz"
) -> dict[str, str]:
    """Columns by axis of a quantity: the last word ends in the axis."""
    found: dict[str, str] = {}
    for name, parts in split.items():
        known = set(parts)
        ends = (re.fullmatch(rf"[a-z]?([{axes}])", part) for part in reversed(parts))
        match = next((end for end in ends if end), None)
        if match and known & wanted and not known & never:
            found.setdefault(match.group(1), name)
    return found
