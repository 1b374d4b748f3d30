"""A MuJoCo model and a map, read and checked: the simulator, how to read logs, candidates."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.units import UNITS, known_unit, unwrapped
from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf.map import Map, Mapped, read_map
from simgap.simulators.protocol import Channel
from simgap.simulators.recording import Recording, held, read_recording


@dataclass(frozen=True)
class Loaded:
    """A model to compare logs with. `simulator` has no parameters until `effects` has seen logs; `digest`:
    a hash of model and map."""

    simulator: Any
    map: Map
    candidates: Sequence[str]
    warnings: tuple[str, ...]
    digest: bytes

    def read(self, path: Path) -> Recording:
        """A log in SI, as the map has it; InputError where a unit cannot be."""
        columns = self.map.columns
        raw = read_recording(
            path, columns, self.map.time, self.map.time_factor,
            [name for name, mapped in columns.items() if mapped.kind == "command"], self.simulator.acts,
        )  # fmt: skip
        values = {n: m.factor * raw[n] + m.offset for n, m in columns.items()}
        told = list(raw.warnings)
        for name, mapped in columns.items():
            if mapped.kind == "command":  # a drive holds it until the next
                values[name] = held(values[name])
            elif mapped.thing == "joint" and mapped.kind == "position" and self.turns(mapped.name):
                wrapped, values[name] = values[name], unwrapped(values[name])
                if not np.array_equal(wrapped, values[name], equal_nan=True):
                    told.append(f"{path}: column {name} jumps by whole turns, which were taken out")
        log = raw.with_columns(values)
        for pose in self.simulator.free.values():
            log = continuous(log, [pose[a] for a in ("qw", "qx", "qy", "qz")])
        _check_ranges(self.simulator.model, columns, log, str(path))
        _check_goals(self.simulator, log, str(path))
        told += _clipped(self.simulator, log, str(path))
        return replace(log, warnings=tuple(told))

    def turns(self, joint: str) -> bool:
        """Whether a joint is a hinge, whose angle may be recorded with jumps by whole turns."""
        from simgap.simulators.mjcf.engine import mujoco

        kind = self.simulator.model.joint(joint).type.item()
        return kind == int(mujoco.mjtJoint.mjJNT_HINGE)

    def effects(self, recordings: Sequence[Recording]) -> list[RobotEffect]:
        """Candidates that need the model: those it can set become its parameters, the rest are given."""
        from simgap.simulators.mjcf.catalogue import offered

        return offered(self.simulator, recordings, self.candidates)


def load_mjcf(xml: Path, map_file: Path, candidates: Sequence[str] = ()) -> Loaded:
    """Read and check a model and its map; InputError names the file and the column or thing at fault."""
    try:
        from simgap.simulators.mjcf.engine import mujoco
    except ImportError:
        raise InputError("--mjcf", "needs MuJoCo", 'pip install "hmmseg[mujoco]"') from None
    if mujoco.__version__ == "4.0.0":
        raise InputError("--mjcf", "MuJoCo 4.0.0 has a solver bug", "another version from 3 on")
    if not xml.is_file():
        raise InputError(f"--mjcf {xml}", "no such file", "an MJCF or URDF file")
    if xml.suffix.lower() == ".mjb":
        raise InputError(f"--mjcf {xml}", "is compiled: no sensor can be added", "its MJCF or URDF file")
    described = read_map(map_file)
    try:
        spec = mujoco.MjSpec.from_file(str(xml))
        plain = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"--mjcf {xml}", f"MuJoCo does not read it: {str(error).splitlines()[0]}") from None
    if not SHORTEST <= plain.opt.timestep <= 1.0:
        raise InputError(f"--mjcf {xml}: option timestep", f"found {plain.opt.timestep:g} s",
                         f"from {SHORTEST:g} to 1 s")  # fmt: skip
    from simgap.simulators.mjcf.setting import names_of, setting_of

    for column in described.columns.values():
        known = names_of(plain, column.thing)
        if column.name not in known:
            raise InputError(
                f"{map_file}: columns.{column.column}",
                f"the model has no {column.thing} {column.name}",
                nearest(column.name, known),
            )
    if described.keyframe is not None:
        keys = [plain.key(i).name for i in range(plain.nkey)]
        if described.keyframe not in keys:
            raise InputError(
                f"{map_file}: keyframe",
                f"the model has no {described.keyframe}",
                nearest(described.keyframe, keys),
            )
    for name in candidates:
        setting_of(plain, name)
    for body, place in described.payload_at.items():
        for kind, one in (("body", body), *((("site", place),) if isinstance(place, str) else ())):
            if one not in names_of(plain, kind):
                known = nearest(one, names_of(plain, kind))
                raise InputError(f"{map_file}: payload_at.{body}", f"the model has no {kind} {one}", known)
    address = _add_sensors(mujoco, spec, described.columns)
    for body in spec.bodies:  # else centres of mass could not be moved in the compiled model
        if hasattr(body, "simple"):
            body.simple = False
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    simulator, warnings = _simulator(mujoco, model, described, address)
    simulator.spec = spec
    whole = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, whole)
    digest = hashlib.sha256(f"{mujoco.__version__} {described}".encode() + whole.tobytes()).digest()
    return Loaded(simulator, described, candidates, tuple(warnings), digest)


def _add_sensors(mujoco: Any, spec: Any, columns: Mapping[str, Mapped]) -> dict[str, tuple[str, int]]:
    """A sensor for each compared column: column -> (sensor's name, component)."""
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    made = {
        ("joint", "position"): (kinds.mjSENS_JOINTPOS, objects.mjOBJ_JOINT),
        ("joint", "velocity"): (kinds.mjSENS_JOINTVEL, objects.mjOBJ_JOINT),
        ("joint", "torque"): (kinds.mjSENS_JOINTACTFRC, objects.mjOBJ_JOINT),
        ("actuator", "force"): (kinds.mjSENS_ACTUATORFRC, objects.mjOBJ_ACTUATOR),
    }
    out: dict[str, tuple[str, int]] = {}
    for column in columns.values():
        if column.kind == "command":
            continue
        if column.thing == "sensor":
            axis = {"x": 0, "y": 1, "z": 2, "": 0}.get(column.axis)
            out[column.column] = (column.name, int(column.axis) if axis is None else axis)
            continue
        name = f"hmmseg:{column.column}"
        if column.thing in ("body", "site"):
            turning = column.axis.startswith("q")
            what = objects.mjOBJ_XBODY if column.thing == "body" else objects.mjOBJ_SITE
            spec.add_sensor(
                name=name,
                type=kinds.mjSENS_FRAMEQUAT if turning else kinds.mjSENS_FRAMEPOS,
                objtype=what,
                objname=column.name,
            )
            at = ("qw", "qx", "qy", "qz").index(column.axis) if turning else "xyz".index(column.axis)
            out[column.column] = (name, at)
        else:
            kind, what = made[column.thing, column.kind]
            spec.add_sensor(name=name, type=kind, objtype=what, objname=column.name)
            out[column.column] = (name, 0)
    return out


def _simulator(mujoco: Any, model: Any, described: Map, address: Mapping[str, tuple[str, int]]):
    from simgap.simulators.mjcf.model import MjcfSimulator

    identity = lambda kind, name: mujoco.mj_name2id(model, kind, name)  # noqa: E731
    objects = mujoco.mjtObj
    channels, sensors, joints, driven, poses, warnings = {}, {}, {}, {}, {}, []
    for column in described.columns.values():
        unit = _unit(mujoco, model, column)
        _check_unit(described, column, unit)
        channels[column.column] = Channel(unit, column.kind, column.noise)
        if column.kind == "command":
            driven[column.column] = identity(objects.mjOBJ_ACTUATOR, column.name)
            continue
        sensor, at = address[column.column]
        number = identity(objects.mjOBJ_SENSOR, sensor)
        if at >= model.sensor_dim[number]:
            raise InputError(
                f"{described.file}: columns.{column.column}.axis",
                f"sensor {column.name} has no {column.axis}",
            )
        sensors[column.column] = int(model.sensor_adr[number]) + at
        if column.thing == "joint" and column.kind == "position":
            joint = identity(objects.mjOBJ_JOINT, column.name)
            if int(model.jnt_type[joint]) not in (
                int(mujoco.mjtJoint.mjJNT_HINGE),
                int(mujoco.mjtJoint.mjJNT_SLIDE),
            ):
                raise InputError(
                    f"{described.file}: columns.{column.column}.joint",
                    f"{column.name} is no hinge or slide",
                    "the seven columns of its body's pose",
                )
            joints[column.column] = joint
        if column.thing == "body":
            poses.setdefault(column.name, {})[column.axis] = column.column
    free = {}
    for name, pose in poses.items():
        body = identity(objects.mjOBJ_BODY, name)
        first = int(model.body_jntadr[body])
        if first < 0 or int(model.jnt_type[first]) != int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        missing = [a for a in ("x", "y", "z", "qw", "qx", "qy", "qz") if a not in pose]
        if missing:
            warnings.append(
                f"{described.file}: the free body {name} has no column for {', '.join(missing)}, so that "
                "it starts as the model has it"
            )
        else:
            free[first] = pose
    untold = [n for n in _commands_untold(mujoco, model, driven)]
    if untold:
        warnings.append(
            f"{described.file}: no column drives {', '.join(untold)}; they are left at zero or the keyframe"
        )
    touching = bool(np.any((model.geom_contype != 0) | (model.geom_conaffinity != 0))) and not (
        model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    whole = {name: pose for name, pose in poses.items() if len(pose) == 7}
    made = MjcfSimulator(model, described, channels, {}, {}, sensors, joints, driven, free, touching, whole)
    return made, warnings


def _commands_untold(mujoco: Any, model: Any, driven: Mapping[str, int]) -> list[str]:
    driven_names = set(driven.values())
    return [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) or f"actuator {i}"
        for i in range(model.nu)
        if i not in driven_names
    ]


def _unit(mujoco: Any, model: Any, column: Mapped) -> str:
    """The SI unit of a column as the model has it."""
    if column.thing == "joint":
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, column.name)
        turning = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        return {
            "position": "rad" if turning else "m",
            "velocity": "rad/s" if turning else "m/s",
            "torque": "N m" if turning else "N",
        }[column.kind]
    if column.thing == "actuator":
        return "N m" if column.kind == "force" else "1" if column.unit is None else column.unit
    if column.thing in ("body", "site"):
        return "1" if column.axis.startswith("q") else "m"
    return {"position": "m", "velocity": "m/s", "force": "N", "torque": "N m"}[column.kind]


