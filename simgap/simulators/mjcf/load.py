"""A MuJoCo model and its map, read and checked: the simulator, its logs, its candidates."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.units import UNITS, known_unit, unwrapped
from hmmseg.robust import bridged, white_sd
from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf import setting
from simgap.simulators.mjcf.catalogue import offered
from simgap.simulators.mjcf.engine import FREE, HINGE, JOINT, SLIDE, mujoco
from simgap.simulators.mjcf.map import POSE, Map, Mapped
from simgap.simulators.mjcf.model import MjcfSimulator, ties
from simgap.simulators.protocol import RATE, Channel, Job
from simgap.simulators.recording import Recording, held, read_recording


@dataclass(frozen=True)
class Loaded:
    """A model to compare logs with, without parameters until `effects` has seen logs; `digest`: its hash."""

    simulator: MjcfSimulator
    map: Map
    candidates: Sequence[str]
    warnings: tuple[str, ...]
    digest: bytes

    def read(self, path: Path) -> Recording:
        """Read a log in SI units, as the map says; InputError where a unit cannot be right."""
        columns = self.map.columns
        raw = read_recording(
            path, columns, self.map.clock.column, self.map.clock.size,
            [name for name, mapped in columns.items() if mapped.kind == "command"], self.simulator.acts,
        )  # fmt: skip
        values = {n: m.factor * raw[n] + m.offset for n, m in columns.items()}
        warnings = list(raw.warnings)
        for name, mapped in columns.items():
            if mapped.kind == "command":  # a drive holds it until the next
                values[name] = held(values[name])
            elif mapped.kind == "position" and _turns(self.simulator.model, mapped):
                wrapped, values[name] = values[name], unwrapped(values[name])
                if not np.array_equal(wrapped, values[name], equal_nan=True):
                    warnings.append(f"{path}: column {name} jumps by whole turns, which were taken out")
        log = raw.with_columns(values)
        for pose in self.simulator.free.values():
            log = continuous(log, [pose[a] for a in POSE[3:]])
        _check_ranges(self.simulator.model, columns, log, str(path))
        _check_goals(self.simulator, log, str(path))
        _check_travel(self.simulator, log, str(path))
        warnings += _clipped(self.simulator, log, str(path))
        return replace(log, warnings=tuple(warnings))

    def effects(self, recordings: Sequence[Recording]) -> list[RobotEffect]:
        """Candidates that need the logs: the simulator gets new parameters, and the others are returned."""
        return offered(self.simulator, recordings, self.candidates)


def load_mjcf(xml: Path, map_file: Path, candidates: Sequence[str] = ()) -> Loaded:
    """Read and check a model and its map.

    Args:
        xml: The MJCF or URDF file.
        map_file: Its map (TOML).
        candidates: Names of further settings to offer as causes.

    Returns:
        The simulator, and how logs are read for it.

    Raises:
        InputError: MuJoCo does not read the model, or the map or a candidate names what the model lacks.
    """
    if not xml.is_file():
        raise InputError(f"--mjcf {xml}", "no such file", "an MJCF or URDF file")
    if xml.suffix.lower() == ".mjb":
        raise InputError(f"--mjcf {xml}", "is compiled: no sensor can be added", "its MJCF or URDF file")
    described = Map.from_toml(map_file)
    try:
        spec = mujoco.MjSpec.from_file(str(xml))
        plain = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"--mjcf {xml}", f"MuJoCo does not read it: {error}") from None
    if not spec.actuators:
        _add_motors(spec, described.columns, str(map_file))
        plain = spec.compile()
    if not SHORTEST <= plain.opt.timestep <= 1.0:
        raise InputError(f"--mjcf {xml}: option timestep", f"found {plain.opt.timestep:g} s",
                         f"from {SHORTEST:g} to 1 s")  # fmt: skip

    def check(key: str, kind: str, name: str, known: Sequence[str]) -> None:
        if name not in known:
            raise InputError(f"{map_file}: {key}", f"the model has no {kind} {name}", nearest(name, known))

    for column, m in described.columns.items():
        check(f"columns.{column}", m.thing, m.name, setting.names_of(plain, m.thing))
        if m.thing == "joint" and int(plain.joint(m.name).type.item()) not in (HINGE, SLIDE):
            raise InputError(f"{map_file}: columns.{column}.joint", f"{m.name} is no hinge or slide",
                             "the seven columns of its body's pose")  # fmt: skip
    if described.keyframe is not None:
        check("keyframe", "keyframe", described.keyframe, setting.names_of(plain, "key"))
    for name in candidates:
        setting.setting_of(plain, name)
    for body, place in described.payload_at.items():
        check(f"payload_at.{body}", "body", body, setting.names_of(plain, "body"))
        if isinstance(place, str):
            check(f"payload_at.{body}", "site", place, setting.names_of(plain, "site"))
    address = _add_sensors(spec, described.columns)
    # Else centres of mass could not be moved in the compiled model. Only of what is simple MuJoCo leaves the
    # rotor out where it reckons how softly ties and friction hold it.
    for body in spec.bodies:
        if hasattr(body, "simple"):
            body.simple = setting.only_slides(plain, body.id)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not np.any((plain.geom_contype != 0) | (plain.geom_conaffinity != 0)):
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # an eighth of a small robot's time
    model = setting.compiled(spec)
    simulator, warnings = _simulator(model, described, str(map_file), address)
    simulator.spec = spec
    if xml.suffix.lower() == ".urdf" and not model.nu:
        warnings.append(f"{map_file}: no column drives the model, which moves freely: a URDF has no actuator")
    whole = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, whole)
    digest = hashlib.sha256(f"{mujoco.__version__} {described}".encode() + whole.tobytes()).digest()
    return Loaded(simulator, described, candidates, tuple(warnings), digest)


def _add_motors(spec: Any, columns: Mapping[str, Mapped], file: str) -> None:
    """Add to a model without actuators, such as a URDF, motors for the joints whose torque is commanded."""
    for column, m in columns.items():
        if m.thing == "sensor" or m.kind not in ("command", "force", "torque"):
            continue
        where, motor = f"{file}: columns.{column}", f'actuator = "{m.name}" and unit = "Nm" or "N"'
        if m.kind != "command":
            raise InputError(where, f"the model has no actuator to give a {m.kind}", motor)
        if spec.joint(m.name) is None:
            known = [joint.name for joint in spec.joints]
            problem = f"the model has no actuator, and no joint {m.name}"
            raise InputError(where, problem, nearest(m.name, known))
        if UNITS.get(known_unit(str(m.unit)) or "", ("",))[0] not in ("torque", "force"):
            servo = f'an MJCF with <position joint="{m.name}" kp=".." kv=".."/>, or a torque: {motor}'
            raise InputError(where, "the model has no servo to be commanded", servo)
        spec.add_actuator(name=m.name, target=m.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)


# By thing and kind: MuJoCo's sensor, and the SI units if it rotates and if it slides.
READ = {
    ("joint", "position"): ("JOINTPOS", "rad", "m"),
    ("joint", "velocity"): ("JOINTVEL", "rad/s", "m/s"),
    ("joint", "torque"): ("JOINTACTFRC", "N m", "N"),
    ("actuator", "force"): ("ACTUATORFRC", "N m", "N"),
    ("sensor", "position"): ("", "m", "m"),
    ("sensor", "velocity"): ("", "m/s", "m/s"),
    ("sensor", "force"): ("", "N", "N"),
    ("sensor", "torque"): ("", "N m", "N m"),
}


def _add_sensors(spec: Any, columns: Mapping[str, Mapped]) -> dict[str, tuple[str, int]]:
    """Add a sensor for each compared column: column -> (sensor's name, component)."""
    out: dict[str, tuple[str, int]] = {}
    for column, m in columns.items():
        if m.kind == "command":
            continue
        if m.thing == "sensor":
            axis = {"x": 0, "y": 1, "z": 2, "": 0}.get(m.axis)
            out[column] = (m.name, int(m.axis) if axis is None else axis)
            continue
        kind, what, at = READ.get((m.thing, m.kind), ("",))[0], m.thing, 0
        if m.thing in ("body", "site"):
            turning = m.axis.startswith("q")
            kind, what = "FRAMEQUAT" if turning else "FRAMEPOS", "xbody" if m.thing == "body" else "site"
            at = POSE.index(m.axis) - (3 if turning else 0)
        spec.add_sensor(
            name=f"hmmseg:{column}", type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
            objtype=getattr(mujoco.mjtObj, f"mjOBJ_{what.upper()}"), objname=m.name,
        )  # fmt: skip
        out[column] = (f"hmmseg:{column}", at)
    return out


def _simulator(
    model: Any, described: Map, file: str, address: Mapping[str, tuple[str, int]]
) -> tuple[MjcfSimulator, list[str]]:
    """The simulator without parameters, and warnings of what its columns leave open."""
    channels, sensors, joints, driven, warnings = {}, {}, {}, {}, []
    poses = dict[str, dict[str, str]]()
    for column, m in described.columns.items():
        unit = _unit(model, m)
        _check_unit(f"{file}: columns.{column}.unit", m, unit)
        channels[column] = Channel(unit, m.kind, m.sd)
        if m.kind == "command":
            driven[column] = setting.object_id(model, "actuator", m.name)
            continue
        sensor, at = address[column]
        number = setting.object_id(model, "sensor", sensor)
        if at >= model.sensor_dim[number]:
            raise InputError(f"{file}: columns.{column}.axis", f"sensor {m.name} has no {m.axis}")
        sensors[column] = int(model.sensor_adr[number]) + at
        if m.thing == "joint" and m.kind == "position":
            joints[column] = setting.object_id(model, "joint", m.name)
        if m.thing == "body":
            poses.setdefault(m.name, {})[m.axis] = column
    free = {}
    for name, pose in poses.items():
        first = int(model.body_jntadr[setting.object_id(model, "body", name)])
        if first < 0 or int(model.jnt_type[first]) != FREE:
            continue
        if len(pose) == len(POSE):
            free[first] = pose
        else:
            missing = ", ".join(a for a in POSE if a not in pose)
            warnings.append(f"{file}: the free body {name} has no column for {missing}, so that it starts as "
                            "the model has it")  # fmt: skip
    known = {*joints.values(), *(joint for joint, _, _ in ties(model, [*joints.values()]))}
    moving = np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE))).tolist()
    if unseen := [setting.name_of(model, "joint", j) or f"joint {j}" for j in moving if j not in known]:
        names = ", ".join(unseen)
        warnings.append(f"{file}: no column shows {names}, which the model moves as it runs freely")
    idle = [i for i in range(model.nu) if i not in driven.values()]
    if idle:
        names = ", ".join(setting.name_of(model, "actuator", i) or f"actuator {i}" for i in idle)
        warnings.append(f"{file}: no column drives {names}; they are left at zero or the keyframe")
    touching = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    whole = {name: pose for name, pose in poses.items() if len(pose) == len(POSE)}
    made = MjcfSimulator(model, described, channels, {}, {}, sensors, joints, driven, free, touching, whole)
    return made, warnings


