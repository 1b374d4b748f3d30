"""The second simulator's world: blocks, table, two padded fingers, written for MuJoCo, and tasks.

Planar: x right, z up (y of the recordings). A block slides in x and z and turns; it stands on its lower
corners, small spheres set in by the chamfer, and bears what stands on it by its upper ones. A finger is a
carriage with a servo; its pad is a flat tip on two spring-dampers and a hinge, which meets a block by
MuJoCo's own contact at its upper and lower end. Contacts are stiff: what they yield lies far below the
sensors' noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

STEP = 0.00025  # s; at twice that, a stiff pad that can turn chatters through a whole carry
TIP, TIP_MASS = 0.003, 0.01  # m, kg; the pad's inertia is taken out of what it feels
PAD = 0.003  # m from the middle of a pad to its upper and lower end
PAD_INERTIA = 2e-6  # kg m^2; lighter pads would want shorter steps
DAMPING = 2.0  # N s/m of a pad
CONTACT = 'solref="0.002 1" solimp="0.9995 0.9999 0.0001"'
GRAVITY = 9.80665
PIVOT = 0.125  # m; about where the stacks stand
FEET = {"box": (0.0004, 0.0), "chamfered": (0.0008, 0.0015), "round": (0.0015, 0.004)}  # m: radius, set in


@dataclass(frozen=True)
class Block:
    """A block: weight [N], width and height [m], friction against what it stands on."""

    weight: float
    width: float
    height: float
    friction: float


@dataclass(frozen=True)
class World:
    """All that surrounds the fingers. Pads [N/m], of which each finger's differ by the shares `uneven`;
    `exponent` 1 is a linear pad, whose force at `reference` [N] is the same; a Maxwell arm of
    `creep_ratio` times the pad and `creep_time` [s]; `pad_friction`; `pad_turning` [N m/rad]; `feet`;
    table's `tilt` [rad] and `table_stiffness` [N/m]; `mass_offset` [m]; `cable` (N/m, x0, y0 [m]) and
    `drag` [N s/m] on each finger; whether pads can meet the `table` as well.
    """

    normal_stiffness: float
    shear_stiffness: float
    uneven: tuple[float, float] = (0.0, 0.0)
    exponent: float = 1.0
    reference: float = 2.5
    creep_ratio: float = 0.0
    creep_time: float = 1.0
    pad_friction: float = 1.2
    pad_turning: float = 2.0
    feet: str = "box"
    tilt: float = 0.0
    table_stiffness: float = float("inf")
    mass_offset: float = 0.0
    cable: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 0.0

    def pads(self) -> tuple[float, float, float, float]:
        """Stiffnesses [N/m]: normal and shear of finger 1, then of finger 2."""
        a, b = (1 + e for e in self.uneven)
        n, s = self.normal_stiffness, self.shear_stiffness
        return (n * a, s * a, n * b, s * b)


@dataclass(frozen=True)
class Servo:
    """A finger's moving mass [kg], stiffness [N/m] and damping [N s/m] of its position control."""

    mass: float
    stiffness: float
    damping: float


def mjcf(
    blocks: Mapping[str, Block],
    centres: Mapping[str, tuple[float, float]],
    start: tuple[float, float, float, float],
    world: World,
    servos: tuple[Servo, Servo],
) -> str:
    """MJCF of the world with blocks at `centres` and tips at `start` (x1, y1, x2, y2) [m]."""
    names = list(blocks)
    bodies = [_table(world), *(_block(n, blocks[n], centres[n], world) for n in names)]
    bodies += [_finger(i, start[2 * i : 2 * i + 2], world, servos[i]) for i in (0, 1)]
    pairs = []
    for n in names:
        rubs = blocks[n].friction
        pairs += [_pair(f"foot{k}_{n}", "table", rubs) for k in (1, 2)]
        for other in names:
            if other != n:
                pairs += [_pair(f"foot{k}_{n}", f"box_{other}", rubs) for k in (1, 2)]
                # The wider of two blocks stands with its face on the other's upper corners.
                pairs += [_pair(f"top{k}_{other}", f"box_{n}", rubs) for k in (1, 2)]
        pairs += [_pair(f"tip{i}{e}", f"box_{n}", world.pad_friction) for i in (1, 2) for e in "ab"]
    motors = "".join(
        f'<position joint="{axis}{i + 1}" kp="{s.stiffness:.12g}" kv="{s.damping:.12g}"/>'
        for i, s in enumerate(servos)
        for axis in "xz"
    )
    return f"""<mujoco><compiler angle="radian"/>
<option timestep="{STEP}" integrator="implicitfast" cone="elliptic" impratio="100" solver="Newton"
 iterations="50" tolerance="1e-12" gravity="0 0 {-GRAVITY}"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>{"".join(bodies)}</worldbody><contact>{"".join(pairs)}</contact>
<actuator>{motors}</actuator></mujoco>"""


def _pair(a: str, b: str, friction: float) -> str:
    return f'<pair geom1="{a}" geom2="{b}" friction="{friction:.12g} {friction:.12g}" condim="3" {CONTACT}/>'


