"""The corrected rig.toml, the corrected blocks and the posterior as ranges, from a diagnosis's JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.items import Table

from hmmseg.errors import InputError
from simgap.effects import catalogue

Body = Mapping[str, Any]
FORMAT = "hmmseg.ranges/1"
# Found values that replace numbers of the rig itself; every other effect stands under [effects].
PADS = ("normal_stiffness", "shear_stiffness")


def files(rig_text: str, body: Body) -> dict[str, str]:
    """Texts of rig.toml, ranges.json and actual.toml by name; none where no cause was named.

    rig.toml is the given one, its comments kept, with each found value's interval beside it; what the rig
    has no number for stands under [effects], which `hmmseg simulate` applies. ranges.json holds every found
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
    told = {"format": FORMAT, "causes": list(body["causes"]), "parameters": ranges, "blocks": blocks}
    out["ranges.json"] = json.dumps(told, indent=1) + "\n"
    if blocks:
        out["actual.toml"] = _actual(blocks)
    return out


def _correct(document: tomlkit.TOMLDocument, effect: str, found: Mapping[str, Any]) -> dict[str, str]:
    """Put one effect into the rig; the place of each parameter."""
    if effect == "fingertip_compliance":
        pads = _table(document, "fingertip")
        return {k: _pad(pads, k, found[k]) for k in PADS if k in found}
    if effect == "link_length" and "fingers" in document:
        return _links(document, found)
    known = catalogue().get(effect)
    if known is None or not (known.apply or known.scene or known.finish):
        document.add(tomlkit.comment(f"{effect}: found, but nothing that `hmmseg simulate` can put in"))
        return {}
    effects = _table(document, "effects")
    table = tomlkit.table()
    for parameter, p in found.items():
        if p["mean"] is not None:
            table.add(parameter, _number(p["mean"]))
            table[parameter].comment(_told(p))
    effects[effect] = table
    return {parameter: f"effects.{effect}.{parameter}" for parameter in found}


def _table(document: tomlkit.TOMLDocument, name: str) -> Table:
    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table(name == "effects"))
    return document[name]  # type: ignore[return-value]


def _pad(pads: Table, name: str, p: Mapping[str, Any]) -> str:
    before, said = pads.get(name, float("inf")), ""
    if name in pads:
        said = pads[name].trivia.comment.lstrip("# ")  # type: ignore[union-attr]
    pads[name] = _number(p["mean"])
    pads[name].comment(f"was {float(before):g}; {_told(p)}" + (f"; {said}" if said else ""))
    return f"fingertip.{name}"


def _links(document: tomlkit.TOMLDocument, found: Mapping[str, Any]) -> dict[str, str]:
    """Links longer by `scale`, all of them, or each by its own: link11 is finger 1's first."""
    common = found["scale"]["mean"] if "scale" in found else 0.0
    for name, finger in document["fingers"].items():  # type: ignore[union-attr]
        before = [float(v) for v in finger["links"]]
        own = [found.get(f"link{name}{k}") for k in (1, 2)]
        factors = [1 + common + (p["mean"] if p else 0.0) for p in own]
        finger["links"] = [_number(v * f) for v, f in zip(before, factors, strict=True)]
        told = [_told(p) for p in (found.get("scale"), *own) if p]
        finger["links"].comment(f"was {before}; share longer: {'; '.join(told)}")
    return {k: f"fingers.links.{k}" for k in found}


def _told(p: Mapping[str, Any]) -> str:
    low, high = p["interval_90"]
    unit = "" if p["unit"] == "1" else f" {p['unit']}"
    return "interval unknown" if None in (low, high) else f"90 % interval {low:.4g} to {high:.4g}{unit}"


def _number(value: float) -> float:
    """Rounded to what a diagnosis can know."""
    return float(f"{value:.6g}")


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
        if known is None or not (known.apply or known.scene or known.finish):
            can = sorted(n for n, e in catalogue().items() if e.apply or e.scene or e.finish)
            raise InputError(
                f"{where}: key effects.{name}", "no effect that can be simulated", ", ".join(can)
            )
        if not values:
            raise InputError(
                f"{where}: key effects.{name}", "has no parameters", "its values, as --patch writes"
            )
