"""The contact equations as residuals: what a recording violates once an effect is taken out of it.

Every sample gives as many equations between its four positions and four forces as unknowns leave
(docs/gap.md): in free motion all forces are zero; held, the fingers' distance and offset follow the
pads' forces; on the ground the block rests; in the air its net force is mass times
acceleration and weight. Velocities are checked against
positions. None of them multiplies position noise by a stiffness.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hmmseg.contact.equations import Pads, block_offset, block_width, block_x, block_y, support_load
from simgap.effects.base import LATE, RINGING, SMOOTH, World, gradient, swung, tips
from simgap.gap.between import (
    doubt_between,
    fivepoint,
    net_forces,
    per_channel,
    sampling_interval,
    sensed,
    shifted,
    slope,
    when,
)
from simgap.gap.frame import Arrays
from simgap.gap.grips import firmness, in_grip, less_mean, recorded
from simgap.gap.memory import driven, relaxed, sunk
from simgap.gap.trial_arrays import CHANNELS
from simgap.phases import Phase

TOUCH = 2e-5  # numerics: m; the corner of contact is rounded over this depth, below the joints' resolution
SURE = 4.0  # chosen: sds of the distance by which fingers must be nearer than the block is wide to touch it
CLOSED = 0.8  # chosen: share of its usual force by which a grip has closed: until then it pushes the block


def residuals(
    world: World, arrays: Arrays, properties: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Residuals (T, N, C) in units of the channels, and how far their variance exceeds `noise` squared.

    `properties` (O, 3): weight, width, height. The variance's factor is 1 where the correction of an effect
    leaves nothing in doubt.
    """
    own = jnp.einsum("tnm,mo,op->tnp", arrays.onehot, arrays.objects, properties)
    weight, width = own[..., 0], own[..., 1]
    rise = jnp.einsum("tnm,mo,o->tn", arrays.onehot, arrays.rises, properties[:, 2])
    position, velocity = tips(world)
    force = contact(world)
    pads = relaxed(world, force)
    x1, y1, x2, y2 = (position[..., k] for k in range(4))
    fx1, fy1, fx2, fy2 = (pads[..., k] for k in range(4))
    couple = world.couple * weight / jnp.maximum(width, 1e-3) * world.carry
    fy1, fy2 = fy1 + couple, fy2 - couple
    (n1, n2), (s1, s2) = world.give_normal, world.give_shear

    pads_give = Pads(n1, n2, s1, s2)
    gap = x2 - x1 - width
    squeeze = block_width(0.0, fx1, fx2, pads_give)
    # Pads that have crept come back late: fingers may be nearer for a while without pressing.
    late = (pads - force)[..., 0] * n1 - (pads - force)[..., 2] * n2
    # A distance known to so much says nothing of a lighter touch: its noise would come out as force.
    unsure = SURE * arrays.sd[..., CHANNELS.index("distance")]
    touching = TOUCH * jax.nn.softplus(-(gap + late + unsure * world.free) / TOUCH)
    held = world.ground + world.carry
    firm = firmness(0.5 * (force[..., 0] - force[..., 2]), held, jnp.asarray(arrays.onehot))
    # Held firmly the fingers are as far apart as the block is wide, pads or none; else only not nearer.
    distance = firm * (squeeze + gap) + (1 - firm) * (squeeze - late - touching)
    place = jnp.asarray(arrays.phase[..., Phase.PLACE])
    offset = block_offset(y2 - y1, fy1, fy2, pads_give)
    x = block_x((x1 + x2) / 2, fx1, fx2, pads_give)
    load = support_load(weight, force[..., 1] + force[..., 3])
    y = block_y((y1 + y2) / 2, fy1, fy2, pads_give) + sunk(world, load)
    y = y - jnp.tan(world.tilt) * (x1 + x2) / 2 - rise * place
    # Fingers that close push the block and slide on it until both hold it: only then it rests.
    lesser = jnp.minimum(force[..., 0], -force[..., 2])
    both = firmness(lesser, held, jnp.asarray(arrays.onehot), CLOSED)
    closed = firm * both
    still = closed * (arrays.phase[..., Phase.PICKUP] + place)
    offset, loose_offset = in_grip(offset, closed * held, "offset", arrays, noise, world)
    x = less_mean(x, arrays, still * recorded(arrays, "x"), place)
    y, loose_y = in_grip(y, closed * world.ground, "y", arrays, noise, world)

    acceleration, _ = fivepoint(world, velocity)
    ax, ay = ((acceleration[..., k] + acceleration[..., k + 2]) / 2 for k in (0, 1))
    mass = weight / world.gravity * world.inertia
    ground, carry = world.ground, world.carry
    net_x = carry * mass * ax + ground * (force[..., 0] + force[..., 2])
    net_y = carry * (weight + mass * ay) + ground * (force[..., 1] + force[..., 3])
    half = (force[..., 0] - force[..., 2]) / 2, (force[..., 1] - force[..., 3]) / 2
    free = touching / jnp.maximum(n1 + n2, 2e-4) * world.free
    expected = jnp.stack([net_x, net_y, held * half[0] + free, held * half[1]], -1) + net_forces(world.load)
    filtered, either = sensed(world, expected)
    filtered = when(world, RINGING, lambda f: driven(world, f, back=False), filtered)
    forces = (net_forces(world.force) - filtered) * world.loudness

    mean_p = (position[..., :2] + position[..., 2:]) / 2
    mean_v = (velocity[..., :2] + velocity[..., 2:]) / 2
    speeds = _compact(mean_v) - gradient(world.t, mean_p)
    geometry = jnp.stack([x, y, distance * held, offset], -1)
    # In the units of what was recorded: an effect must not gain by scaling the noise down.
    size = jnp.mean(world.link)
    loose = jnp.stack([jnp.ones_like(x), loose_y, jnp.ones_like(x), loose_offset], -1)
    factor = loose + _doubt(world, firm) / jnp.square(noise[..., :4])
    return (
        jnp.concatenate([geometry / size, speeds / size, forces], -1),
        jnp.concatenate([factor, jnp.ones_like(speeds), 1 + either / jnp.square(noise[..., 6:])], -1),
    )


