"""Reader of `actual.toml`: properties measured apart from the trials."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hmmseg.errors import InputError, nearest
from hmmseg.io.schema import read_toml

UNITS = {"weight": "N", "width": "m", "height": "m", "friction": "1"}
Actual = dict[str, dict[str, tuple[float, float]]]


def read_actual(path: str | Path, objects: Iterable[str]) -> Actual:
    """Measured (value, standard deviation) of every property given, by object and property.

    N for a weight, m for width and height, "1" for friction. InputError for an object that is
    not among `objects` (a task's), an unknown key, a wrong unit or a number that cannot be.
    """
    return parse_actual(read_toml(path), objects, str(path))


def parse_actual(table: dict[str, Any], objects: Iterable[str], where: str = "actual") -> Actual:
    """The same from the table of an `actual.toml`."""
    known, actual = list(objects), {}
    for name, entries in table.items():
        if name not in known:
            raise InputError(f"{where}: key {name}", "is not an object of the task", nearest(name, known))
        if not isinstance(entries, dict):
            raise InputError(f"{where}: key {name}", f"found {entries!r}", f"tables [{name}.PROPERTY]")
        actual[name] = {}
        for key, entry in entries.items():
            if key not in UNITS:
                raise InputError(f"{where}: key {name}.{key}", "unknown property", nearest(key, UNITS))
            actual[name][key] = _parse_entry(entry, UNITS[key], f"{where}: key {name}.{key}")
    return actual


def _parse_entry(entry: Any, unit: str, where: str) -> tuple[float, float]:
    if not isinstance(entry, dict):
        raise InputError(where, f"found {entry!r}", "a table with unit, value and sd")
    for key in entry:
        if key not in ("unit", "value", "sd"):
            raise InputError(f"{where}.{key}", "unknown key", nearest(key, ("unit", "value", "sd")))
    if entry.get("unit") != unit:
        raise InputError(f"{where}.unit", f"found {entry.get('unit')!r}", f'"{unit}"')
    value = _number(entry.get("value"), f"{where}.value", "a number > 0")
    sd = _number(entry.get("sd", 0.0), f"{where}.sd", "a number >= 0")
    if value <= 0:
        raise InputError(f"{where}.value", f"found {value!r}", "a number > 0")
    if sd < 0:
        raise InputError(f"{where}.sd", f"found {sd!r}", "a number >= 0")
    return value, sd


def _number(value: Any, where: str, expected: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(where, f"found {value!r}", expected)
    return float(value)
