"""Planar dynamics of several blocks between two compliant fingertips, on the ground or stacked.

Blocks translate and keep their orientation: flat pads hold a block's faces, flat supports its
bottom (in recordings of such a hand the shear of a carried block follows the fingers' offset by
half the shear stiffness, which a block free to tilt would not show). Everything is written
in scalars, tuples over blocks and fingers: XLA then fuses a whole substep into one kernel, and
the same code is mapped over trials.

Units: m, s, N, kg, rad. x right, y up; finger 0 is the left one and pushes right.
"""

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# Laws of one contact: a unilateral Kelvin-Voigt spring, and Coulomb friction with an anchor.
#
# Both are elementwise, continuous in all arguments, and differentiable except at the edges of contact and of
# the friction cone, where the derivative is one-sided and finite.

FADE = 2e-5  # numerics: m; depth over which damping fades in, so that an impact starts without a jump


def normal_force(stiffness: Array, damping: Array, depth: Array, rate: Array) -> Array:
    """Normal force [N] of a spring that only pushes, at `depth` [m] inside. Its damping [N s/m] fades in with
    depth, as in Hunt & Crossley, J. Appl. Mech. 42 (1975): constant damping would make the force jump at
    touch and pull at separation."""
    depth = jnp.maximum(depth, 0.0)
    faded = damping * jnp.minimum(depth / FADE, 1.0)
    return jnp.maximum(stiffness * depth + faded * rate, 0.0)


def friction(stiffness: Array, damping: Array, deflection: Array, rate: Array,
             bound: Array) -> tuple[Array, Array]:  # fmt: skip
    """Tangential force [N] and the remaining elastic deflection [m]: the contact sticks through a spring from
    its anchor, which beyond `bound` is dragged along (return mapping: Simo & Hughes, Computational
    Inelasticity, 1998, chapter 1; Cundall & Strack, Géotechnique 29, 1979)."""
    limit = bound / stiffness
    deflection = jnp.clip(deflection, -limit, limit)
    return jnp.clip(stiffness * deflection + damping * rate, -bound, bound), deflection


Scalar = Any  # a float or an Array of shape ()
Scalars = tuple[Scalar, ...]

EDGE = 1e-3  # numerics: m; length over which a contact fades at the end of a face


class Physics(NamedTuple):
    """All constants of a scene, a pytree of scalars; effects and gradients act on it."""

    weight: Scalars  # [N] per block
    width: Scalars  # [m]
    height: Scalars  # [m]
    friction: Scalars  # against a pad
    pad_normal: Scalars  # [N/m] per finger
    pad_shear: Scalars  # [N/m]
    pad_time: Scalar  # [s] the foam's damping over its stiffness
    support_stiffness: Scalar  # [N/m] of ground and blocks, along and across
    support_damping: Scalar  # ratio to critical
    support_friction: Scalar
    gravity: Scalar
    tilt: Scalar  # [rad] of the ground


class State(NamedTuple):
    """Blocks' centres and velocities, and anchors of contacts: relative positions [m] without shear."""

    x: Scalars
    y: Scalars
    vx: Scalars
    vy: Scalars
    pads: tuple[Scalars, Scalars]
    ground: Scalars
    pairs: Scalars  # one per pair of blocks


class Tips(NamedTuple):
    """Undeformed contact faces of the two fingers: positions [m] and velocities [m/s]."""

    x: Scalars
    y: Scalars
    vx: Scalars
    vy: Scalars


class Loads(NamedTuple):
    """Forces [N]."""

    fx: Scalars  # exerted by each finger
    fy: Scalars  # likewise
    block_x: Scalars  # net on each block
    block_y: Scalars  # likewise
    pads: tuple[Scalars, Scalars]  # normal, of each finger on each block
    support: Scalars  # from beneath each block


Values = Any  # a jax Array in compiled code, a NumPy array after it


