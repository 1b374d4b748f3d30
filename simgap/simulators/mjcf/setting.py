"""Settings of a MuJoCo model by names such as `joint:elbow.damping`, and a model with some changed.

A setting is a field of the compiled model, set in place and restored, or a parameter of what MuJoCo lacks: a
law (`laws.py`), or how commands are held between samples (`runs.py`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.simulators.mjcf.engine import FREE, HINGE, JOINT, mujoco

Put = Callable[[Any, float], None]
OF_FRICTION = ("load_friction", "direction_friction", "stribeck_extra", "stribeck_speed", "quadratic_drag")
UNEVEN = tuple(f"{law}_{part}" for law in ("cogging", "ripple") for part in ("per_turn", "cos", "sin"))
FADE = "fade"  # a law of actuators
# How commands are held between samples: 0 in steps; 1 in lines to the next, as they are where a step begins.
HOLD = "option.hold"
SMOOTH = "option.smooth"  # share of each command that is the mean of those before and after it
LATE = "option.late"  # share of a step by which commands come later
HELD = ("hold", "smooth", "late")


@dataclass(frozen=True)
class Setting:
    """One quantity that can be set."""

    name: str
    unit: str
    nominal: float
    put: Put  # sets a value in a model
    derived: bool = False  # whether constants derived from it (mj_setConst) must be recomputed
    stored: bool = True  # whether MuJoCo writes it to XML
    # of what comes in whole steps, the value whose run is interpolated with the nominal one
    mixed: float | None = None


def object_id(model: Any, kind: str, name: str) -> int:
    """Index of an object; KeyError where none has that name."""
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        raise KeyError(name)
    return found


def name_of(model: Any, kind: str, number: int) -> str:
    """The name of a joint, body, geom or actuator; empty where it has none."""
    return mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), number) or ""


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all objects of a kind that have one."""
    count = model.nu if kind == "actuator" else getattr(model, {"joint": "njnt"}.get(kind, f"n{kind}"))
    return [name for name in (name_of(model, kind, i) for i in range(count)) if name]


def payload_place(model: Any, name: str) -> np.ndarray:
    """Where a body carries a load (3,) [m]: its farthest site, else geom, else its centre of mass."""
    b = object_id(model, "body", name)
    for places, owner in ((model.site_pos, model.site_bodyid), (model.geom_pos, model.geom_bodyid)):
        mine = np.array(places[np.asarray(owner) == b])
        if len(mine):
            return mine[int(np.argmax(np.linalg.norm(mine, axis=1)))]
    return np.array(model.body_ipos[b])


def follows_rates(model: Any, actuator: int) -> bool:
    """Whether an actuator is a servo whose command is its joint's rate."""
    gain, (_, stiff, damped) = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3]
    return bool(stiff == 0 and gain == -damped and gain > 0)


def turns(model: Any, actuator: int) -> bool:
    """Whether an actuator moves a hinge, so that what it gives is a torque."""
    moves = int(model.actuator_trnid[actuator, 0])
    return int(model.actuator_trntype[actuator]) == JOINT and int(model.jnt_type[moves]) == HINGE


def strength_of(model: Any, actuator: int) -> slice:
    """Which of an actuator's numbers its force is proportional to: a motor's first hold something else."""
    kinds = {"MUSCLE": slice(2, 4), "DCMOTOR": slice(1, 2)}  # its peak force; the motor's constant
    own = {getattr(mujoco.mjtGain, f"mjGAIN_{kind}", None): at for kind, at in kinds.items()}
    return own.get(mujoco.mjtGain(model.actuator_gaintype[actuator]), slice(0, 3))


def most_of(model: Any, actuator: int) -> float:
    """The largest force of an actuator; 0 where the model states none."""
    if model.actuator_forcelimited[actuator]:
        return float(np.abs(model.actuator_forcerange[actuator]).max())
    fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    if fixed and model.actuator_ctrllimited[actuator] and not model.actuator_biasprm[actuator, 1]:
        gain = abs(float(model.actuator_gainprm[actuator, 0]))
        return gain * float(np.abs(model.actuator_ctrlrange[actuator]).max())
    return 0.0


