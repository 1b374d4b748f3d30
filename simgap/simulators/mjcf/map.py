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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field, WrapValidator, field_validator, model_validator

from hmmseg.errors import InputError
from hmmseg.io.schema import Finite, FinitePositive, Name, StrictTable
from hmmseg.io.units import Quantity
from simgap.simulators.user import LONGEST

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
KINDS = {
    "joint": ("position", "velocity", "torque"),
    "actuator": ("command", "force"),
    "sensor": ("position", "velocity", "force", "torque"),
    "body": ("position",),
    "site": ("position",),
}  # quantities of each kind of object; the first is the default


def _placed(value: Any, check: Callable[[Any], Any]) -> Any:
    try:
        return check(value)
    except ValueError:
        raise ValueError(f"{value!r:.40}; expected the name of a site, or [x, y, z] in m") from None


Place = Annotated[Name | tuple[Finite, Finite, Finite], WrapValidator(_placed)]


class Mapped(Quantity):
    """One column, and the part of the model that it records; SI = sign * unit * column + offset."""

    joint: Name | None = None
    actuator: Name | None = None
    sensor: Name | None = None
    body: Name | None = None
    site: Name | None = None
    kind: str = ""  # the quantity
    axis: str = ""  # its component
    noise: FinitePositive | None = None  # in the column's unit
    sign: Finite = 1.0
    offset: Finite = 0.0

    @model_validator(mode="before")
    @classmethod
    def _usual_kind(cls, entry: Any) -> Any:
        thing = next((t for t in KINDS if t in entry), None) if isinstance(entry, dict) else None
        return entry if thing is None else {"kind": KINDS[thing][0]} | entry

    @model_validator(mode="after")
    def _one_thing(self) -> Mapped:
        named = [t for t in KINDS if getattr(self, t) is not None]
        if len(named) != 1:
            found = f"names {' and '.join(named)}" if named else "names no thing of the model"
            raise ValueError(f"{found}; expected one of {', '.join(KINDS)}")
        axes = POSE if self.thing in ("body", "site") else ()
        for key, known in (("kind", KINDS[self.thing]), ("axis", axes)):
            if known and getattr(self, key) not in known:
                found = f"{key} {getattr(self, key)!r} of a {self.thing}"
                raise ValueError(f"{found}; expected one of {', '.join(known)}")
        return self

    @property
    def thing(self) -> str:
        """The kind of object that it records."""
        return next(t for t in KINDS if getattr(self, t) is not None)

    @property
    def name(self) -> str:
        """The object's name in the model."""
        return str(getattr(self, self.thing))

    @property
    def factor(self) -> float:
        """The column times this is in SI."""
        return self.size * self.sign

    @property
    def sd(self) -> float:
        """Standard deviation of a sample's noise in SI; NaN where not stated."""
        return math.nan if self.noise is None else abs(self.factor) * self.noise


class Clock(Quantity):
    """The column of times, and its unit."""

    column: Name = "t"


class Map(StrictTable):
    """The map of a model."""

    model_config = ConfigDict(populate_by_name=False)

    columns: dict[Name, Mapped] = Field(min_length=1)  # by name
    clock: Annotated[
        Clock, BeforeValidator(lambda given: {"column": given} if isinstance(given, str) else given)
    ] = Field(default=Clock(), alias="time")
    length: Annotated[float, Field(gt=0, le=LONGEST, strict=True)] | None = Field(
        default=None, alias="window"
    )
    keyframe: Name | None = None  # where what no column gives starts
    uncertain: tuple[Name, ...] = ()  # patterns of what was never measured
    sd: dict[Name, FinitePositive] = Field(default_factory=dict)  # of what was, by name
    # by body the site where it carries a load, or the place [m] in its frame
    payload_at: dict[Name, Place] = Field(default_factory=dict)

    @field_validator("columns")
    @classmethod
    def _compared(cls, columns: dict[str, Mapped]) -> dict[str, Mapped]:
        if all(m.kind == "command" for m in columns.values()):
            raise ValueError("are all commands: nothing to compare; expected a joint, sensor or body")
        known: dict[tuple[str, ...], str] = {}
        for column, m in columns.items():
            of = m.kind, m.thing, m.name, m.axis
            if known.setdefault(of, column) != column:
                found = f"{known[of]} and {column} are both the {m.kind} of {m.thing} {m.name}"
                raise ValueError(f"{found}; expected one column of it (a second encoder is a sensor)")
        return columns


SPEEDS = {"vel", "velocity", "dq", "qd", "speed", "qdot"}
COMMANDS = {"cmd", "command", "u", "ctrl", "target", "des"}
EFFORTS = {"tau", "torque", "effort"}


def proposed_map(
    xml: Path, columns: Sequence[tuple[str, str | None]], clock: Mapping[str, Any]
) -> tuple[str, list[str]]:
    """Propose a map for a model and the columns of a log.

    A column (name, unit) is the joint, actuator or sensor with the longest name that it contains: a joint's
    velocity where it speaks of speed; where it speaks of a command or a torque an actuator, by its own or its
    joint's name. `clock`: which column counts the time (`from`), and its `unit`, where that is not t in s.
    Returns the map's text, and the columns that no name decides; InputError for a model that cannot be read.
    """
    from simgap.simulators.mjcf.engine import mujoco
    from simgap.simulators.mjcf.setting import names_of

    try:
        model = mujoco.MjModel.from_xml_path(str(xml))
    except (ValueError, OSError) as error:
        raise InputError(str(xml), f"cannot be read: {error}", "an MJCF or URDF file") from None
    known = {kind: {n: n for n in names_of(model, kind)} for kind in ("actuator", "joint", "sensor")}
    for name in known["actuator"].copy():
        actuator = model.actuator(name)
        if actuator.trntype[0] == mujoco.mjtTrn.mjTRN_JOINT:
            known["actuator"].setdefault(model.joint(actuator.trnid[0]).name, name)
    if bare := not model.nu:  # such as a URDF: a motor for every joint's torque
        known["actuator"] = known["joint"]
    time = clock.get("from", "t")
    lines, left = [f"# Which column is which part of {xml.name}; SI where no unit is given."], []
    if clock:
        unit = f", unit = {json.dumps(clock['unit'])}" if "unit" in clock else ""
        lines.append(f"time = {{column = {json.dumps(time)}{unit}}}")
    for name, unit in columns:
        if name == time:
            continue
        said = set(re.split(r"[^a-z0-9]+", name.lower()))
        driven = said & (COMMANDS | EFFORTS)
        order = ("actuator", "joint", "sensor") if driven else ("joint", "sensor", "actuator")
        longest = ((kind, n) for kind in order for n in sorted(known[kind], key=len, reverse=True))
        part = next(((kind, known[kind][n]) for kind, n in longest if n and n.lower() in name.lower()), None)
        if part is None or (bare and driven and not said & EFFORTS):
            left.append(name)
            joints = ", ".join(known["joint"])
            lines += [f"# [columns.{json.dumps(name)}]", f'# joint = "..."  # one of {joints}']
            continue
        lines += [f"[columns.{json.dumps(name)}]", f"{part[0]} = {json.dumps(part[1])}"]
        lines += ['kind = "velocity"'] if part[0] == "joint" and said & SPEEDS else []
        gave = part[0] == "actuator" and not said & COMMANDS and driven
        lines += ['kind = "force"'] if gave and not bare else []
        if gave and bare and unit is None:
            unit = "N" if model.joint(part[1]).type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "Nm"
        lines += [f"unit = {json.dumps(unit)}"] if unit else []
    return "\n".join(lines) + "\n", left