def _turns(model: Any, m: Mapped) -> bool:
    """Whether a column is of a hinge, whose recorded angle may jump by whole turns."""
    return m.thing == "joint" and int(model.joint(m.name).type.item()) == HINGE


def _unit(model: Any, m: Mapped) -> str:
    """The SI unit of a column."""
    if m.kind == "command":
        what = UNITS.get(known_unit(str(m.unit)) or "", ("number",))[0]
        if what == "voltage":  # a motor is driven by it as by a duty
            return "1"
        return next(name for name, (of, size) in UNITS.items() if of == what and size == 1.0)
    if m.thing in ("body", "site"):
        return "1" if m.axis.startswith("q") else "m"
    turning = _turns(model, m)
    if m.thing == "actuator":
        turning = setting.turns(model, setting.object_id(model, "actuator", m.name))
    return READ[m.thing, m.kind][1 if turning else 2]


def _check_unit(where: str, m: Mapped, si: str) -> None:
    """InputError where a joint's, body's or site's column has a unit of another quantity."""
    given = known_unit(m.unit) if isinstance(m.unit, str) else None
    if given is None or m.thing not in ("joint", "body", "site"):
        return
    wanted = UNITS[known_unit(si) or si][0]
    if UNITS[given][0] != wanted:
        raise InputError(where, f"{m.unit!r} of a {m.kind} that is read in {si}", f"a unit of {wanted}")