def compiled(spec: Any) -> Any:
    """Compile an MjSpec such that gravity compensation can be set where the spec has none."""
    own = [body.gravcomp for body in spec.bodies]
    for body in spec.bodies:
        body.gravcomp = 1.0
    model = spec.compile()
    for body, share in zip(spec.bodies, own, strict=True):
        body.gravcomp = model.body_gravcomp[body.id] = share
    return model


def nothing(model: Any, value: float) -> None:
    """Set nothing: the parameter acts while the model runs."""


def _to(array: str, at: Any, factor: float | np.ndarray = 1.0) -> Put:
    """A setter of an entry of one of the model's arrays."""

    def put(model: Any, value: float) -> None:
        getattr(model, array)[at] = factor * value

    return put


def _field(name: str, unit: str, model: Any, array: str, at: Any, derived: bool = False) -> Setting:
    """A setting of equal entries of one of the model's arrays."""
    nominal = float(np.ravel(getattr(model, array)[at])[0])
    return Setting(name, unit, nominal, _to(array, at), derived)


def _larger(model: Any, *entries: tuple[str, Any]) -> Put:
    """A setter of entries to 1 + value times what the model has."""
    own = [(array, at, np.array(getattr(model, array)[at])) for array, at in entries]

    def put(m: Any, value: float) -> None:
        for array, at, nominal in own:
            getattr(m, array)[at] = nominal * (1 + value)

    return put


def _joint(model: Any, name: str, attribute: str) -> Setting | None:
    j = object_id(model, "joint", name)
    turning = int(model.jnt_type[j]) == HINGE
    force, way = ("N m", "rad") if turning else ("N", "m")
    units = "1", force, force, f"{way}/s", f"{force} s^2/{way}^2", "1", force, force, "1", "1", "1"
    laws = dict(zip((*OF_FRICTION, *UNEVEN), units, strict=True))
    if attribute in laws:
        return Setting(f"joint:{name}.{attribute}", laws[attribute], 0.0, nothing, stored=False)
    dofs = np.flatnonzero(np.asarray(model.dof_jntid) == j)
    tie = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_obj1id == j))
    if attribute == "tie" and tie.size:
        return _field(f"joint:{name}.tie", "s", model, "eq_solref", (tie[0], 0))
    found = {
        "damping": ("dof_damping", dofs, f"{force} s/{way}"),
        "frictionloss": ("dof_frictionloss", dofs, force),
        "armature": ("dof_armature", dofs, "kg m^2" if turning else "kg"),
        "stiffness": ("jnt_stiffness", [j], f"{force}/{way}"),
        "springref": ("qpos_spring", [int(model.jnt_qposadr[j])], way),
    }.get(attribute)
    if found is None:
        return None
    array, at, unit = found
    return _field(f"joint:{name}.{attribute}", unit, model, array, at, attribute == "armature")


def only_slides(model: Any, body: int) -> bool:
    """Whether where a body's mass lies moves nothing, so that MuJoCo may count it as simple."""
    return int(model.body_simple[body]) == 2


def _body(model: Any, name: str, attribute: str) -> Setting | None:
    if attribute == "payload":
        return payload(model, name, payload_place(model, name))
    b, whole = object_id(model, "body", name), f"body:{name}.{attribute}"
    if attribute == "mass":
        mass, inertia = float(model.body_mass[b]), np.array(model.body_inertia[b])

        def put(m: Any, value: float) -> None:
            m.body_mass[b], m.body_inertia[b] = value, inertia * (value / mass)

        return Setting(whole, "kg", mass, put, True)
    if attribute in ("com_x", "com_y", "com_z") and not only_slides(model, b):
        return _field(whole, "m", model, "body_ipos", (b, "xyz".index(attribute[-1])), True)
    if attribute == "length" and np.any(model.body_pos[b]):
        return Setting(whole, "1", 0.0, _larger(model, ("body_pos", b)), True)
    return None


def payload(model: Any, name: str, place: np.ndarray) -> Setting:
    """The mass [kg] of a point load on a body, at a place (3,) [m] in its frame."""
    b = object_id(model, "body", name)
    mass, inertia = float(model.body_mass[b]), np.array(model.body_inertia[b])
    com = np.array(model.body_ipos[b])
    place = com if only_slides(model, b) else place

    def load(m: Any, value: float) -> None:
        total = mass + value
        away, turn = place - com, np.zeros(9)
        mujoco.mju_quat2Mat(turn, m.body_iquat[b])
        arm = turn.reshape(3, 3).T @ away  # in the axes of inertia
        m.body_mass[b], m.body_ipos[b] = total, com + value / total * away
        # Both about the common centre (parallel axes); the axes of inertia stay.
        m.body_inertia[b] = inertia + mass * value / total * (arm @ arm - arm**2)

    return Setting(f"body:{name}.payload", "kg", 0.0, load, True)


