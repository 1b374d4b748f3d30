"""`--patch`: the values found, with intervals, and for a MuJoCo model the corrected XML."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from simgap.robots.model import Composed, Point


def write_patch(
    composed: Composed,
    point: Point,
    document: Mapping[str, Any],
    changed: Sequence[str],
    model: Path | None,
    path: Callable[[str], Path],
) -> None:
    """Write `ranges.json` and, for a MuJoCo model, the corrected XML.

    Args:
        composed: The effects around their simulator.
        point: Parameters by effect.
        document: The JSON document of the diagnosis, comparison or calibration.
        changed: Names of the effects to put into the model.
        model: The MJCF or URDF file; None of any other simulator.
        path: From a file's name to where it is written.
    """
    out = ranges(composed, document)
    if model is not None:
        text, out["not_in_xml"] = patched(model, composed, point, changed)
        path(model.with_suffix(".xml").name).write_text(text, encoding="utf-8")
    path("ranges.json").write_text(json.dumps(out, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def ranges(composed: Composed, document: Mapping[str, Any]) -> dict[str, Any]:
    """Values to set and ranges over which to randomise them, of the causes and of what was fitted along."""
    out: dict[str, Any] = {"causes": {}, "fitted": {}}
    for cause in document.get("causes", ()):
        effect, found = composed.effects[cause], document["effects"][cause]["parameters"]
        parameters = {n: _range(p, effect.parameters[n].nominal) for n, p in found.items()}
        out["causes"][cause] = {"says": effect.says, "parameters": parameters}
    for name, v in document.get("fitted", {}).items():
        out["fitted"][name] = {"value": v["after"], "nominal": v["before"], "unit": v["unit"]}
    for name, p in document.get("parameters", {}).items():
        out["fitted"][name] = _range(p, p["nominal"])
    return out


def _range(found: Mapping[str, Any], nominal: float) -> dict[str, Any]:
    return {"value": found["mean"], "range": found["interval_90"], "unit": found["unit"], "nominal": nominal}


def patched(model: Path, composed: Composed, point: Point, changed: Sequence[str]) -> tuple[str, list[str]]:
    """Put effects into a MuJoCo model.

    Args:
        model: The MJCF or URDF file.
        composed: The effects around its simulator.
        point: Parameters by effect.
        changed: Names of the effects to put into the model.

    Returns:
        The model as MuJoCo writes it (one MJCF file, includes joined, default classes kept), and a line for
        everything that no attribute of it can hold.
    """
    from simgap.simulators.mjcf.engine import mujoco

    simulator: Any = composed.simulator
    parameters = composed.parameters(point)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    says, lacking = dict[str, str](), []
    for name in changed:
        effect = composed.effects[name]
        says |= dict.fromkeys(effect.model.values(), effect.says)
        lacking += [] if effect.model else [f"{name}: {effect.says}"]
    for name, setting in simulator.settings.items():  # in the order in which runs set them
        motor = name.startswith("actuator:") and not compiled.nu  # that only its map gives the model
        if name in says and (motor or not setting.stored):
            lacking.append(f"{name}: {says[name]}")
        elif name in says:
            finest = -float("inf") if setting.mixed is None else setting.mixed
            setting.put(compiled, max(parameters[name], finest))
    with tempfile.TemporaryDirectory(prefix="hmmseg_") as folder:
        path = Path(folder) / "patched.xml"
        mujoco.mj_saveLastXML(str(path), compiled)
        return path.read_text(encoding="utf-8"), lacking
