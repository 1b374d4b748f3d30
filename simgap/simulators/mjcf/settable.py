"""What of a MuJoCo model can be set: names such as `joint:elbow.damping`, their values, and how to set them.

Everything of the catalogue is a field of the compiled model, set in place and taken back; any other attribute
of MjSpec, given by name, is set there and compiled anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.simulators.mjcf.laws import FADE, OF_JOINTS
from simgap.simulators.mjcf.runs import HOLD, LATE
from simgap.simulators.mjcf.settable_parts import actuator_setting, body_setting, geom_setting, joint_setting
from simgap.simulators.mjcf.setting import Setting, names_of

KNOWN = {
    "joint": ("damping", "frictionloss", "armature", "stiffness", "springref", *OF_JOINTS),
    "body": ("mass", "com_x", "com_y", "com_z", "payload", "length"),
    "geom": ("friction", "torsional", "time_constant", "damping_ratio", "dmin", "size"),
    "actuator": ("gain", "damping", "limit", FADE),
    "tendon": (),
    "site": (),
    "equality": (),
}
OPTIONS = ("tilt_x", "tilt_y", "timestep", "iterations", "hold", "late")


def option_setting(model: Any, attribute: str) -> Setting | None:
    """tilt_x, tilt_y (gravity turned about the world's axes [rad]), timestep (relative), iterations (0: as it
    is, 1: ten times), hold (of commands between samples; 0: in steps, 1: in lines to the next), late (by
    which share of a step they come later)."""
    down = np.array(model.opt.gravity)
    if attribute in ("tilt_x", "tilt_y"):
        axis = 0 if attribute == "tilt_x" else 1

        def tilt(m: Any, value: float) -> None:
            m.opt.gravity[:] = np.array(m.opt.gravity) + np.cross(np.eye(3)[axis], down) * value

        return Setting(
            f"option.{attribute}", "rad", lambda m: 0.0, tilt, False, ("option", "", "gravity", None)
        )
    if attribute == "timestep":
        step = float(model.opt.timestep)

        def scale(m: Any, value: float) -> None:
            m.opt.timestep = step * (1 + value)

        return Setting(
            "option.timestep", "1", lambda m: 0.0, scale, False, ("option", "", "timestep", None), -0.75
        )
    if attribute == "hold":  # of the commands and not of the model: `Runs` has it
        return Setting(HOLD, "1", lambda m: 0.0, lambda m, value: None, False, None)
    if attribute == "late":
        return Setting(LATE, "1", lambda m: 0.0, lambda m, value: None, False, None)
    if attribute == "iterations":
        count = int(model.opt.iterations)

        def more(m: Any, value: float) -> None:
            m.opt.iterations = 10 * count

        return Setting(
            "option.iterations", "1", lambda m: 0.0, more, False, ("option", "", "iterations", None), 1.0
        )
    return None


def setting_of(model: Any, name: str) -> Setting:
    """The setting by name; InputError names what is unknown, and the nearest."""
    where = f"--candidate {name}"
    head, dot, attribute = name.rpartition(".")
    kind, _, thing = head.partition(":")
    if kind == "option" and dot:
        found = option_setting(model, attribute)
        if found is None:
            raise InputError(where, f"option has no {attribute}", nearest(attribute, OPTIONS))
        return found
    makers = {
        "joint": joint_setting,
        "body": body_setting,
        "geom": geom_setting,
        "actuator": actuator_setting,
    }
    if not dot or kind not in KNOWN:
        raise InputError(
            where, "names nothing of the model", "KIND:NAME.ATTRIBUTE, such as joint:elbow.damping"
        )
    known = names_of(model, kind)
    if thing not in known:
        raise InputError(where, f"the model has no {kind} {thing}", nearest(thing, known))
    found = makers[kind](model, thing, attribute) if kind in makers else None
    if found is None:
        raise InputError(
            where, f"a {kind} has no {attribute} that can be a candidate", nearest(attribute, KNOWN[kind])
        )
    return found
