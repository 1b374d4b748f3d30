"""`--patch`: the values found, with intervals, and for a MuJoCo model the XML with them in."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from simgap.robots.diagnose import RobotDiagnosis


def ranges(found: RobotDiagnosis, document: Mapping[str, Any]) -> dict[str, Any]:
    """What to set and over which range to randomise it: causes, and what was fitted along."""
    out: dict[str, Any] = {"causes": {}, "fitted": {}}
    for cause in document["causes"]:
        effect = found.composed.effects[cause]
        own = document["effects"][cause]["parameters"]
        out["causes"][cause] = {
            "says": effect.says,
            "parameters": {
                n: {
                    "value": p["mean"],
                    "range": p["interval_90"],
                    "unit": p["unit"],
                    "nominal": effect.parameters[n].nominal,
                }
                for n, p in own.items()
            },
        }
    for name, v in document["fitted"].items():
        out["fitted"][name] = {"value": v["after"], "nominal": v["before"], "unit": v["unit"]}
    return out


def write_patch(
    found: RobotDiagnosis, document: Mapping[str, Any], xml: Path | None, path: Callable[[str], Path]
) -> None:
    """Write ranges.json, and for a MuJoCo model the XML with the causes in it."""
    document_of_ranges = ranges(found, document)
    if xml is not None:
        from simgap.simulators.mjcf.patch import patched

        text, untouched = patched(xml, found)
        document_of_ranges["not_in_xml"] = untouched
        path(xml.name).write_text(text, encoding="utf-8")
    path("ranges.json").write_text(
        json.dumps(document_of_ranges, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
