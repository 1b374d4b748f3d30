"""Properties as JSON, text and tables, and compared with values measured apart from the trials."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from estimation.design import Unknown
from hmmseg.contact import decompose
from hmmseg.errors import InputError, nearest
from hmmseg.io.schema import read_toml
from hmmseg.levels import SURE
from hmmseg.numbers import SHOWN, estimate, fixed, interval, plain
from hmmseg.tables import listed

INTERVALS = {"interval_68": (16.0, 84.0), "interval_95": (2.5, 97.5)}  # physics: a definition: percentiles


def summary(draws: np.ndarray, unit: str) -> dict[str, Any]:
    """Unit, mean, sd, median and intervals of posterior draws (num_draws,)."""
    out = {"unit": unit, "mean": float(draws.mean()), "sd": float(draws.std(ddof=1))}
    out |= {"median": float(np.median(draws))}
    return out | {name: np.percentile(draws, q).tolist() for name, q in INTERVALS.items()}


UNITS = decompose.UNITS | {"friction": "1"}
Actual = dict[str, dict[str, tuple[float, float]]]

# limit: SI units; beyond what any hand lifts, spans or slips on
LIMITS = {"weight": (1e-4, 1e4), "width": (1e-5, 10.0), "height": (1e-5, 10.0), "friction": (1e-4, 1e3)}


def read_actual(path: str | Path, objects: Iterable[str]) -> Actual:
    """Read properties measured apart from the trials.

    Args:
        path: a TOML file with tables [OBJECT.PROPERTY] of unit, value and sd.
        objects: names of the task's objects.

    Returns:
        (value, standard deviation) by object and property: N for a weight, m for width and height, 1 for
        friction.

    Raises:
        InputError: an object that is not among `objects`, an unknown key, a wrong unit, an impossible number.
    """
    return parse_actual(read_toml(path), objects, str(path))


def parse_actual(table: dict[str, Any], objects: Iterable[str], where: str = "actual") -> Actual:
    """The same from the table of an `actual.toml`."""
    known, actual = list(objects), dict[str, Any]()
    for name, entries in table.items():
        if name not in known:
            raise InputError(f"{where}: key {name}", "is not an object of the task", nearest(name, known))
        if not isinstance(entries, dict):
            raise InputError(f"{where}: key {name}", f"found {entries!r}", f"tables [{name}.PROPERTY]")
        actual[name] = {}
        for key, entry in entries.items():
            if key not in UNITS:
                raise InputError(f"{where}: key {name}.{key}", "unknown property", nearest(key, UNITS))
            actual[name][key] = _parse_entry(entry, key, f"{where}: key {name}.{key}")
    return actual


def compare(properties: dict[str, Any], measured: Actual, smallest: float = 0.0) -> dict[str, Any]:
    """Compare identified properties with measured values.

    Args:
        properties: as in identify's JSON.
        measured: value and standard deviation by object and property.
        smallest: relative deviation that matters.

    Returns:
        By object and property: `value`, `sd`, and if the property was identified `relative_deviation`, `z`
        (in sds of both combined), `inside_95` and `disagrees` (beyond SURE sds and beyond `smallest`). A
        friction with only a lower bound disagrees if the measured value lies below it.
    """
    out: dict[str, Any] = {}
    for obj, entries in measured.items():
        for prop, (value, sd) in entries.items():
            row: dict[str, Any] = {"value": value, "sd": sd}
            found = properties.get(obj, {}).get(prop)
            if found is not None and found.get("mean") is not None:
                low, high = found["interval_95"]
                share = found["mean"] / value - 1
                row["relative_deviation"] = share
                row["z"] = (found["mean"] - value) / math.hypot(found["sd"], sd)
                row["inside_95"] = bool(low - 2 * sd <= value <= high + 2 * sd)
                row["disagrees"] = bool(abs(row["z"]) > SURE and abs(share) > smallest)
            elif found is not None and found.get("lower_bound") is not None:
                short = 1 - value / found["lower_bound"]
                row["disagrees"] = bool(short > smallest and value + SURE * sd < found["lower_bound"])
            out.setdefault(obj, {})[prop] = row
    return out


def disagreements(properties: dict[str, Any], compared: dict[str, Any]) -> list[str]:
    """One line for each measured value that the recordings contradict."""
    lines = []
    for obj, entries in compared.items():
        for prop, row in entries.items():
            if not row.get("disagrees"):
                continue
            found, shown = properties[obj][prop], SHOWN[prop]
            value = estimate(row["value"], row["sd"], shown)
            if "z" not in row:
                bound = f"{found['lower_bound']:.3g}"
                lines.append(f"{obj}.{prop}: measured as {value}, but it was held at {bound}")
                continue
            share, said = 100 * row["relative_deviation"], estimate(found["mean"], found["sd"], shown)
            side = "above" if share > 0 else "below"
            lines.append(
                f"{obj}.{prop}: the recordings say {said}, {abs(share):.2g} % {side} what was measured "
                f"({value}), {abs(row['z']):.0f} standard deviations away: one of the two is wrong"
            )
    return lines


def _parse_entry(entry: Any, prop: str, where: str) -> tuple[float, float]:
    unit = UNITS[prop]
    if not isinstance(entry, dict):
        raise InputError(where, f"found {entry!r}", "a table with unit, value and sd")
    for key in entry:
        if key not in ("unit", "value", "sd"):
            raise InputError(f"{where}.{key}", "unknown key", nearest(key, ("unit", "value", "sd")))
    if entry.get("unit") != unit:
        raise InputError(f"{where}.unit", f"found {entry.get('unit')!r}", f'"{unit}"')
    low, high = LIMITS[prop]
    value = number(entry.get("value"), f"{where}.value", f"a number > 0, from {low:g} to {high:g}", low, high)
    return value, number(entry.get("sd", 0.0), f"{where}.sd", "a number >= 0", 0.0, high)


def number(value: Any, where: str, expected: str, low: float, high: float) -> float:
    """The value as a float; InputError unless it is a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(where, f"found {value!r:.40}", expected)
    return float(value)