class Record(NamedTuple):
    """A rollout, one row per control period; F fingers (2), B blocks."""

    position: Values  # (T, F, 2) [m] of the tips
    velocity: Values  # (T, F, 2) [m/s]
    force: Values  # (T, F, 2) [N]
    blocks: Values  # (T, B, 2) [m]
    block_velocity: Values  # (T, B, 2) [m/s]
    pads: Values  # (T, F, B) [N] normal forces
    support: Values  # (T, B) [N] from beneath


def tips_of(row: Array) -> Tips:
    """Tips from a row of x1, y1, x2, y2 and their velocities."""
    x1, y1, x2, y2, vx1, vy1, vx2, vy2 = (row[k] for k in range(8))
    return Tips((x1, x2), (y1, y2), (vx1, vx2), (vy1, vy2))


def row_of(state: State, tips: Tips, loads: Loads) -> Array:
    """Everything recorded as one row; `record_of` is the inverse."""
    parts = [tips.x, tips.y, tips.vx, tips.vy, loads.fx, loads.fy, state.x, state.y, state.vx, state.vy,
             *loads.pads, loads.support]  # fmt: skip
    return jnp.stack([value for part in parts for value in part])


def record_of(rows: Array, num_blocks: int) -> Record:
    """The record in rows (T, n) of `row_of`."""

    def pair(start: int, width: int) -> Array:
        return jnp.stack([rows[:, start : start + width], rows[:, start + width : start + 2 * width]], -1)

    n, b = num_blocks, 12
    return Record(pair(0, 2), pair(4, 2), pair(8, 2), pair(b, n), pair(b + 2 * n, n),
                  rows[:, b + 4 * n : b + 6 * n].reshape(-1, 2, n), rows[:, b + 6 * n :])  # fmt: skip


