"""What a MuJoCo model offers as causes: its joints, bodies, contacts, actuators and its own options.

Usual sizes are shares of what the robot shows along the logs; torques are from inverse dynamics of the
smoothed motion.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from simgap.effect import Parameter
from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf.engine import HINGE, JOINT, SLIDE, mujoco
from simgap.simulators.mjcf.model import MjcfSimulator, tied
from simgap.simulators.mjcf.play import played
from simgap.simulators.mjcf.runs import Runs
from simgap.simulators.mjcf.setting import (
    FADE,
    HOLD,
    LATE,
    SMOOTH,
    Setting,
    most_of,
    name_of,
    nothing,
    object_id,
    only_slides,
    payload,
    payload_place,
    setting_of,
    strength_of,
)
from simgap.simulators.mjcf.transmission import SHARE, Motion, elasticity, motion_of, periods, sizes_of
from simgap.simulators.recording import Recording

GAP = 0.02  # prior: share of a joint's reach: the usual play
SIZE = 0.1  # prior: share of a stated value: the usual size of its error
GEOMS = 4  # chosen: geoms whose contact is offered, those that touch most


def offered(
    simulator: MjcfSimulator, recordings: Sequence[Recording], named: Sequence[str]
) -> list[RobotEffect]:
    """Set the simulator's parameters, and return the candidates beyond them."""
    motions = [motion_of(simulator, log) for log in recordings]
    catalogue = _Catalogue(simulator)
    m, read = simulator.model, simulator.joints.values()
    moving = [j for j in range(m.njnt) if int(m.jnt_type[j]) in (HINGE, SLIDE) and name_of(m, "joint", j)]
    joints = [j for j in moving if j in read]
    catalogue.add_joints(moving, motions)
    catalogue.add_ties()
    catalogue.add_actuators()
    catalogue.add_bodies(moving)
    catalogue.add_options()
    catalogue.add_contacts(recordings)
    catalogue.add_named(named)
    simulator.parameters, simulator.settings = catalogue.parameters, catalogue.settings
    simulator.says = catalogue.says
    catalogue.add_play(joints, motions, {log.name: log for log in recordings})
    simulator.__post_init__()
    simulator.prepare(recordings)
    return elasticity(simulator, recordings, motions, joints)