def _doubt(world: World, firm: jax.Array) -> jax.Array:
    """Variance (T, N, 4) [m^2] of x, y, distance and offset from what is in doubt of angles and forces."""
    turn_x, turn_y = (jnp.where(world.jointed > 0.5, turn, 0.0) for turn in swung(world))
    pads = doubt_between(world)

    def finger(turn: jax.Array, give: jax.Array, force: int) -> tuple[jax.Array, jax.Array]:
        place = jnp.square(turn) * world.doubt_joints
        pad = pads[..., force::2] * jnp.square(give)[None, None, :]
        return (place[..., :2].sum(-1) + pad[..., 0]), (place[..., 2:].sum(-1) + pad[..., 1])

    (x1, x2), (y1, y2) = finger(turn_x, world.give_normal, 0), finger(turn_y, world.give_shear, 1)
    x, y = x1 + x2, y1 + y2
    return jnp.stack([x / 4, y / 4, x, y], -1) * jnp.square(firm)[..., None]


def _compact(v: jax.Array) -> jax.Array:
    """(v[k-1] + 4 v[k] + v[k+1]) / 6, the mean velocity that central differences have to fourth order."""
    inner = (v[:, :-2] + 4 * v[:, 1:-1] + v[:, 2:]) / 6
    return jnp.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def contact(world: World) -> jax.Array:
    """Forces (T, N, 4) of the contacts: before delay and low-pass, before they rang a mode, without loads."""
    force = when(world, RINGING, lambda f: driven(world, f, back=True), world.force)
    force = when(world, LATE, lambda f: shifted(f, world.delay / sampling_interval(world)), force)
    return (
        when(world, SMOOTH, lambda f: f + per_channel(world.smoothing) * slope(world, f)[0], force)
        - world.load
    )