def _table(world: World) -> str:
    # The upper face passes through PIVOT at height 0, whatever the tilt.
    x, z = PIVOT + 0.05 * math.sin(world.tilt), -0.05 * math.cos(world.tilt)
    turn = (
        f'<geom name="table" type="box" size="1 0.1 0.05" pos="{x:.12g} 0 {z:.12g}"'
        f' euler="0 {-world.tilt:.12g} 0"/>'
    )
    if world.table_stiffness == float("inf"):
        return turn
    mass = 0.3
    damping = 1.4 * (world.table_stiffness * mass) ** 0.5
    return (
        f'<body name="plate" gravcomp="1"><inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/>'
        f'<joint name="plate" type="slide" axis="0 0 1" stiffness="{world.table_stiffness:.12g}"'
        f' damping="{damping:.12g}"/>{turn}</body>'
    )


def _block(name: str, block: Block, centre: tuple[float, float], world: World) -> str:
    w, h, mass = block.width / 2, block.height / 2, block.weight / GRAVITY
    spin = mass * (w**2 + h**2) / 3
    radius, inset = FEET[world.feet]
    x, z = w - radius - inset, h - radius
    corners = "".join(
        f'<geom name="{part}{k}_{name}" type="sphere" size="{radius}"'
        f' pos="{side * x:.12g} 0 {way * z:.12g}"/>'
        for part, way in (("foot", -1), ("top", 1))
        for k, side in ((1, -1), (2, 1))
    )
    return (
        f'<body name="{name}" pos="{centre[0]:.12g} 0 {centre[1]:.12g}">'
        f'<joint name="x_{name}" type="slide" axis="1 0 0"/>'
        f'<joint name="z_{name}" type="slide" axis="0 0 1"/>'
        f'<joint name="turn_{name}" type="hinge" axis="0 -1 0"/>'
        f'<inertial pos="{world.mass_offset:.12g} 0 0" mass="{mass:.12g}"'
        f' diaginertia="{spin:.12g} {spin:.12g} {spin:.12g}"/>'
        f'<geom name="box_{name}" type="box" size="{w:.12g} 0.02 {h:.12g}"/>{corners}</body>'
    )


def _finger(i: int, start: tuple[float, ...], world: World, servo: Servo) -> str:
    """Joints are measured from the world's origin, so that their positions are the tips'."""
    n, side = i + 1, (-TIP, TIP)[i]
    linear = world.exponent == 1.0
    normal, shear = world.pads()[2 * i : 2 * i + 2] if linear else (0.0, 0.0)
    stiffness, *anchor = world.cable
    turning = world.pad_turning
    hold = 2 * 0.5 * (turning * PAD_INERTIA) ** 0.5
    joints = "".join(
        f'<joint name="{axis}{n}" type="slide" axis="{line}" damping="{world.drag:.12g}"'
        f' stiffness="{stiffness:.12g}" springref="{ref:.12g}"/>'
        for axis, line, ref in (("x", "1 0 0", anchor[0]), ("z", "0 0 1", anchor[1]))
    )
    ends = "".join(
        f'<geom name="tip{n}{e}" type="sphere" size="{TIP}" pos="{side} 0 {z}"/>'
        for e, z in (("a", PAD), ("b", -PAD))
    )
    return (
        f'<body name="finger{n}" pos="0 0 0" gravcomp="1">{joints}'
        f'<inertial pos="0 0 0" mass="{servo.mass:.12g}" diaginertia="1e-4 1e-4 1e-4"/>'
        f'<body name="pad{n}" gravcomp="1">'
        f'<joint name="n{n}" type="slide" axis="1 0 0" stiffness="{normal:.12g}" damping="{DAMPING}"/>'
        f'<joint name="s{n}" type="slide" axis="0 0 1" stiffness="{shear:.12g}" damping="{DAMPING}"/>'
        f'<joint name="r{n}" type="hinge" axis="0 -1 0" stiffness="{turning:.12g}" damping="{hold:.12g}"/>'
        f'<inertial pos="0 0 0" mass="{TIP_MASS}" diaginertia="{PAD_INERTIA} {PAD_INERTIA} {PAD_INERTIA}"/>'
        f"{ends}</body></body>"
    )


# Tasks: what stands on what at first, which block goes where, and the file that states it.

GROUND = "ground"


@dataclass(frozen=True)
class Task:
    """`on`: what every block stands on at the start; `moves`: (block, where it goes), in order."""

    name: str
    on: dict[str, str]
    moves: tuple[tuple[str, str], ...]

    @property
    def subtasks(self) -> tuple[str, ...]:
        """Names as the diagnosis has them; what is before a later move belongs to the one before."""
        first = self.moves[0][0]
        steps = ("pickup", "carry", "place", "release")
        return (f"pregrasp {first}", *(f"{s} {b}" for b, _ in self.moves for s in steps))

    def toml(self) -> str:
        """The task.toml."""
        objects = "".join(f'[objects.{b}]\non = "{on}"\n' for b, on in self.on.items())
        moves = "".join(f'[[moves]]\nobject = "{b}"\nto = "{to}"\n' for b, to in self.moves)
        return objects + moves


TASKS = {
    task.name: task
    for task in (
        Task("reversal", {"block1": "block2", "block2": GROUND}, (("block1", GROUND), ("block2", "block1"))),
        Task("transport", {"block1": GROUND}, (("block1", GROUND),)),
        Task("stacking", {"block1": GROUND, "block2": GROUND}, (("block1", "block2"),)),
        Task(
            "there_and_back",
            {"block1": "block2", "block2": GROUND},
            (("block1", GROUND), ("block1", "block2")),
        ),
        Task(
            "tower",
            {"block1": "block2", "block2": "block3", "block3": GROUND},
            (("block1", GROUND), ("block2", "block1"), ("block3", "block2")),
        ),
    )
}