class _Catalogue:
    """Parameters, their settings in the model and their descriptions, gathered one after another."""

    def __init__(self, simulator: MjcfSimulator) -> None:
        self.simulator, self.model = simulator, simulator.model
        self.parameters: dict[str, Parameter] = {}
        self.settings: dict[str, Setting] = {}
        self.says: dict[str, str] = {}

    def add(self, name: str, sd: float, says: str = "", low: float = -np.inf, high: float = np.inf,
            effect: str | None = None, setting: Setting | None = None) -> None:  # fmt: skip
        """Add a parameter about the model's value, unless its size is zero; an effect may have several."""
        setting = setting_of(self.model, name) if setting is None else setting
        nominal = setting.nominal
        if not sd > 0 or not np.isfinite(sd):
            return
        self.settings[name] = setting
        self.parameters[name] = Parameter(nominal, float(sd), setting.unit, min(low, nominal), high, effect)
        self.says[effect or name] = says or f"{name} is not as the model has it"

    def add_joints(self, joints: Sequence[int], motions: Sequence[Motion]) -> None:
        """Friction, rotor inertia and stiffness of joints; friction by load, speed, direction; and drag."""
        for j in joints:
            name, size = name_of(self.model, "joint", j), sizes_of(motions, j)
            head, torque, rate = f"joint:{name}", SHARE * size.torque, size.rate
            for attribute, sd, low, what in (
                ("damping", torque / rate, 0.0, "viscous friction of {}"),
                ("frictionloss", torque, 0.0, "Coulomb friction of {}"),
                ("armature", torque / size.acceleration, 0.0, "rotor inertia of {}"),
                ("stiffness", torque / size.reach, 0.0, "stiffness of a spring or cable of {}"),
                ("load_friction", SHARE, 0.0, "friction of {} in proportion to the torque transmitted"),
                ("direction_friction", torque, -np.inf, "friction of {} larger one way than the other"),
                ("quadratic_drag", torque / rate**2, 0.0, "drag on {} in proportion to the rate's square"),
            ):
                setting = setting_of(self.model, f"{head}.{attribute}")
                self.add(setting.name, max(sd, SIZE * abs(setting.nominal)), what.format(name), low)
            says = f"friction of {name} larger near standstill, by extra exp(-(rate / speed)^2)"
            self.add(f"{head}.stribeck_extra", torque, says, low=0.0, effect=f"{head}.stribeck")
            speed = replace(setting_of(self.model, f"{head}.stribeck_speed"), nominal=0.3 * rate)
            self.add(speed.name, 0.1 * rate, says, 0.03 * rate, effect=f"{head}.stribeck", setting=speed)

            for law, scaled, what in (
                ("cogging", False, "a torque on {} that comes and goes around the turn"),
                ("ripple", True, "a motor of {} whose strength comes and goes around the turn"),
            ):
                seen = int(self.model.jnt_type[j]) == HINGE and j in self.simulator.joints.values()
                often = periods(motions, j, scaled) if seen else 0.0
                if not often:
                    continue
                says, effect = what.format(name), f"{head}.{law}"
                for part in ("cos", "sin"):
                    self.add(f"{effect}_{part}", SHARE if scaled else torque, says, effect=effect)
                wave = replace(setting_of(self.model, f"{effect}_per_turn"), nominal=often)
                near = np.pi / float(np.ptp(np.concatenate([m.position[j] for m in motions])))
                self.add(wave.name, 0.5 * near, says, often - near, often + near, effect, wave)

    def add_ties(self) -> None:
        """How softly joints follow those they are tied to: by default softer than any linkage."""
        m = self.model
        for k in tied(m):
            name, soft = name_of(m, "joint", int(m.eq_obj1id[k])), float(m.eq_solref[k, 0])
            if name and soft > 0:
                says = f"how softly {name} follows the joint that it is tied to"
                self.add(f"joint:{name}.tie", SIZE * soft, says, low=2 * float(m.opt.timestep))

    def add_actuators(self) -> None:
        """Gain, velocity gain, fading and saturation of actuators that a log drives."""
        m = self.model
        for a in sorted({*self.simulator.driven.values()}):
            name, head = name_of(m, "actuator", a), f"actuator:{name_of(m, 'actuator', a)}"
            if np.any(m.actuator_gainprm[a, strength_of(m, a)]):
                says = f"gain of {name} (of a servo, how stiffly it follows)"
                self.add(f"{head}.gain", SIZE, says, low=-0.9)
            if m.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
                sd = SIZE * abs(float(m.actuator_biasprm[a, 2]))
                self.add(f"{head}.damping", sd, f"velocity gain of {name}", low=0.0)
            if most_of(m, a) and int(m.actuator_trntype[a]) == JOINT:
                says = f"{name} falls behind in proportion to its force, by this share at its most"
                self.add(f"{head}.{FADE}", SIZE, says, low=-0.9, high=0.9)
            if m.actuator_forcelimited[a]:
                sd = SIZE * float(m.actuator_forcerange[a, 1])
                self.add(f"{head}.limit", sd, f"saturation of {name}", low=1e-9)

    def add_bodies(self, joints: Sequence[int]) -> None:
        """Mass, centre of mass, payload and link length of bodies with joints, and of tools fixed to them."""
        m = self.model
        for b in sorted({int(m.jnt_bodyid[j]) for j in (*joints, *self.simulator.free)}):
            name = name_of(m, "body", b)
            if not name or m.body_mass[b] <= 0:
                continue
            self._add_mass(b)
            if not any(m.body_jntnum[c] for c in range(1, m.nbody) if m.body_parentid[c] == b):
                tool = self._tool(b)
                if tool != b:
                    self._add_mass(tool)
                self._add_payload(name if name in self.simulator.map.payload_at else name_of(m, "body", tool))
            first = int(m.body_jntadr[b])
            chained = m.body_jntnum[b] and int(m.jnt_type[first]) in (HINGE, SLIDE) and m.body_parentid[b]
            if chained and np.linalg.norm(m.body_pos[b]) > 1e-6:
                self.add(f"body:{name}.length", 0.01, f"length of the link before {name}", low=-0.5)

    def _add_mass(self, body: int) -> None:
        """A body's mass and centre of mass."""
        m, name = self.model, name_of(self.model, "body", body)
        mass, centre = float(m.body_mass[body]), f"body:{name}.com"
        self.add(f"body:{name}.mass", SIZE * mass, f"mass (and inertia) of {name}", low=1e-3 * mass)
        gyration = float(np.sqrt(m.body_inertia[body].sum() / mass))
        for axis in "" if only_slides(m, body) else "xyz":
            self.add(f"{centre}_{axis}", SIZE * gyration, f"centre of mass of {name}", effect=centre)

    def _tool(self, body: int) -> int:
        """Of a body and those fixed to it the farthest, which a sensor in the wrist feels."""
        m, data = self.model, mujoco.MjData(self.model)
        mujoco.mj_kinematics(m, data)
        fixed = np.flatnonzero((np.asarray(m.body_weldid) == body) & (np.asarray(m.body_mass) > 0))
        named = [b for b in fixed.tolist() if name_of(m, "body", b)]
        return max(named, key=lambda b: float(np.linalg.norm(data.xpos[b] - data.xpos[body])))

    def _add_payload(self, body: str) -> None:
        """A load where the map says, or where one is likely."""
        m, stated = self.model, self.simulator.map.payload_at.get(body)
        at = payload_place(m, body)
        if isinstance(stated, str):
            at = m.site_pos[object_id(m, "site", stated)]
        elif stated is not None:
            at = np.array(stated)
        where = ", ".join(f"{1e3 * x:.0f}" for x in at)
        setting, says = payload(m, body, np.array(at)), f"a load on {body}, at {where} mm in its frame"
        self.add(setting.name, SIZE * float(np.max(m.body_mass[1:])), says, low=0.0, setting=setting)

    def add_play(
        self, joints: Sequence[int], motions: Sequence[Motion], logs: Mapping[str, Recording]
    ) -> None:
        """Play between motors and the joints that they move."""
        m, simulator, wanted, made = self.model, self.simulator, tuple(self.settings), {}
        for column, a in simulator.driven.items():
            j = int(m.actuator_trnid[a, 0])
            alone = np.sum((m.actuator_trnid[:, 0] == j) & (m.actuator_trntype == JOINT)) == 1
            if j not in joints or int(m.actuator_trntype[a]) != JOINT or not alone:
                continue
            name = name_of(m, "joint", j)

            def runs(model: Any) -> Runs:
                data = [mujoco.MjData(model) for _ in range(simulator.threads)]
                columns = simulator.channels, simulator.sensor, simulator.driven, simulator.free
                return Runs(model, data, *columns)

            names = name, name_of(m, "actuator", a)
            found = played(simulator.spec.copy(), *names, runs, wanted, logs, simulator.joints)
            if found is None:
                continue
            unit = "rad" if int(m.jnt_type[j]) == HINGE else "m"
            effect = f"command:{column}.backlash"
            made[found.width] = found
            sd = GAP * sizes_of(motions, j).reach
            self.parameters[found.width] = Parameter(0.0, sd, unit, low=0.0, effect=effect)
            self.settings[found.width] = Setting(found.width, unit, 0.0, nothing, stored=False)
            self.says[effect] = f"play between motor and {name}"
        simulator.played = made

    def add_options(self) -> None:
        """Gravity's direction, and the simulation's step, solver and holding of commands."""
        if np.linalg.norm(self.model.opt.gravity) > 0:
            says = "drives carry this share of the weights by themselves (gravity compensation)"
            self.add("drive.gravity_compensation", 0.1, says, low=-0.5, high=1.5)
            for axis in ("tilt_x", "tilt_y"):
                self.add(f"option.{axis}", 0.01, "the base is tilted", effect="gravity.direction")
        says = "the simulator's own time step, relative"
        self.add("option.timestep", 0.5, says, low=-1.1, high=1.0)
        says = "the simulator's integrator: implicit, or Euler's if it is"
        self.add("option.integrator", 0.5, says, low=0.0, high=1.0)
        if self.simulator.driven:
            # What comes half a sample later than in steps is a delay like any other, and reported as one.
            says = "commands between samples: in steps (0), in lines (1, half a sample sooner)"
            self.add(HOLD, 0.5, says, low=0.0, high=1.0)
            # Without it lines would do for whatever smooths commands, and be half a sample sooner for it.
            # Below zero are curves, which lie off their chords by a twelfth of the second difference.
            says = "commands smoothed by what carries them out: this share is from the neighbours' mean"
            self.add(SMOOTH, 0.25, says, low=-1 / 6, high=0.5)
            says = "commands come later within the simulator's step, by this share of it"
            self.add(LATE, 0.25, says, low=-0.5, high=0.5)
        if self.simulator.touching:
            says = "iterations of the simulator's solver: ten times as many"
            self.add("option.iterations", 0.3, says, low=0.0, high=1.0)

    def add_contacts(self, recordings: Sequence[Recording]) -> None:
        """Friction, stiffness, damping and size of geoms that touch."""
        m = self.model
        for g in _touching(self.simulator, recordings):
            name = name_of(m, "geom", g)
            if not name:
                continue
            friction = max(float(m.geom_friction[g, 0]), 0.1)
            self.add(f"geom:{name}.friction", SIZE * friction, f"friction of {name}", low=0.0)
            soft, says = f"geom:{name}.stiffness", f"stiffness and damping of {name}'s contact"
            sd = SIZE * float(m.geom_solref[g, 0])
            self.add(f"geom:{name}.time_constant", sd, says, low=1e-4, effect=soft)
            self.add(f"geom:{name}.damping_ratio", 2 * SIZE, says, low=0.05, effect=soft)
            self.add(f"geom:{name}.size", 0.01, f"size of {name}", low=-0.5)

    def add_named(self, named: Sequence[str]) -> None:
        """Settings that the user names beyond these."""
        for name in named:
            if name not in self.parameters:
                nominal = setting_of(self.model, name).nominal
                self.add(name, SIZE * abs(nominal) if nominal else 0.01)


def _touching(simulator: MjcfSimulator, recordings: Sequence[Recording]) -> list[int]:
    """The geoms that touch most along the recorded motion, those of moving bodies first."""
    if not simulator.touching:
        return []
    count = Counter(g for log in recordings for pairs in simulator.touched(log) for p in pairs for g in p)
    moving = {int(simulator.model.jnt_bodyid[j]) for j in (*simulator.free, *simulator.joints.values())}
    ranked = sorted(count, key=lambda g: (int(simulator.model.geom_bodyid[g]) not in moving, -count[g]))
    return ranked[:GEOMS]
