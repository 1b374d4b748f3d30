"""The mapping between our channels and the columns or messages of another lab's file.

In `rig.toml`, `[columns]` is for tables and `[topics]` for logs made of messages; both say for
one of our channels where it comes from, in which unit, with which sign, and what to add:

    [columns]
    t = {from = "stamp", unit = "ns"}
    x1 = {from = "finger_left_x", unit = "mm", sign = -1, offset = 0.05}
    [topics]
    fx1 = {from = "/left/wrench.wrench.force.x"}

ours = sign * theirs in SI + offset, the offset in SI. A channel that is not mapped is the column
of its own name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from hmmseg.io.schema import Finite, FinitePositive, Name, StrictTable
from hmmseg.io.units import UNITS, known_unit, measures, si_factor


class Column(StrictTable):
    """Where one channel comes from: theirs, its unit (SI where none is said), sign and offset [SI]."""

    source: Name | None = Field(default=None, alias="from")
    unit: Name | FinitePositive | None = None
    sign: Finite = 1.0
    offset: Finite = 0.0

    @field_validator("unit")
    @classmethod
    def _known(cls, unit: str | float | None) -> str | float | None:
        if unit is not None:
            si_factor(unit)
        return unit

    @field_validator("sign")
    @classmethod
    def _one(cls, sign: float) -> float:
        if abs(sign) != 1:
            raise ValueError(f"found {sign:g}; expected 1 or -1")
        return sign


def _by_name(value: Any) -> Any:
    return {"from": value} if isinstance(value, str) else value


ColumnEntry = Annotated[Column, BeforeValidator(_by_name)]


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
    """Their name of our channel."""
    entry = columns.get(name)
    return name if entry is None or entry.source is None else entry.source