def interpolated(t: np.ndarray, fine: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (T, ...) at times `fine` (T,), interpolated linearly at times t (n,): (n, ...)."""
    columns = values.reshape(len(fine), -1).T
    return np.stack([np.interp(t, fine, column) for column in columns], 1).reshape(t.size, *values.shape[1:])


def pairs(num_blocks: int) -> tuple[tuple[int, int], ...]:
    """All pairs of blocks, in the order of `State.pairs`."""
    return tuple(itertools.combinations(range(num_blocks), 2))


def resting_state(physics: Physics, x: Sequence[Scalar], y: Sequence[Scalar]) -> State:
    """Blocks at rest, centred at x, y [m]; no contact carries shear."""
    zeros = tuple(0.0 * value for value in x)
    ground = tuple(_along(physics, a, b) for a, b in zip(x, y, strict=True))
    offsets = tuple(x[i] - x[j] for i, j in pairs(len(x)))
    return State(tuple(x), tuple(y), zeros, zeros, (zeros, zeros), ground, offsets)


def interact(physics: Physics, state: State, tips: Tips) -> tuple[State, Loads]:
    """Contact forces in a configuration, and the state with the anchors of slipping contacts dragged on."""
    n = len(state.x)
    force_x: list[Scalar] = [0.0] * n
    force_y: list[Scalar] = [-w for w in physics.weight]
    support: list[Scalar] = [0.0] * n
    tip_x: list[Scalar] = [0.0, 0.0]
    tip_y: list[Scalar] = [0.0, 0.0]
    pads: tuple[list[Scalar], list[Scalar]] = ([], [])
    normals: tuple[list[Scalar], list[Scalar]] = ([], [])
    for finger, sign in ((0, 1.0), (1, -1.0)):
        for i in range(n):
            push, shear, anchor = _pad(physics, state, tips, finger, sign, i)
            force_x[i] += sign * push
            force_y[i] += shear
            tip_x[finger] += sign * push
            tip_y[finger] += shear
            pads[finger].append(anchor)
            normals[finger].append(push)
    ground = []
    for i in range(n):
        fx, fy, push, anchor = _ground(physics, state, i)
        force_x[i] += fx
        force_y[i] += fy
        support[i] += push
        ground.append(anchor)
    anchors = []
    for k, (i, j) in enumerate(pairs(n)):
        fx, fy, anchor = _pair(physics, state, i, j, state.pairs[k])
        force_x[i] += fx
        force_x[j] -= fx
        force_y[i] += fy
        force_y[j] -= fy
        support[i] += jnp.maximum(fy, 0.0)
        support[j] += jnp.maximum(-fy, 0.0)
        anchors.append(anchor)
    mapped = state._replace(pads=(tuple(pads[0]), tuple(pads[1])), ground=tuple(ground), pairs=tuple(anchors))
    return mapped, Loads(tuple(tip_x), tuple(tip_y), tuple(force_x), tuple(force_y),
                         (tuple(normals[0]), tuple(normals[1])), tuple(support))  # fmt: skip


Moving = TypeVar("Moving", State, Tips)


def drift(moving: Moving, h: Scalar) -> Moving:
    """Positions advanced by h [s] at constant velocity."""
    x, y = (
        tuple(a + h * v for a, v in zip(at, speed, strict=True))
        for at, speed in ((moving.x, moving.vx), (moving.y, moving.vy))
    )
    return moving._replace(x=x, y=y)


def kick(physics: Physics, state: State, loads: Loads, h: Scalar) -> State:
    """Velocities advanced by h [s] under constant loads."""
    rate = tuple(h * physics.gravity / w for w in physics.weight)
    return state._replace(
        vx=tuple(v + r * f for v, r, f in zip(state.vx, rate, loads.block_x, strict=True)),
        vy=tuple(v + r * f for v, r, f in zip(state.vy, rate, loads.block_y, strict=True)),
    )


def substep(physics: Physics, state: State, tips: Tips, h: Scalar) -> State:
    """One step of h [s], with the tips given at its middle: half drift, kick, half drift. The position form
    of the Störmer-Verlet scheme (Hairer, Lubich & Wanner, Geometric Numerical Integration, 2006, section
    I.1), stable for h times the fastest frequency below 2."""
    state, loads = interact(physics, drift(state, h / 2), tips)
    return drift(kick(physics, state, loads, h), h / 2)


def energy(physics: Physics, state: State, tips: Tips) -> Scalar:
    """Kinetic, gravitational and elastic energy [J] of blocks and contacts."""
    mapped, _ = interact(physics, state, tips)
    total = 0.0
    for i, w in enumerate(physics.weight):
        total += w / physics.gravity * (state.vx[i] ** 2 + state.vy[i] ** 2) / 2 + w * state.y[i]
        depth, _ = _ground_depth(physics, state, i)
        total += physics.support_stiffness * jnp.maximum(depth, 0.0) ** 2 / 2
        along = _along(physics, state.x[i], state.y[i]) - mapped.ground[i]
        total += physics.support_stiffness * along**2 / 2
        for finger, sign in ((0, 1.0), (1, -1.0)):
            depth, share = _pad_depth(physics, state, tips, finger, sign, i)
            total += physics.pad_normal[finger] * share * jnp.maximum(depth, 0.0) ** 2 / 2
            stretch = tips.y[finger] - state.y[i] - mapped.pads[finger][i]
            total += physics.pad_shear[finger] * stretch**2 / 2
    for k, (i, j) in enumerate(pairs(len(state.x))):
        depth, share, beside, overlap = _pair_depths(physics, state, i, j)
        total += physics.support_stiffness * share * jnp.maximum(depth, 0.0) ** 2 / 2
        total += physics.support_stiffness * beside * jnp.maximum(overlap, 0.0) ** 2 / 2
        total += physics.support_stiffness * (state.x[i] - state.x[j] - mapped.pairs[k]) ** 2 / 2
    return total


def _pad_depth(physics: Physics, state: State, tips: Tips, finger: int, sign: float,
               i: int) -> tuple[Scalar, Scalar]:  # fmt: skip
    """Compression [m] of a pad by a block, and the share of the pad that faces the block's side."""
    depth = physics.width[i] / 2 - sign * (state.x[i] - tips.x[finger])
    reach = physics.height[i] / 2 - jnp.abs(tips.y[finger] - state.y[i])
    # A finger past the block's middle is behind another block, not inside this one.
    share = jnp.clip(reach / EDGE + 0.5, 0.0, 1.0) * jnp.where(depth < physics.width[i] / 2, 1.0, 0.0)
    return depth, share


def _pad(physics: Physics, state: State, tips: Tips, finger: int, sign: float,
         i: int) -> tuple[Scalar, Scalar, Scalar]:  # fmt: skip
    """Normal force [N], shear [N] and new anchor [m] of a finger's contact with a block."""
    depth, share = _pad_depth(physics, state, tips, finger, sign, i)
    stiffness = physics.pad_normal[finger] * share
    push = normal_force(stiffness, stiffness * physics.pad_time, depth,
                        sign * (tips.vx[finger] - state.vx[i]))  # fmt: skip
    offset = tips.y[finger] - state.y[i]
    shear = physics.pad_shear[finger]
    force, stretch = friction(shear, shear * physics.pad_time, offset - state.pads[finger][i],
                              tips.vy[finger] - state.vy[i], physics.friction[i] * push)  # fmt: skip
    return push, force, offset - stretch


def _along(physics: Physics, x: Scalar, y: Scalar) -> Scalar:
    """Coordinate along the inclined ground [m]."""
    return x * jnp.cos(physics.tilt) + y * jnp.sin(physics.tilt)


def _ground_depth(physics: Physics, state: State, i: int) -> tuple[Scalar, Scalar]:
    """Depth [m] of a block's bottom in the ground, and its rate [m/s]."""
    sine, cosine = jnp.sin(physics.tilt), jnp.cos(physics.tilt)
    depth = sine * state.x[i] - cosine * (state.y[i] - physics.height[i] / 2)
    return depth, sine * state.vx[i] - cosine * state.vy[i]


def _ground(physics: Physics, state: State, i: int) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Forces fx, fy of the ground on a block [N], their normal part, and the new anchor [m]."""
    depth, rate = _ground_depth(physics, state, i)
    damping = _damping(physics, physics.weight[i])
    push = normal_force(physics.support_stiffness, damping, depth, rate)
    along = _along(physics, state.x[i], state.y[i])
    sine, cosine = jnp.sin(physics.tilt), jnp.cos(physics.tilt)
    speed = cosine * state.vx[i] + sine * state.vy[i]
    force, stretch = friction(physics.support_stiffness, damping, state.ground[i] - along, -speed,
                              physics.support_friction * push)  # fmt: skip
    return cosine * force - sine * push, sine * force + cosine * push, push, along + stretch


def _pair_depths(physics: Physics, state: State, i: int,
                 j: int) -> tuple[Scalar, Scalar, Scalar, Scalar]:  # fmt: skip
    """Depth of a vertical contact and its share of the face, then the share and depth of a side contact."""
    depth = (physics.height[i] + physics.height[j]) / 2 - jnp.abs(state.y[i] - state.y[j])
    overlap = (physics.width[i] + physics.width[j]) / 2 - jnp.abs(state.x[i] - state.x[j])
    # The shorter of the two ways out is the contact.
    share = jnp.clip((overlap - jnp.maximum(depth, 0.0)) / EDGE, 0.0, 1.0)
    beside = jnp.clip((depth - jnp.maximum(overlap, 0.0)) / EDGE, 0.0, 1.0)
    return depth, share, beside, overlap


def _pair(physics: Physics, state: State, i: int, j: int,
          anchor: Scalar) -> tuple[Scalar, Scalar, Scalar]:  # fmt: skip
    """Force of block j on block i, and the new anchor of their friction (a side contact has none)."""
    depth, share, beside, overlap = _pair_depths(physics, state, i, j)
    up = jnp.where(state.y[i] > state.y[j], 1.0, -1.0)
    right = jnp.where(state.x[i] > state.x[j], 1.0, -1.0)
    weight = physics.weight[i] * physics.weight[j] / (physics.weight[i] + physics.weight[j])
    k, damping = physics.support_stiffness, _damping(physics, weight)
    vx, vy = state.vx[i] - state.vx[j], state.vy[i] - state.vy[j]
    push = normal_force(k * share, damping * share, depth, -up * vy)
    side = normal_force(k * beside, damping * beside, overlap, -right * vx)
    offset = state.x[i] - state.x[j]
    force, stretch = friction(k, damping, anchor - offset, -vx, physics.support_friction * push)
    return right * side + force, up * push, offset + stretch


def _damping(physics: Physics, weight: Scalar) -> Scalar:
    """Damping [N s/m] of a support beneath a body of this weight [N]."""
    return 2 * physics.support_damping * jnp.sqrt(physics.support_stiffness * weight / physics.gravity)


# The position-controlled hand that performs a command.
#
# Each fingertip is a mass drawn to the commanded motion by a spring and a damper (impedance control: Hogan,
# J. Dyn. Sys. Meas. Control 107, 1985) and held back by the contact forces, so that grip and pressing result
# from commanding positions beyond the contact.

CONTROL_PERIOD = 1e-3  # numerics: s; between commands, and between records
BUCKET = 4000  # numerics: control periods; commands are padded to its multiples, so few programs are compiled


class Impedance(NamedTuple):
    """A fingertip of the controlled hand: `mass` [kg], `stiffness` [N/m], `damping` [N s/m]."""

    mass: Scalar
    stiffness: Scalar
    damping: Scalar


@partial(jax.jit, static_argnames=("substeps",))
def perform(physics: Physics, hand: Impedance, command: Array, state: State, substeps: int) -> Record:
    """Perform `command` (T, 4), x1, y1, x2, y2 [m] per control period, joined by lines, from rest."""
    h = CONTROL_PERIOD / substeps
    slope = jnp.diff(command, axis=0, append=command[-1:]) / CONTROL_PERIOD
    start = tips_of(jnp.concatenate([command[0], jnp.zeros(4)]))

    def period(carry: tuple[State, Tips], row: Array) -> tuple[tuple[State, Tips], Array]:
        state, tips = carry
        _, loads = interact(physics, state, tips)
        out = row_of(state, tips, loads)

        def one(k: Array, carry: tuple[State, Tips]) -> tuple[State, Tips]:
            state, tips = carry
            target = tips_of(jnp.concatenate([row[:4] + row[4:] * ((k + 0.5) * h), row[4:]]))
            tips = drift(tips, h / 2)
            state, loads = interact(physics, drift(state, h / 2), tips)
            tips = drift(_pull(hand, tips, target, loads, h), h / 2)
            return drift(kick(physics, state, loads, h), h / 2), tips

        return jax.lax.fori_loop(0, substeps, one, carry), out

    _, rows = jax.lax.scan(period, (state, start), jnp.concatenate([command, slope], axis=1))
    return record_of(rows, len(state.x))


def _pull(hand: Impedance, tips: Tips, target: Tips, loads: Loads, h: Scalar) -> Tips:
    """Tips with velocities advanced by h [s] under the controller's pull and the contact forces."""

    def speed(position: Scalar, velocity: Scalar, aim: Scalar, rate: Scalar, load: Scalar) -> Scalar:
        pull = hand.stiffness * (aim - position) + hand.damping * (rate - velocity)
        return velocity + h / hand.mass * (pull - load)

    return tips._replace(vx=tuple(map(speed, tips.x, tips.vx, target.x, target.vx, loads.fx)),
                         vy=tuple(map(speed, tips.y, tips.vy, target.y, target.vy, loads.fy)))  # fmt: skip
