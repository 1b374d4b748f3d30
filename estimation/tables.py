"""Properties as a table for people to read."""

from __future__ import annotations

from typing import Any

from rich.table import Table

SHOWN = {"weight": (1.0, "N", 4), "width": (100.0, "cm", 4), "height": (100.0, "cm", 4)}


def properties_table(body: dict[str, Any], measured=None) -> Table:
    """The properties for people to read, lengths in cm as the paper has them."""
    table = Table(title=f"properties ({body['method']})", title_justify="left")
    for head in ("block", "property", "estimate", "95 % interval", *(("measured",) if measured else ())):
        table.add_column(head, no_wrap=head != "estimate")
    for obj, entries in body["properties"].items():
        for prop, entry in entries.items():
            cells = [obj, prop, *_cells(prop, entry)]
            if measured:
                value = measured.get(obj, {}).get(prop)
                factor, unit, digits = SHOWN.get(prop, (1.0, "", 3))
                against = body.get("actual", {}).get(obj, {}).get(prop, {})
                mark = "  disagrees" if against.get("disagrees") else ""
                cells.append("" if value is None else f"{value[0] * factor:.{digits}f} {unit}{mark}")
            table.add_row(*cells)
    return table


def _cells(prop: str, entry: dict[str, Any] | None) -> tuple[str, str]:
    if entry is None:
        return "unknown", ""
    factor, unit, digits = SHOWN.get(prop, (1.0, "", 3))
    if entry.get("mean") is None:
        return f">= {entry['lower_bound']:.{digits}f}", ""
    low, high = (f"{v * factor:.{digits}f}" for v in entry["interval_95"])
    return (
        f"{entry['mean'] * factor:.{digits}f} +- {entry['sd'] * factor:.{digits}f} {unit}",
        f"{low} to {high}",
    )