def _geom(model: Any, name: str, attribute: str) -> Setting | None:
    g, whole = object_id(model, "geom", name), f"geom:{name}.{attribute}"
    if attribute == "size" and int(model.geom_type[g]) != int(mujoco.mjtGeom.mjGEOM_MESH):
        return Setting(whole, "1", 0.0, _larger(model, ("geom_size", g), ("geom_rbound", g)))
    found = {
        "friction": ("friction", 0, "1"),
        "torsional": ("friction", 1, "m"),
        "time_constant": ("solref", 0, "s"),
        "damping_ratio": ("solref", 1, "1"),
        "dmin": ("solimp", 0, "1"),
    }.get(attribute)
    if found is None:
        return None
    key, k, unit = found
    return _field(whole, unit, model, f"geom_{key}", (g, k))


def _actuator(model: Any, name: str, attribute: str) -> Setting | None:
    a, whole = object_id(model, "actuator", name), f"actuator:{name}.{attribute}"
    force, damped = ("N m", "N m s/rad") if turns(model, a) else ("N", "N s/m")
    if attribute == "gain":  # of a servo of positions its stiffness, of one of rates its velocity gain
        at, muscle = strength_of(model, a), mujoco.mjtBias.mjBIAS_MUSCLE
        opposed = at if model.actuator_biastype[a] == muscle else 1 + follows_rates(model, a)
        entries = ("actuator_gainprm", (a, at)), ("actuator_biasprm", (a, opposed))
        return Setting(whole, "1", 0.0, _larger(model, *entries))
    if attribute == "damping" and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
        nominal = -float(model.actuator_biasprm[a, 2])
        return Setting(whole, damped, nominal, _to("actuator_biasprm", (a, 2), -1.0))
    if attribute == FADE and most_of(model, a):
        return Setting(whole, "1", 0.0, nothing, stored=False)
    if attribute == "limit" and model.actuator_forcelimited[a]:
        ends = _to("actuator_forcerange", a, np.array([-1.0, 1.0]))
        return Setting(whole, force, float(model.actuator_forcerange[a, 1]), ends)
    return None


def _option(model: Any, _: str, attribute: str) -> Setting | None:
    """tilt_x, tilt_y (gravity rotated about the world's axes [rad]), timestep (relative; of Runge-Kutta's,
    which hardly errs, the share of Euler's error), integrator (0: as in the model, 1: implicit, or Euler if
    it is), iterations (0: as in the model, 1: ten times), and how commands are held."""
    down, step, count = np.array(model.opt.gravity), float(model.opt.timestep), int(model.opt.iterations)
    kinds, own = mujoco.mjtIntegrator, int(model.opt.integrator)
    exact, explicit = own == kinds.mjINT_RK4, own in (kinds.mjINT_RK4, kinds.mjINT_EULER)
    whole, axis = f"option.{attribute}", np.eye(3)[int(attribute == "tilt_y")]

    def tilt(m: Any, value: float) -> None:
        m.opt.gravity[:] = np.array(m.opt.gravity) + np.cross(axis, down) * value

    def scale(m: Any, value: float) -> None:
        m.opt.timestep = step * (1 + value)

    def err(m: Any, value: float) -> None:
        m.opt.integrator = kinds.mjINT_EULER

    def other(m: Any, value: float) -> None:
        m.opt.integrator = kinds.mjINT_IMPLICIT if explicit else kinds.mjINT_EULER

    def more(m: Any, value: float) -> None:
        m.opt.iterations = 10 * count

    made = {
        "tilt_x": Setting(whole, "rad", 0.0, tilt),
        "tilt_y": Setting(whole, "rad", 0.0, tilt),
        "timestep": Setting(whole, "1", 0.0, err if exact else scale, mixed=1.0 if exact else -0.75),
        "integrator": Setting(whole, "1", 0.0, other, stored=False, mixed=1.0),
        "iterations": Setting(whole, "1", 0.0, more, stored=False, mixed=1.0),
    } | dict.fromkeys(HELD, Setting(whole, "1", 0.0, nothing, stored=False))
    return made.get(attribute)


