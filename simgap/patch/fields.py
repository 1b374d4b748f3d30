"""What a patch writes into rig.toml: tables, numbers rounded to what is known, intervals beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.items import Table


def table(document: tomlkit.TOMLDocument, name: str) -> Table:
    """A table of a document, put at its end where it is not there."""
    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table(name == "effects"))
    return document[name]  # type: ignore[return-value]


def number(value: float) -> float:
    """Rounded to what a diagnosis can know."""
    return float(f"{value:.6g}")


def interval_comment(p: Mapping[str, Any]) -> str:
    """A parameter's interval, for a comment."""
    low, high = p["interval_90"]
    unit = "" if p["unit"] == "1" else f" {p['unit']}"
    return "interval unknown" if None in (low, high) else f"90 % interval {low:.4g} to {high:.4g}{unit}"