def _check_unit(described: Map, column: Mapped, si: str) -> None:
    """InputError where a joint's, body's or site's column has the unit of something else."""
    given = None if not isinstance(column.unit, str) else known_unit(column.unit)
    if given is None or column.thing not in ("joint", "body", "site"):
        return
    wanted = UNITS[known_unit(si) or si][0]
    if UNITS[given][0] != wanted:
        raise InputError(
            f"{described.file}: columns.{column.column}.unit",
            f"{column.unit!r} of a {column.kind} that is read in {si}",
            f"a unit of {wanted}",
        )


SHORTEST = 1e-6  # limit: s of a solver's step; a second of it would take minutes
LATITUDE = 0.2  # limit: share of a joint's range by which a log may exceed it


def _check_ranges(model: Any, columns: Mapping[str, Mapped], log: Recording, file: str) -> None:
    """InputError where angles are so large that they must be degrees, never guessed."""
    from simgap.simulators.mjcf.engine import mujoco

    for column in columns.values():
        if column.thing != "joint" or column.kind != "position":
            continue
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, column.name)
        turning = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        values = log[column.column]
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        limited = bool(model.jnt_limited[joint])
        reach = (
            (float(model.jnt_range[joint][0]), float(model.jnt_range[joint][1]))
            if limited
            else (-math.tau * 4, math.tau * 4)
        )
        slack = LATITUDE * (reach[1] - reach[0])
        if reach[0] - slack <= low and high <= reach[1] + slack:
            continue
        unit = "rad" if turning else "m"
        guess = 'unit = "deg" in the map?' if turning else 'unit = "mm" in the map?'
        raise InputError(
            f"{file}: column {column.column}",
            f"{low:.4g} to {high:.4g} {unit}, beyond joint {column.name}'s {reach[0]:.4g} to {reach[1]:.4g}",
            guess,
        )