SHORTEST = 1e-6  # limit: s of a solver's step; a second of it would take minutes
LATITUDE = 0.2  # limit: share of a joint's range by which logs may exceed it
FULL_TURNS = (-math.tau * 4, math.tau * 4)  # limit: rad; of a joint without a range or a unit


def _check_ranges(model: Any, columns: Mapping[str, Mapped], log: Recording, file: str) -> None:
    """InputError where angles are so large that they must be degrees; units are never guessed."""
    for column, m in columns.items():
        if m.thing != "joint" or m.kind != "position":
            continue
        joint, low, high = model.joint(m.name).id, np.nanmin(log[column]), np.nanmax(log[column])
        if m.unit is not None and not model.jnt_limited[joint]:  # such as a wheel's
            continue
        least, most = (float(v) for v in model.jnt_range[joint]) if model.jnt_limited[joint] else FULL_TURNS
        slack = LATITUDE * (most - least)
        if not (least - slack <= low and high <= most + slack):
            unit, guess = ("rad", "deg") if _turns(model, m) else ("m", "mm")
            found = f"{low:.4g} to {high:.4g} {unit}, beyond joint {m.name}'s {least:.4g} to {most:.4g}"
            raise InputError(f"{file}: column {column}", found, f'unit = "{guess}" in the map?')