def _drive(model: Any, _: str, attribute: str) -> Setting | None:
    """gravity_compensation: the share of the weights of all bodies that are not free, carried by drives."""
    roots = np.asarray(model.body_rootid)
    first = np.asarray(model.body_jntadr)[roots]
    free = np.array([j >= 0 and int(model.jnt_type[j]) == FREE for j in first])
    held, own = np.flatnonzero(~free), np.array(model.body_gravcomp)

    def put(m: Any, value: float) -> None:
        m.body_gravcomp[held] = own[held] + value

    # Derived: mj_setConst counts the bodies that have it, and without any none is carried.
    made = Setting("drive.gravity_compensation", "1", 0.0, put, derived=True, stored=False)
    return made if attribute == "gravity_compensation" else None


KINDS: dict[str, tuple[Callable[[Any, str, str], Setting | None], tuple[str, ...]]] = {
    "joint": (
        _joint,
        ("damping", "frictionloss", "armature", "stiffness", "springref", "tie", *OF_FRICTION, *UNEVEN),
    ),
    "body": (_body, ("mass", "com_x", "com_y", "com_z", "payload", "length")),
    "geom": (_geom, ("friction", "torsional", "time_constant", "damping_ratio", "dmin", "size")),
    "actuator": (_actuator, ("gain", "damping", "limit", FADE)),
    "drive": (_drive, ("gravity_compensation",)),
    "option": (_option, ("tilt_x", "tilt_y", "timestep", "integrator", "iterations", *HELD)),
}


def setting_of(model: Any, name: str) -> Setting:
    """The setting of a model by its name.

    Args:
        model: A compiled MuJoCo model.
        name: `KIND:NAME.ATTRIBUTE`; `option.ATTRIBUTE` and `drive.ATTRIBUTE` of the whole model.

    Returns:
        The setting, whose nominal value is the model's.

    Raises:
        InputError: The name is unknown; the nearest known one is named.
    """
    where = f"--candidate {name}"
    head, dot, attribute = name.rpartition(".")
    kind, colon, thing = head.partition(":")
    if not dot or kind not in KINDS or bool(colon) == (kind in ("option", "drive")):
        expected = "KIND:NAME.ATTRIBUTE, such as joint:elbow.damping"
        raise InputError(where, "names nothing of the model", expected)
    if colon and thing not in (known := names_of(model, kind)):
        raise InputError(where, f"the model has no {kind} {thing}", nearest(thing, known))
    make, attributes = KINDS[kind]
    found = make(model, thing, attribute)
    if found is None:
        problem = f"{kind} has no {attribute} that can be a candidate"
        raise InputError(where, problem, nearest(attribute, attributes))
    return found


FIELDS = (
    *("dof_damping", "dof_frictionloss", "dof_armature", "jnt_stiffness", "qpos_spring"),
    *("body_mass", "body_inertia", "body_ipos", "body_pos", "body_gravcomp"),
    *("geom_friction", "geom_solref", "geom_solimp", "geom_size", "geom_rbound", "eq_solref"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"),
)  # all that settings set


@contextmanager
def changed_model(
    model: Any, settings: Mapping[str, Setting], values: Sequence[tuple[str, float]]
) -> Iterator[None]:
    """Change some settings of a model within the context."""
    if not values:
        yield
        return
    kept, opt = {name: np.array(getattr(model, name)) for name in FIELDS}, model.opt
    options = np.array(opt.gravity), opt.timestep, opt.integrator, opt.iterations
    derived = any(settings[name].derived for name, _ in values)
    try:
        for name, value in values:
            settings[name].put(model, value)
        if derived:  # what depends on it is computed anew
            mujoco.mj_setConst(model, mujoco.MjData(model))
        yield
    finally:
        for name, own in kept.items():
            getattr(model, name)[:] = own
        opt.gravity[:], opt.timestep, opt.integrator, opt.iterations = options
        if derived:
            mujoco.mj_setConst(model, mujoco.MjData(model))
