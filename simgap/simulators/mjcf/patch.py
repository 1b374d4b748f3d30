"""The corrected model as MuJoCo writes it: one file, its includes joined, its default classes kept."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from simgap.robots.model import Composed, Point
from simgap.simulators.mjcf.engine import mujoco


def patched(model: Path, composed: Composed, point: Point, changed: Sequence[str]) -> tuple[str, list[str]]:
    """A model with some effects in it.

    Args:
        model: The MJCF or URDF file.
        composed: The effects around its simulator.
        point: By effect its parameters.
        changed: Names of the effects that are to be in it.

    Returns:
        The corrected model as MJCF, and a line for everything that no attribute of it holds.
    """
    simulator: Any = composed.simulator
    parameters = composed.parameters(point)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    mine, lacking = dict[str, str](), []
    for one in changed:
        effect = composed.effects[one]
        mine |= {name: effect.says for name in effect.model.values()}
        lacking += [] if effect.model else [f"{one}: {effect.says}"]
    for name, setting in simulator.settings.items():  # in the order in which runs set them
        if name in mine and not setting.stored:
            lacking.append(f"{name}: {mine[name]}")
        elif name in mine:
            finest = -float("inf") if setting.mixed is None else setting.mixed
            setting.put(compiled, max(parameters[name], finest))
    with tempfile.TemporaryDirectory(prefix="hmmseg_") as folder:
        path = Path(folder) / "patched.xml"
        mujoco.mj_saveLastXML(str(path), compiled)
        return path.read_text(encoding="utf-8"), lacking