def _check_goals(simulator: MjcfSimulator, log: Recording, file: str) -> None:
    """InputError where a servo's goals are its joint's in other units; units are never guessed."""
    model, seen = simulator.model, {j: c for c, j in simulator.joints.items()}
    for column, a in simulator.driven.items():
        joint, per = int(model.actuator_trnid[a, 0]), "/s" if setting.follows_rates(model, a) else ""
        servo = int(model.actuator_trntype[a]) == JOINT and (per or model.actuator_biasprm[a, 1] < 0)
        if not servo or joint not in seen:
            continue
        turning = int(model.jnt_type[joint]) == HINGE
        factors = (
            ((math.degrees(1), "deg"), (math.radians(1), "rad")) if turning else ((1e3, "mm"), (1e-3, "m"))
        )
        way = f"{'rad' if turning else 'm'}{per}"
        goal, there = log[column], seen[joint]
        angle = np.gradient(log[there], log.t) if per else log[there]
        angle = angle * float(model.actuator_gear[a, 0])
        both = np.isfinite(goal) & np.isfinite(angle)
        if not both.any() or not np.any(angle[both]):
            continue
        times = float(goal[both] @ angle[both] / (angle[both] @ angle[both]))
        for factor, unit in factors:
            if abs(math.log(max(times, 1e-9) / factor)) < SAME:
                ends = f"{np.nanmin(goal):.4g} to {np.nanmax(goal):.4g} {way}"
                shown = f"{np.nanmin(angle):.4g} to {np.nanmax(angle):.4g} {way} of column {there}"
                mend = f'unit = "{unit}{per}" of {column} in the map?'
                raise InputError(f"{file}: column {column}", f"{ends}, and its joint is at {shown}", mend)


PIECE = 0.4  # numerics: s that a model is run under a log's commands to see how far it moves
TIMES = 100.0  # limit: how many times as far as its log a slide may move in a model


def _check_travel(simulator: MjcfSimulator, log: Recording, file: str) -> None:
    """InputError where a slide without a range moves so unlike the model that the unit must be another."""
    model = simulator.model
    slides = {c: j for c, j in simulator.joints.items() if int(model.jnt_type[j]) == SLIDE}
    slides = {c: j for c, j in slides.items() if not model.jnt_limited[j]}
    size = max(3, round(PIECE / max(float(np.median(np.diff(log.t))), 1e-9)))
    pieces = [log.window(a, a + size) for a in range(0, len(log) - size, size)]
    if not slides or not simulator.driven or not pieces:
        return
    whole = {n: bridged(log[n]) for n in simulator.states}
    begun = [{n: float(v[p.first]) for n, v in whole.items()} for p in pieces]
    jobs = [Job({}, p, {**b, **{n + RATE: 0.0 for n in b}}) for p, b in zip(pieces, begun, strict=True)]
    runs = [(p, run) for p, run in zip(pieces, simulator.simulate_many(jobs), strict=True) if run is not None]
    for column, joint in slides.items() if runs else ():
        pairs = [(whole[column][p.first : p.first + size], run[column]) for p, run in runs]
        seen, made = (np.concatenate([v - v[0] for v in each]) for each in zip(*pairs, strict=True))
        noise = white_sd(whole[column], 2)
        far, model_far = (float(np.sqrt(np.mean(v**2))) for v in (seen, made))
        for less, more, unit in ((far, model_far, "m"), (model_far, far, "mm")):
            if more > TIMES * less and far > 10 * noise and seen @ made > 0:
                name = setting.name_of(model, "joint", joint)
                found = f"moves {far:.2g} m in {PIECE:g} s, and joint {name}"
                found = f"{found} of the model {model_far:.2g} m under the same commands"
                raise InputError(f"{file}: column {column}", found, f'unit = "{unit}" in the map?')


SAME = math.log(2.0)  # limit: logarithm of the factor by which a servo may miss its goals


def _clipped(simulator: MjcfSimulator, log: Recording, file: str) -> list[str]:
    """Warnings of commands that the model clips."""
    model, out = simulator.model, []
    for column, a in simulator.driven.items():
        low, high = model.actuator_ctrlrange[a] if model.actuator_ctrllimited[a] else (-np.inf, np.inf)
        share = float(np.mean((log[column] < low) | (log[column] > high)))
        if share > 0:
            ends = f"{np.nanmin(log[column]):.4g} to {np.nanmax(log[column]):.4g}"
            out.append(f"{file}: column {column} goes from {ends}, beyond its actuator's ctrlrange {low:.4g} "
                       f"to {high:.4g}, where the model clips it ({100 * share:.2g} % of samples)"
                       )  # fmt: skip
    return out


def continuous(log: Recording, turn: Sequence[str]) -> Recording:
    """Quaternion columns whose signs do not jump: q and -q are the same rotation."""
    quat = np.array([held(log[n]) for n in turn])
    dot = np.nansum(quat[:, 1:] * quat[:, :-1], 0)
    sign = np.cumprod(np.concatenate([[1.0], np.where(dot < 0, -1.0, 1.0)]))
    return log.with_columns({n: sign * log[n] for n in turn})
