"""Units of other people's files, and the mapping of their columns or messages to our channels.

In `rig.toml`, `[columns]` (for tables) and `[topics]` (for logs of messages) define the source, unit, sign
and offset of a channel:

    [columns]
    t = {from = "stamp", unit = "ns"}
    x1 = {from = "finger_left_x", unit = "mm", sign = -1, offset = 0.05}
    [topics]
    fx1 = {from = "/left/wrench.wrench.force.x"}

ours = sign * theirs in SI + offset, the offset in SI. A channel that is not mapped is the column of its own
name.
"""

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from hmmseg.errors import nearest
from hmmseg.io.schema import Finite, FinitePositive, Name, StrictTable

LARGEST = 1e9  # physics: m, N or rad; no hand's sensor reads as much, and squares of it are far from overflow
LATEST = 1e25  # limit: of times whose unit is still unknown; ns since 1970 are 1e18

# name: (what it measures, its size in SI)
UNITS: dict[str, tuple[str, float]] = {
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "ns": ("time", 1e-9),
    "min": ("time", 60.0),
    "m": ("length", 1.0), "dm": ("length", 0.1), "cm": ("length", 1e-2), "mm": ("length", 1e-3),
    "um": ("length", 1e-6), "in": ("length", 0.0254),
    "rad": ("angle", 1.0), "mrad": ("angle", 1e-3), "deg": ("angle", math.pi / 180),
    "m/s": ("velocity", 1.0), "cm/s": ("velocity", 1e-2), "mm/s": ("velocity", 1e-3),
    "rad/s": ("angular velocity", 1.0), "mrad/s": ("angular velocity", 1e-3),
    "deg/s": ("angular velocity", math.pi / 180), "rpm": ("angular velocity", math.pi / 30),
    "N": ("force", 1.0), "mN": ("force", 1e-3), "kN": ("force", 1e3), "gf": ("force", 9.80665e-3),
    "kgf": ("force", 9.80665), "lbf": ("force", 4.4482216152605),
    "Nm": ("torque", 1.0), "mNm": ("torque", 1e-3), "Nmm": ("torque", 1e-3), "Ncm": ("torque", 1e-2),
    "A": ("current", 1.0), "mA": ("current", 1e-3),
    "V": ("voltage", 1.0), "mV": ("voltage", 1e-3),
    "kg": ("mass", 1.0), "g": ("mass", 1e-3),
    "1": ("number", 1.0), "%": ("number", 0.01),
}  # fmt: skip
SPELLINGS = {
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "usec": "us", "µs": "us", "μs": "us", "micros": "us", "microseconds": "us", "nsec": "ns",
    "nanos": "ns", "nanoseconds": "ns", "minutes": "min", "meter": "m", "metre": "m", "meters": "m",
    "metres": "m", "µm": "um", "μm": "um", "inch": "in", "degree": "deg", "degrees": "deg", "°": "deg",
    "°/s": "deg/s", "radian": "rad", "radians": "rad", "newton": "N", "newtons": "N", "n": "N",
    "mn": "mN", "kn": "kN", "n.m": "Nm", "n*m": "Nm", "n-m": "Nm", "nm": "Nm", "n·m": "Nm",
    "n.mm": "Nmm", "nmm": "Nmm", "mm/sec": "mm/s", "m/sec": "m/s", "amp": "A", "amps": "A",
    "volt": "V", "volts": "V",
}  # fmt: skip


def known_unit(text: str) -> str | None:
    """This unit as `UNITS` spells it, None if it is unknown."""
    text = re.sub(r"\s+", "", text)
    return text if text in UNITS else SPELLINGS.get(text.lower())


def si_factor(unit: str | float) -> float:
    """Size of a unit in SI (a number is SI per count itself); ValueError for an unknown unit."""
    if not isinstance(unit, str):
        return float(unit)
    name = known_unit(unit)
    if name is None:
        raise ValueError(f"unknown unit {unit!r}; expected {nearest(unit, UNITS)}")
    return UNITS[name][1]


def measures(channel: str) -> str | None:
    """Quantity that one of our channels measures, None for a channel of a plain task."""
    if channel == "t":
        return "time"
    if re.fullmatch(r"d?q\d\d", channel):
        return "angular velocity" if channel[0] == "d" else "angle"
    if re.fullmatch(r"(v[xy]|[xy]|f[xy])[12]", channel):
        return {"v": "velocity", "f": "force"}.get(channel[0], "length")
    return None


def unit_in_name(name: str) -> str | None:
    """Unit that a column's name ends in: `left_x_mm`, `force [N]`, `t (ms)`."""
    bracketed = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$", name)
    if bracketed:  # `[0]` is the entry of a vector
        return None if bracketed.group(1).isdigit() else known_unit(bracketed.group(1))
    last = re.split(r"[_. ]", name)
    if len(last) < 2:
        return None
    unit = known_unit(last[-1])
    # A single letter is more likely a name (`joint_s`, `tip_m`), except for the usual units.
    return unit if unit is not None and (len(unit) > 1 or unit in ("s", "m", "N")) else None


def unwrapped(angles: Any) -> Any:
    """Angles (num_timesteps,) [rad] without jumps by a whole turn; missing ones stay NaN."""
    import numpy as np  # which `hmmseg --help` does without

    there = np.isfinite(angles)
    out = angles.copy()
    out[there] = np.unwrap(angles[there])
    return out


class Quantity(StrictTable):
    """A quantity with a unit: SI by default, a name, or a number (SI per count)."""

    unit: Name | FinitePositive | None = None

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str | float | None) -> str | float | None:
        if unit is not None:
            si_factor(unit)
        return unit

    @property
    def size(self) -> float:
        """The unit in SI."""
        return 1.0 if self.unit is None else si_factor(self.unit)


class Column(Quantity):
    """Source of one channel: their name, its unit, sign and offset [SI]."""

    source: Name | None = Field(default=None, alias="from")
    sign: Finite = 1.0
    offset: Finite = 0.0

    @field_validator("sign")
    @classmethod
    def _one(cls, sign: float) -> float:
        if abs(sign) != 1:
            raise ValueError(f"found {sign:g}; expected 1 or -1")
        return sign


ColumnEntry = Annotated[Column, BeforeValidator(lambda v: {"from": v} if isinstance(v, str) else v)]


def _dimensions(entries: dict[str, Column]) -> dict[str, Column]:
    for name, column in entries.items():
        wanted = measures(name)
        if wanted is None or not isinstance(column.unit, str):
            continue
        measured = UNITS[known_unit(column.unit) or ""][0]
        if measured != wanted:
            raise ValueError(f"{name} is a {wanted}, but its unit {column.unit} is one of {measured}")
    return entries


Columns = Annotated[dict[Name, ColumnEntry], AfterValidator(_dimensions)]


def source_of(name: str, columns: Mapping[str, Column]) -> str:
    """Their name for our channel."""
    entry = columns.get(name)
    return name if entry is None or entry.source is None else entry.source