def property_rows(body: dict[str, Any], measured: Actual | None = None) -> list[dict[str, str]]:
    """One row per property as text: estimate, intervals, measured value, deviation, and its source.
    `deviation`: of the estimate from the measured value in per cent; `from`: the subtasks that determine it,
    or why it is unknown. What only a combination of properties is determined for comes last."""
    rows, entries = [], [(o, p, e) for o, own in body["properties"].items() for p, e in own.items()]
    for one in body.get("combinations", ()):
        terms = {key.rpartition(".")[0]: number for key, number in one["of"].items()}
        unknown = Unknown(next(iter(one["of"])).rpartition(".")[2], terms)
        entries.append((*unknown.name, one))
    for obj, prop, entry in entries:
        shown, compared = SHOWN[prop], body.get("actual", {}).get(obj, {}).get(prop, {})
        row = dict.fromkeys(("estimate", *INTERVALS, "measured", "deviation", "from"), "")
        row |= {"block": obj, "property": prop, "estimate": "unknown"}
        if entry is None:
            row["from"] = body["reasons"].get(f"{obj}.{prop}", "")
        else:
            row["from"] = ", ".join(entry.get("subtasks", ()))
            row["estimate"] = f"≥ {plain(entry['lower_bound'])}" if "lower_bound" in entry else ""
        if measured and (value := measured.get(obj, {}).get(prop)) is not None:
            row["measured"] = estimate(*value, shown)
            if entry is not None and entry.get("mean") is not None:
                row["deviation"] = f"{fixed(100 * (entry['mean'] / value[0] - 1), 2, '+')} %"
            if compared.get("disagrees"):
                row["deviation"] += ", disagrees" if row["deviation"] else "disagrees"
        if entry is not None and entry.get("mean") is not None:
            row["estimate"] = estimate(entry["mean"], entry["sd"], shown)
            row["interval_68"], row["interval_95"] = (
                interval(entry[name][0], entry[name][1], shown, sds)
                for name, sds in zip(INTERVALS, (2.0, 3.9), strict=True)
            )
        rows.append(row)
    return rows


def properties_table(body: dict[str, Any], measured: Actual | None = None) -> Table:
    """The properties for people to read, lengths in cm as in the paper."""
    keys = ["block", "property", "estimate", "interval_95", *(("measured", "deviation") if measured else ())]
    heads = ["95 % interval" if key == "interval_95" else key for key in keys]
    rows = [[row[key] for key in keys] for row in property_rows(body, measured)]
    return listed(f"properties ({body['method']})", heads, rows)


def inference_data(posterior: dict[str, np.ndarray]) -> Any:
    """ArviZ's data of draws (chains, draws) by name: InferenceData, or from 1.0 on a DataTree."""
    import arviz  # takes longer to import than an identification

    if int(arviz.__version__.split(".")[0]) < 1:
        return arviz.from_dict(posterior=posterior)
    return arviz.from_dict({"posterior": posterior})
