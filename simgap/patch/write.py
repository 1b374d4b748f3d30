"""The corrected rig.toml, the corrected blocks and the posterior as ranges, from a diagnosis's JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.items import Table

from hmmseg.errors import InputError
from simgap.effects import catalogue


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


Body = Mapping[str, Any]
FORMAT = "hmmseg.ranges/1"


def files(rig_text: str, body: Body) -> dict[str, str]:
    """Texts of rig.toml, ranges.json and actual.toml by name; none where no cause was named.

    rig.toml is the given one, its comments kept, with each found value's interval after it; what the rig
    has no number for is under [effects], which `hmmseg simulate` applies. ranges.json holds every found
    parameter by its place in rig.toml, and every block's properties, as mean, sd and 90 % interval in SI
    units. actual.toml holds the blocks as identified with the causes in the model.
    """
    name = "+".join(body["causes"])
    entry = body["effects"].get(name)
    if not body["causes"] or entry is None:
        return {}
    document = tomlkit.parse(rig_text)
    ranges: dict[str, dict[str, Any]] = {}
    for effect in body["causes"]:
        found = {
            k.removeprefix(f"{effect}."): p for k, p in entry["parameters"].items()
            if len(body["causes"]) == 1 or k.startswith(f"{effect}.")
        }  # fmt: skip
        for parameter, place in _correct(document, effect, found).items():
            ranges[place] = _range(found[parameter])
    ranges = {k: v for k, v in ranges.items() if v["mean"] is not None}
    out = {"rig.toml": tomlkit.dumps(document)}
    blocks = _blocks(entry)
    said = {"format": FORMAT, "causes": list(body["causes"]), "parameters": ranges, "blocks": blocks}
    out["ranges.json"] = json.dumps(said, indent=1) + "\n"
    if blocks:
        out["actual.toml"] = _actual(blocks)
    return out


def _correct(document: tomlkit.TOMLDocument, effect: str, found: Mapping[str, Any]) -> dict[str, str]:
    """Put one effect into the rig; the place of each parameter."""
    known = catalogue().get(effect)
    places = known.patched(document, found) if known is not None and known.patched is not None else None
    if places is not None:
        return places
    if known is None or not known.simulated:
        document.add(tomlkit.comment(f"{effect}: found, but nothing that `hmmseg simulate` can put in"))
        return {}
    effects = table(document, "effects")
    mine = tomlkit.table()
    for parameter, p in found.items():
        if p["mean"] is not None:
            mine.add(parameter, number(p["mean"]))
            mine[parameter].comment(interval_comment(p))
    effects[effect] = mine
    return {parameter: f"effects.{effect}.{parameter}" for parameter in found}


def _range(p: Mapping[str, Any]) -> dict[str, Any]:
    low, high = p["interval_90"]
    return {"unit": p["unit"], "mean": p["mean"], "sd": p["sd"], "low": low, "high": high}


def _blocks(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Properties by block, as the causes in the model leave them."""
    out: dict[str, Any] = {}
    for name, shift in (entry.get("property_shift") or {}).items():
        block, _, prop = name.rpartition(".")
        out.setdefault(block, {})[prop] = {"unit": shift["unit"], "value": shift["after"]}
    return out


def _actual(blocks: Mapping[str, Any]) -> str:
    document = tomlkit.document()
    document.add(tomlkit.comment("Blocks as identified with the causes in the model: simulate --properties."))
    for block, properties in blocks.items():
        document[block] = properties
    return tomlkit.dumps(document)


def checked(effects: Mapping[str, Mapping[str, float]], where: str) -> None:
    """InputError where [effects] of a rig names what the virtual model cannot apply."""
    for name, values in effects.items():
        known = catalogue().get(name)
        if known is None or not known.simulated:
            can = sorted(n for n, e in catalogue().items() if e.simulated)
            raise InputError(
                f"{where}: key effects.{name}", "no effect that can be simulated", ", ".join(can)
            )
        if not values:
            raise InputError(
                f"{where}: key effects.{name}", "has no parameters", "its values, as --patch writes"
            )
