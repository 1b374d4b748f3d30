"""The second simulator's world: blocks, table and two padded fingers, written for MuJoCo.

Planar: x right, z up (y of the recordings). Blocks slide in x and z and stand on a small round foot, so
that a tilted table needs no tilted block. A finger is a carriage with a servo; its pad is a small tip on
two spring-dampers, which meets a block by MuJoCo's own contact. Contacts are stiff: what they yield lies
far below the sensors' noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

STEP = 0.0002  # s
TIP, TIP_MASS = 0.003, 0.002  # m, kg: small beside everything else
FOOT = 0.0015  # m
DAMPING = 2.0  # N s/m of a pad
CONTACT = 'solref="0.002 1" solimp="0.9999 0.9999 0.0001"'
GRAVITY = 9.80665
UPRIGHT = 200.0  # N m/rad that flat pads hold a block upright with, where it may turn at all
PIVOT = 0.115  # m; about where the stack stands


@dataclass(frozen=True)
class Block:
    """A block: weight [N], width and height [m], friction against what it stands on."""

    weight: float
    width: float
    height: float
    friction: float


@dataclass(frozen=True)
class World:
    """All that surrounds the fingers. Pads [N/m]; `exponent` 1 is a linear pad, whose force at
    `reference` [N] is the same; a Maxwell arm of `creep_ratio` times the pad and `creep_time` [s];
    `pad_friction`; table's `tilt` [rad] and `table_stiffness` [N/m]; `mass_offset` [m]; `cable`
    (N/m, x0, y0 [m]) and `drag` [N s/m] on each finger.
    """

    normal_stiffness: float
    shear_stiffness: float
    exponent: float = 1.0
    reference: float = 2.5
    creep_ratio: float = 0.0
    creep_time: float = 1.0
    pad_friction: float = 1.2
    tilt: float = 0.0
    table_stiffness: float = float("inf")
    mass_offset: float = 0.0
    cable: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 0.0


@dataclass(frozen=True)
class Servo:
    """A finger's moving mass [kg], stiffness [N/m] and damping [N s/m] of its position control."""

    mass: float
    stiffness: float
    damping: float


def mjcf(
    blocks: dict[str, Block],
    centres: dict[str, tuple[float, float]],
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
        pairs += [_pair(f"foot_{n}", "table", blocks[n].friction)]
        pairs += [_pair(f"foot_{n}", f"box_{o}", blocks[n].friction) for o in names if o != n]
        pairs += [_pair(f"tip{i}", f"box_{n}", world.pad_friction) for i in (1, 2)]
    motors = "".join(
        f'<position joint="{axis}{i + 1}" kp="{s.stiffness:.12g}" kv="{s.damping:.12g}"/>'
        for i, s in enumerate(servos)
        for axis in "xz"
    )
    if world.mass_offset:
        motors += "".join(
            f'<position joint="turn_{n}" kp="{UPRIGHT}" kv="{0.014 * UPRIGHT**0.5:.6g}"/>' for n in names
        )
    return f"""<mujoco><compiler angle="radian"/>
<option timestep="{STEP}" integrator="Euler" cone="elliptic" impratio="100" solver="Newton"
 iterations="50" tolerance="1e-12" gravity="0 0 {-GRAVITY}"><flag eulerdamp="disable"/></option>
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
    turn = (
        f'<joint name="turn_{name}" type="hinge" axis="0 -1 0" armature="1e-4"/>' if world.mass_offset else ""
    )
    return (
        f'<body name="{name}" pos="{centre[0]:.12g} 0 {centre[1]:.12g}">'
        f'<joint name="x_{name}" type="slide" axis="1 0 0"/>'
        f'<joint name="z_{name}" type="slide" axis="0 0 1"/>{turn}'
        f'<inertial pos="0 0 0" mass="{mass:.12g}" diaginertia="{spin:.12g} {spin:.12g} {spin:.12g}"/>'
        f'<geom name="box_{name}" type="box" size="{w:.12g} 0.02 {h:.12g}"/>'
        f'<geom name="foot_{name}" type="sphere" size="{FOOT}" pos="0 0 {FOOT - h:.12g}"/></body>'
    )


def _finger(i: int, start: tuple[float, ...], world: World, servo: Servo) -> str:
    """Joints are measured from the world's origin, so that their positions are the tips'."""
    n, side = i + 1, (-TIP, TIP)[i]
    linear = world.exponent == 1.0
    normal, shear = (world.normal_stiffness, world.shear_stiffness) if linear else (0.0, 0.0)
    stiffness, *anchor = world.cable
    joints = "".join(
        f'<joint name="{axis}{n}" type="slide" axis="{line}" damping="{world.drag:.12g}"'
        f' stiffness="{stiffness:.12g}" springref="{ref:.12g}"/>'
        for axis, line, ref in (("x", "1 0 0", anchor[0]), ("z", "0 0 1", anchor[1]))
    )
    return (
        f'<body name="finger{n}" pos="0 0 0" gravcomp="1">{joints}'
        f'<inertial pos="0 0 0" mass="{servo.mass:.12g}" diaginertia="1e-4 1e-4 1e-4"/>'
        f'<body name="pad{n}" gravcomp="1">'
        f'<joint name="n{n}" type="slide" axis="1 0 0" stiffness="{normal:.12g}" damping="{DAMPING}"/>'
        f'<joint name="s{n}" type="slide" axis="0 0 1" stiffness="{shear:.12g}" damping="{DAMPING}"/>'
        f'<inertial pos="0 0 0" mass="{TIP_MASS}" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<geom name="tip{n}" type="sphere" size="{TIP}" pos="{side} 0 0"/></body></body>'
    )
