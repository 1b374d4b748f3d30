"""map.toml: which column of a log is which joint, actuator, sensor or body of a MuJoCo model.

[columns.q1]            # the column's name in the log
joint = "shoulder"      # or actuator, sensor, body, site
unit = "deg"            # SI where left out
noise = 0.01            # sd of a sample, in that unit; learned from the log where left out
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hmmseg.errors import InputError, nearest
from hmmseg.io.schema import LARGEST, read_toml
from hmmseg.io.units import si_factor
from simgap.simulators.user import LONGEST

THINGS = ("joint", "actuator", "sensor", "body", "site")
AXES = {"body": ("x", "y", "z", "qw", "qx", "qy", "qz"), "site": ("x", "y", "z", "qw", "qx", "qy", "qz")}
KINDS = {
    "joint": ("position", "velocity", "torque"),
    "actuator": ("command", "force"),
    "sensor": ("position", "velocity", "force", "torque"),
    "body": ("position",),
    "site": ("position",),
}
KEYS = (*THINGS, "kind", "axis", "unit", "noise", "sign", "offset")
TOP = ("columns", "time", "window", "keyframe", "uncertain", "sd", "payload_at")


@dataclass(frozen=True)
class Mapped:
    """One column: the `thing` of the model (`joint`, ...) by `name`, its `kind`, `axis`; `factor`, `offset`
    take the column's values to SI, `noise` is in SI."""

    column: str
    thing: str
    name: str
    kind: str
    axis: str
    unit: str | None
    factor: float
    offset: float
    noise: float


@dataclass(frozen=True)
class Map:
    """The columns, the `time` column with its factor to s, windows' `length` [s], the `keyframe` to start
    what no column tells from; `uncertain`: patterns of what was never measured, `sd` by name of what was;
    `payload_at`: by body the site at which it carries a load, or that place [m] in the body's frame."""

    file: str
    columns: Mapping[str, Mapped]
    time: str = "t"
    time_factor: float = 1.0
    length: float | None = None
    keyframe: str | None = None
    uncertain: tuple[str, ...] = ()
    sd: Mapping[str, float] = field(default_factory=dict)
    payload_at: Mapping[str, str | tuple[float, ...]] = field(default_factory=dict)


def read_map(path: Path) -> Map:
    """The map of a TOML file; InputError names the key at fault."""
    raw = read_toml(path)
    for key in raw:
        if key not in TOP:
            raise InputError(f"{path}: {key}", "unknown key", nearest(key, TOP))
    columns = raw.get("columns", {})
    if not isinstance(columns, dict) or not columns:
        raise InputError(f"{path}: columns", "missing", "a table [columns.NAME] for each column of the logs")
    time = raw.get("time", {})
    time = {"column": time} if isinstance(time, str) else time
    if not isinstance(time, dict) or not isinstance(time.get("column", ""), str):
        raise InputError(
            f"{path}: time", f"found {time!r:.40}", 'a column\'s name, or {column = "...", unit = "..."}'
        )
    window, keyframe = _number(raw, "window", str(path)), raw.get("keyframe")
    if window is not None and not 0 < window <= LONGEST:
        raise InputError(f"{path}: window", f"found {window:g}", f"seconds above 0, {LONGEST:g} at most")
    if keyframe is not None and not isinstance(keyframe, str):
        raise InputError(
            f"{path}: keyframe", f"found {keyframe!r:.40}", "the name of a keyframe of the model"
        )
    found = {name: _mapped(name, entry, f"{path}: columns.{name}") for name, entry in columns.items()}
    if all(m.kind == "command" for m in found.values()):
        raise InputError(
            f"{path}: columns", "are all commands: nothing to compare", "a joint, sensor or body"
        )
    return Map(
        str(path),
        found,
        time.get("column", "t"),
        _unit(time.get("unit"), f"{path}: time.unit"),
        window,
        keyframe,
        _patterns(raw.get("uncertain", []), f"{path}: uncertain"),
        _deviations(raw.get("sd", {}), f"{path}: sd"),
        _places(raw.get("payload_at", {}), f"{path}: payload_at"),
    )


def _patterns(names: Any, where: str) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise InputError(where, f"{names!r}", 'a list of names such as "joint:elbow.frictionloss"')
    return tuple(names)


def _deviations(stated: Any, where: str) -> dict[str, float]:
    if not isinstance(stated, dict):
        raise InputError(where, "is no table", '"body:arm.mass" = 0.01, say')
    found = {name: _number(stated, name, where) for name in stated}
    for name, sd in found.items():
        if sd <= 0:
            raise InputError(f"{where}.{name}", f"{sd:g}", "above 0")
    return found