def _check_goals(simulator: Any, log: Recording, file: str) -> None:
    """InputError where a servo's goals are its joint's angles in other units, never guessed."""
    from simgap.simulators.mjcf.engine import mujoco

    model, seen = simulator.model, {j: c for c, j in simulator.joints.items()}
    for column, a in simulator.driven.items():
        joint = int(model.actuator_trnid[a, 0])
        servo = model.actuator_biasprm[a, 1] < 0 and joint in seen
        if not servo or int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_HINGE):
            continue
        goal, angle = log[column], log[seen[joint]]
        both = np.isfinite(goal) & np.isfinite(angle)
        if not both.any() or not np.any(angle[both]):
            continue
        times = float(goal[both] @ angle[both] / (angle[both] @ angle[both]))
        for factor, unit in ((math.degrees(1), "deg"), (math.radians(1), "rad")):
            if abs(math.log(max(times, 1e-9) / factor)) < SAME:
                ends = f"{np.nanmin(goal):.4g} to {np.nanmax(goal):.4g} rad"
                there = f"{np.nanmin(angle):.4g} to {np.nanmax(angle):.4g} rad"
                found = f"{ends}, and its joint is at {there} of column {seen[joint]}"
                raise InputError(
                    f"{file}: column {column}", found, f'unit = "{unit}" of {column} in the map?'
                )


SAME = math.log(2.0)  # limit: a servo that follows its goals at less or more than this factor follows none


def _clipped(simulator: Any, log: Recording, file: str) -> list[str]:
    """The warning about commands that the model clips."""
    model, out = simulator.model, []
    for column, a in simulator.driven.items():
        if model.actuator_ctrllimited[a]:
            low, high = (float(v) for v in model.actuator_ctrlrange[a])
            share = float(np.mean((log[column] < low) | (log[column] > high)))
            if share > 0:
                ends = f"{np.nanmin(log[column]):.4g} to {np.nanmax(log[column]):.4g}"
                out.append(
                    f"{file}: column {column} goes from {ends}, beyond its actuator's ctrlrange {low:.4g} to "
                    f"{high:.4g}, where the model clips it ({100 * share:.2g} % of samples)"
                )
    return out


def continuous(log: Recording, turn: Sequence[str]) -> Recording:
    """Quaternion columns with signs that do not jump: q and -q are the same turn."""
    quat = np.array([log[n] for n in turn])
    dot = np.nansum(quat[:, 1:] * quat[:, :-1], 0)
    sign = np.cumprod(np.concatenate([[1.0], np.where(dot < 0, -1.0, 1.0)]))
    return log.with_columns({n: sign * log[n] for n in turn})
