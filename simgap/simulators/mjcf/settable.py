"""What of a MuJoCo model can be set: names such as `joint:elbow.damping`, their values, and how to set them.

Everything of the catalogue is a field of the compiled model, set in place and taken back; any other attribute
of MjSpec, given by name, is set there and recompiled. Laws that go by the state are no field: `laws.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.laws import FADE, OF_JOINTS, joint_law, law_setting, most_of
from simgap.simulators.mjcf.runs import HOLD, LATE
from simgap.simulators.mjcf.setting import Setting, array_setting, names_of, object_id


def _dofs(model: Any, joint: int) -> slice:
    width = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}.get(
        int(model.jnt_type[joint]), 1
    )
    first = int(model.jnt_dofadr[joint])
    return slice(first, first + width)


def joint_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """damping, frictionloss, armature, stiffness, springref of a joint, and its laws."""
    j = object_id(model, "joint", name)
    turning = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    dof = _dofs(model, j)
    fields = {
        "damping": ("dof_damping", dof, "N m s/rad" if turning else "N s/m"),
        "frictionloss": ("dof_frictionloss", dof, "N m" if turning else "N"),
        "armature": ("dof_armature", dof, "kg m^2" if turning else "kg"),
        "stiffness": ("jnt_stiffness", j, "N m/rad" if turning else "N/m"),
        "springref": ("qpos_spring", int(model.jnt_qposadr[j]), "rad" if turning else "m"),
    }
    if attribute not in fields:
        return joint_law(model, name, attribute)
    array, at, unit = fields[attribute]
    return array_setting(
        f"joint:{name}.{attribute}",
        unit,
        array,
        at,
        attribute == "armature",
        ("joint", name, attribute, None),
    )


def body_setting(model: Any, name: str, attribute: str, at: np.ndarray | None = None) -> Setting | None:
    """mass (inertia in proportion), com_x, com_y, com_z, payload (a point mass `at` (3,) [m] in the body's
    frame, or its `payload_place`), length (of the body's offset from its parent, relative)."""
    b = object_id(model, "body", name)
    mass, inertia = float(model.body_mass[b]), np.array(model.body_inertia[b])
    offset, com = np.array(model.body_pos[b]), np.array(model.body_ipos[b])

    if attribute == "mass":

        def put(m: Any, value: float) -> None:
            m.body_mass[b], m.body_inertia[b] = value, inertia * (value / mass)

        return Setting(
            f"body:{name}.mass",
            "kg",
            lambda m: float(m.body_mass[b]),
            put,
            True,
            ("body", name, "mass", None),
        )
    if attribute.startswith("com_") and attribute[-1] in "xyz":
        k = "xyz".index(attribute[-1])
        return array_setting(
            f"body:{name}.{attribute}", "m", "body_ipos", (b, k), True, ("body", name, "ipos", k)
        )
    if attribute == "payload":
        place = payload_place(model, name) if at is None else at

        def load(m: Any, value: float) -> None:
            total = mass + value
            away, turn = place - com, np.zeros(9)
            mujoco.mju_quat2Mat(turn, m.body_iquat[b])
            arm = turn.reshape(3, 3).T @ away  # in the axes of inertia
            m.body_mass[b], m.body_ipos[b] = total, com + value / total * away
            # Both about the common centre (parallel axes); the axes of inertia stay.
            m.body_inertia[b] = inertia + mass * value / total * (arm @ arm - arm**2)

        return Setting(f"body:{name}.payload", "kg", lambda m: float(m.body_mass[b] - mass), load, True, None)
    if attribute == "length":
        norm = float(np.linalg.norm(offset))
        if norm == 0:
            return None

        def stretch(m: Any, value: float) -> None:
            m.body_pos[b] = offset * (1 + value)

        return Setting(
            f"body:{name}.length",
            "1",
            lambda m: float(np.linalg.norm(m.body_pos[b]) / norm - 1),
            stretch,
            True,
            ("body", name, "pos", None),
        )
    return None


def payload_place(model: Any, name: str) -> np.ndarray:
    """Where a body carries a load (3,) [m], in its frame: at its farthest site, where it has one, else at the
    farthest centre of its geoms; at its centre of mass if it has none."""
    b = object_id(model, "body", name)
    for places, owner in ((model.site_pos, model.site_bodyid), (model.geom_pos, model.geom_bodyid)):
        mine = np.array(places[np.asarray(owner) == b])
        if len(mine):
            return mine[int(np.argmax(np.linalg.norm(mine, axis=1)))]
    return np.array(model.body_ipos[b])


def geom_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """friction, torsional (friction), time_constant and damping_ratio (solref), width (solimp), size."""
    g = object_id(model, "geom", name)
    fields = {
        "friction": ("geom_friction", 0, "1", ("friction", 0)),
        "torsional": ("geom_friction", 1, "m", ("friction", 1)),
        "time_constant": ("geom_solref", 0, "s", ("solref", 0)),
        "damping_ratio": ("geom_solref", 1, "1", ("solref", 1)),
        "dmin": ("geom_solimp", 0, "1", ("solimp", 0)),
    }
    if attribute in fields:
        array, k, unit, (key, index) = fields[attribute]
        return array_setting(
            f"geom:{name}.{attribute}", unit, array, (g, k), False, ("geom", name, key, index)
        )
    if attribute == "size" and int(model.geom_type[g]) != int(mujoco.mjtGeom.mjGEOM_MESH):
        size, bound = np.array(model.geom_size[g]), float(model.geom_rbound[g])

        def put(m: Any, value: float) -> None:
            m.geom_size[g], m.geom_rbound[g] = size * (1 + value), bound * (1 + value)

        return Setting(
            f"geom:{name}.size",
            "1",
            lambda m: float(m.geom_size[g][0] / size[0] - 1),
            put,
            False,
            ("geom", name, "size", None),
        )
    return None


def actuator_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """gain (relative, of a position servo its stiffness), damping (kv), limit (of the force), fade."""
    a = object_id(model, "actuator", name)
    gain, bias = np.array(model.actuator_gainprm[a]), np.array(model.actuator_biasprm[a])

    if attribute == "gain":

        def put(m: Any, value: float) -> None:
            m.actuator_gainprm[a, 0] = gain[0] * (1 + value)
            m.actuator_biasprm[a, 1] = bias[1] * (1 + value)

        return Setting(
            f"actuator:{name}.gain",
            "1",
            lambda m: float(m.actuator_gainprm[a, 0] / gain[0] - 1),
            put,
            False,
            ("actuator", name, "kp" if bias[1] else "gainprm", None),
        )
    if attribute == "damping":

        def brake(m: Any, value: float) -> None:
            m.actuator_biasprm[a, 2] = -value

        return Setting(
            f"actuator:{name}.damping",
            "N m s/rad",
            lambda m: -float(m.actuator_biasprm[a, 2]),
            brake,
            False,
            ("actuator", name, "kv", None),
        )
    if attribute == FADE and most_of(model, a):
        return law_setting(f"actuator:{name}.{FADE}", "1")
    if attribute == "limit" and model.actuator_forcelimited[a]:

        def limit(m: Any, value: float) -> None:
            m.actuator_forcerange[a] = (-value, value)

        return Setting(
            f"actuator:{name}.limit",
            "N",
            lambda m: float(m.actuator_forcerange[a, 1]),
            limit,
            False,
            ("actuator", name, "forcerange", None),
        )
    return None


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