def _places(stated: Any, where: str) -> dict[str, str | tuple[float, ...]]:
    if not isinstance(stated, dict):
        raise InputError(where, "is no table", '{arm = "hand"} or {arm = [0.3, 0.0, 0.0]}')
    out: dict[str, str | tuple[float, ...]] = {}
    for body, place in stated.items():
        numbers = isinstance(place, list) and len(place) == 3
        if not isinstance(place, str) and not numbers:
            raise InputError(f"{where}.{body}", f"{place!r:.40}", "the name of a site, or [x, y, z] in m")
        keys = dict(enumerate(place)) if numbers else {}
        out[body] = place if isinstance(place, str) else tuple(
            _number({"place": keys[k]}, "place", f"{where}.{body}") for k in range(3)
        )  # fmt: skip
    return out


def _mapped(column: str, entry: Any, where: str) -> Mapped:
    if not isinstance(entry, dict):
        raise InputError(where, "is no table", '{joint = "..."}')
    for key in entry:
        if key not in KEYS:
            raise InputError(f"{where}.{key}", "unknown key", nearest(key, KEYS))
    things = [t for t in THINGS if t in entry]
    if len(things) != 1:
        raise InputError(
            where,
            "names no thing of the model" if not things else f"names {' and '.join(things)}",
            f"one of {', '.join(THINGS)}",
        )
    thing = things[0]
    kind = entry.get("kind", KINDS[thing][0])
    if kind not in KINDS[thing]:
        raise InputError(f"{where}.kind", f"{kind!r} of a {thing}", f"one of {', '.join(KINDS[thing])}")
    axis = str(entry.get("axis", ""))
    if thing in AXES and axis not in AXES[thing]:
        raise InputError(
            f"{where}.axis", f"{axis!r}" if axis else "missing", f"one of {', '.join(AXES[thing])}"
        )
    unit = entry.get("unit")
    factor = _unit(unit, f"{where}.unit") * _number(entry, "sign", where, 1.0)
    noise = _number(entry, "noise", where, math.nan)
    if noise <= 0:
        raise InputError(f"{where}.noise", f"{noise:g}", "above 0")
    return Mapped(
        column,
        thing,
        str(entry[thing]),
        kind,
        axis,
        unit,
        factor,
        _number(entry, "offset", where, 0.0),
        abs(factor) * noise,
    )


def _unit(unit: Any, where: str) -> float:
    if unit is None:
        return 1.0
    try:
        return si_factor(unit)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(where, f"{unit!r} is no known unit", str(error)) from None


def _number(entry: Mapping[str, Any], key: str, where: str, default: Any = None) -> Any:
    if key not in entry:
        return default
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise InputError(f"{where}.{key}", f"{value!r:.40}", "a number")
    return float(value)


SPEEDS = {"vel", "velocity", "dq", "qd", "speed", "qdot"}
COMMANDS = {"cmd", "command", "u", "ctrl", "target", "des"}


def proposed_map(xml: Path, columns: Sequence[tuple[str, str | None]]) -> tuple[str, list[str]]:
    """A map's text for a model and a log's columns (name, unit), and the columns that no name decides.

    A column is the joint, actuator or sensor whose name it holds, the longest such name: of a joint the speed
    where the column says so, of an actuator where it speaks of a command.
    """
    from simgap.simulators.mjcf.engine import mujoco
    from simgap.simulators.mjcf.setting import names_of

    try:
        model = mujoco.MjModel.from_xml_path(str(xml))
    except (ValueError, OSError) as error:
        raise InputError(str(xml), f"cannot be read: {error}", "a MuJoCo model") from None
    kinds = ("actuator", "joint", "sensor")
    known = {kind: sorted(names_of(model, kind), key=len, reverse=True) for kind in kinds}
    lines, left = [f"# Which column is which part of {xml.name}; SI where no unit is given."], []
    for name, unit in columns:
        said = set(re.split(r"[^a-z0-9]+", name.lower()))
        order = ("actuator", "joint", "sensor") if said & COMMANDS else ("joint", "sensor", "actuator")
        part = next(((kind, n) for kind in order for n in known[kind] if n.lower() in name.lower()), None)
        if name == "t" or (part is None and said & {"t", "time", "stamp", "timestamp"}):
            lines += [] if name == "t" else [f'time = "{name}"']
            continue
        if part is None:
            left.append(name)
            joints = ", ".join(known["joint"])
            lines += [f"# [columns.{json.dumps(name)}]", f'# joint = "..."  # one of {joints}']
            continue
        lines += [f"[columns.{json.dumps(name)}]", f'{part[0]} = "{part[1]}"']
        lines += ['kind = "velocity"'] if part[0] == "joint" and said & SPEEDS else []
        lines += [f'unit = "{unit}"'] if unit else []
    tops = [line for line in lines if line.startswith("time")]
    return "\n".join([lines[0], *tops, *(x for x in lines[1:] if x not in tops)]) + "\n", left
