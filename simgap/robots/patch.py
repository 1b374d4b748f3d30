"""`--patch`: the values found, with intervals, and for a MuJoCo model the XML with them in."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from simgap.robots.model import Composed, Point


def ranges(composed: Composed, document: Mapping[str, Any]) -> dict[str, Any]:
    """What to set and over which range to randomise it: causes, and what was fitted along."""
    out: dict[str, Any] = {"causes": {}, "fitted": {}}
    for cause in document.get("causes", ()):
        effect = composed.effects[cause]
        own = document["effects"][cause]["parameters"]
        nominal = {n: effect.parameters[n].nominal for n in own}
        out["causes"][cause] = {
            "says": effect.says,
            "parameters": {n: _range(p, nominal[n]) for n, p in own.items()},
        }
    for name, v in document.get("fitted", {}).items():
        out["fitted"][name] = {"value": v["after"], "nominal": v["before"], "unit": v["unit"]}
    for name, p in document.get("parameters", {}).items():
        out["fitted"][name] = _range(p, p["nominal"])
    return out


def _range(found: Mapping[str, Any], nominal: float) -> dict[str, Any]:
    return {"value": found["mean"], "range": found["interval_90"], "unit": found["unit"], "nominal": nominal}


def write_patch(
    composed: Composed,
    point: Point,
    document: Mapping[str, Any],
    changed: Sequence[str],
    model: Path | None,
    path: Callable[[str], Path],
) -> None:
    """Write ranges.json, and for a MuJoCo model the XML with the effects that are `changed` at a point."""
    out = ranges(composed, document)
    if model is not None:
        from simgap.simulators.mjcf.patch import patched

        text, untouched = patched(model, composed, point, changed)
        out["not_in_xml"] = untouched
        path(model.with_suffix(".xml").name).write_text(text, encoding="utf-8")
    path("ranges.json").write_text(json.dumps(out, indent=1, allow_nan=False) + "\n", encoding="utf-8")
