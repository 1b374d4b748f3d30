"""What of a MuJoCo model can be set: names such as `joint:elbow.damping`, their values, and how to set them.

Everything of the catalogue is a field of the compiled model, set in place and taken back; any other attribute
of MjSpec, given by name, is set there and compiled anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.simulators.mjcf.engine import mujoco

OBJECTS = {
    "joint": "joint",
    "body": "body",
    "geom": "geom",
    "actuator": "actuator",
    "tendon": "tendon",
    "site": "site",
    "equality": "equality",
}


@dataclass(frozen=True)
class Setting:
    """One thing that can be set. `get(model)` is its value, `put(model, value)` sets it in a compiled model;
    `derived`: whether constants derived from it (mj_setConst) must be made anew. `xml`: the attribute, for a
    patch, as (object kind, object name, attribute, index or None)."""

    name: str
    unit: str
    get: Callable[[Any], float]
    put: Callable[[Any, float], None]
    derived: bool
    xml: tuple[str, str, str, int | None] | None
    mixed: float | None = (
        None  # runs are mixed in proportion with one at this value: what only comes in steps
    )


def _id(model: Any, kind: str, name: str) -> int:
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        raise KeyError(name)
    return found


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all objects of a kind, those without one left out."""
    count = {
        "joint": model.njnt,
        "body": model.nbody,
        "geom": model.ngeom,
        "actuator": model.nu,
        "sensor": model.nsensor,
        "site": model.nsite,
        "tendon": model.ntendon,
        "equality": model.neq,
    }[kind]
    of = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    return [n for n in (mujoco.mj_id2name(model, of, i) for i in range(count)) if n]


def _dofs(model: Any, joint: int) -> slice:
    width = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}.get(
        int(model.jnt_type[joint]), 1
    )
    first = int(model.jnt_dofadr[joint])
    return slice(first, first + width)


def joint_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """damping, frictionloss, armature, stiffness, springref of a joint."""
    j = _id(model, "joint", name)
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
        return None
    array, at, unit = fields[attribute]
    return _field(
        f"joint:{name}.{attribute}",
        unit,
        array,
        at,
        attribute == "armature",
        ("joint", name, attribute, None),
    )


def _field(name: str, unit: str, array: str, at: Any, derived: bool, xml) -> Setting:
    def get(model: Any) -> float:
        return float(np.ravel(np.asarray(getattr(model, array)[at]))[0])

    def put(model: Any, value: float) -> None:
        getattr(model, array)[at] = value

    return Setting(name, unit, get, put, derived, xml)


def body_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """mass (inertia in proportion), com_x, com_y, com_z, payload (a point mass at the far end, 2 com), length
    (of the body's offset from its parent, relative)."""
    b = _id(model, "body", name)
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
        return _field(f"body:{name}.{attribute}", "m", "body_ipos", (b, k), True, ("body", name, "ipos", k))
    if attribute == "payload":

        def load(m: Any, value: float) -> None:
            total = mass + value
            m.body_mass[b] = total
            m.body_ipos[b] = com * (1 + value / total)  # between com and the far end, 2 com
            # Both about the common centre (parallel axes), the axes of inertia taken as the frame's.
            m.body_inertia[b] = inertia + mass * value / total * (com @ com - com**2)

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


def geom_setting(model: Any, name: str, attribute: str) -> Setting | None:
    """friction, torsional (friction), time_constant and damping_ratio (solref), width (solimp), size."""
    g = _id(model, "geom", name)
    fields = {
        "friction": ("geom_friction", 0, "1", ("friction", 0)),
        "torsional": ("geom_friction", 1, "m", ("friction", 1)),
        "time_constant": ("geom_solref", 0, "s", ("solref", 0)),
        "damping_ratio": ("geom_solref", 1, "1", ("solref", 1)),
        "dmin": ("geom_solimp", 0, "1", ("solimp", 0)),
    }
    if attribute in fields:
        array, k, unit, (key, index) = fields[attribute]
        return _field(f"geom:{name}.{attribute}", unit, array, (g, k), False, ("geom", name, key, index))
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
    """gain (relative, of a position servo its stiffness), damping (kv), limit (of the force)."""
    a = _id(model, "actuator", name)
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


OPTIONS = ("tilt_x", "tilt_y", "timestep", "integrator", "iterations")


def option_setting(model: Any, attribute: str) -> Setting | None:
    """tilt_x, tilt_y (gravity turned about the world's axes [rad]), timestep (relative), integrator (0: as it
    is, 1: fourth-order Runge-Kutta or, from that, Euler), iterations (0: as they are, 1: ten times)."""
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
    if attribute == "integrator":
        own = int(model.opt.integrator)
        fourth, euler = int(mujoco.mjtIntegrator.mjINT_RK4), int(mujoco.mjtIntegrator.mjINT_EULER)

        def other(m: Any, value: float) -> None:
            m.opt.integrator = euler if own == fourth else fourth

        return Setting(
            "option.integrator", "1", lambda m: 0.0, other, False, ("option", "", "integrator", None), 1.0
        )
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
    if not dot or kind not in OBJECTS:
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


KNOWN = {
    "joint": ("damping", "frictionloss", "armature", "stiffness", "springref"),
    "body": ("mass", "com_x", "com_y", "com_z", "payload", "length"),
    "geom": ("friction", "torsional", "time_constant", "damping_ratio", "dmin", "size"),
    "actuator": ("gain", "damping", "limit"),
    "tendon": (),
    "site": (),
    "equality": (),
}
