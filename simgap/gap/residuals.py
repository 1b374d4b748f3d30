"""The contact equations as residuals: what a recording violates once an effect is taken out of it.

Every sample gives four equations between its four positions and four forces (docs/gap.md): in free
motion all forces are zero; held, the fingers' distance and offset follow the pads' forces; on the
ground the block rests; in the air its net force is mass times acceleration and weight. Velocities
are checked against positions. None of them multiplies position noise by a stiffness.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from simgap.effects.base import CREEPING, LATE, SLIDING, SMOOTH, World, gradient, tips
from simgap.gap.frame import CHANNELS, Arrays

TOUCH = 2e-5  # m; the corner of contact is rounded over this depth, below the joints' resolution
SURE = 4.0  # sds of the distance by which fingers must be nearer than the block is wide to touch it
HELD = 0.1  # N; a grip below this holds nothing


def residuals(world: World, arrays: Arrays, properties: jax.Array) -> jax.Array:
    """Residuals (T, N, C) in units of the channels; `properties` (O, 3): weight, width, height."""
    own = jnp.einsum("tnm,mo,op->tnp", arrays.onehot, arrays.objects, properties)
    weight, width = own[..., 0], own[..., 1]
    rise = jnp.einsum("tnm,mo,o->tn", arrays.onehot, arrays.rises, properties[:, 2])
    position, velocity = tips(world)
    force = undelayed(world)
    pads = _relaxed(world, force)
    x1, y1, x2, y2 = (position[..., k] for k in range(4))
    fx1, fy1, fx2, fy2 = (pads[..., k] for k in range(4))
    couple = world.couple * weight / jnp.maximum(width, 1e-3) * world.carry
    fy1, fy2 = fy1 + couple, fy2 - couple
    (n1, n2), (s1, s2) = world.give_normal, world.give_shear

    gap, squeeze = x2 - x1 - width, fx1 * n1 - fx2 * n2
    # Pads that have crept come back late: fingers may be nearer for a while without pressing.
    late = (pads - force)[..., 0] * n1 - (pads - force)[..., 2] * n2
    # A distance known to so much says nothing of a lighter touch: its noise would come out as force.
    unsure = SURE * arrays.sd[..., CHANNELS.index("distance")]
    touching = TOUCH * jax.nn.softplus(-(gap + late + unsure * world.free) / TOUCH)
    held = world.ground + world.carry
    firm = jax.nn.sigmoid((0.5 * (force[..., 0] - force[..., 2]) / HELD - 1) * 4)
    # Held firmly the fingers are as far apart as the block is wide, pads or none; else only not nearer.
    distance = firm * (squeeze + gap) + (1 - firm) * (squeeze - late - touching)
    place = jnp.asarray(arrays.phase[..., 3])
    offset = y2 - y1 - (fy2 * s2 - fy1 * s1)
    x = (x1 + x2) / 2 - (fx1 * n1 + fx2 * n2) / 2
    load = weight - force[..., 1] - force[..., 3]
    y = (y1 + y2) / 2 - (fy1 * s1 + fy2 * s2) / 2 + load * world.give_support
    y = y - jnp.tan(world.tilt) * (x1 + x2) / 2 - rise * place
    still = firm * (arrays.phase[..., 1] + place)
    onground = firm * world.ground
    offset = _centred(offset, arrays, firm * held * _known(arrays, "offset"), None, world)
    x = _centred(x, arrays, still * _known(arrays, "x"), place, None)
    y = _centred(y, arrays, onground * _known(arrays, "y"), None, world)

    acceleration = gradient(world.t, velocity)
    ax, ay = ((acceleration[..., k] + acceleration[..., k + 2]) / 2 for k in (0, 1))
    mass = weight / world.gravity * world.inertia
    ground, carry = world.ground, world.carry
    net_x = carry * mass * ax + ground * (force[..., 0] + force[..., 2])
    net_y = carry * (weight + mass * ay) + ground * (force[..., 1] + force[..., 3])
    half = (force[..., 0] - force[..., 2]) / 2, (force[..., 1] - force[..., 3]) / 2
    free = touching / jnp.maximum(n1 + n2, 2e-4) * world.free
    expected = jnp.stack([net_x, net_y, held * half[0] + free, held * half[1]], -1)
    recorded = world.force
    seen = jnp.stack(
        [
            recorded[..., 0] + recorded[..., 2],
            recorded[..., 1] + recorded[..., 3],
            (recorded[..., 0] - recorded[..., 2]) / 2,
            (recorded[..., 1] - recorded[..., 3]) / 2,
        ],
        -1,
    )
    forces = (seen - _filtered(world, expected)) * world.loudness

    mean_p = (position[..., :2] + position[..., 2:]) / 2
    mean_v = (velocity[..., :2] + velocity[..., 2:]) / 2
    speeds = _compact(mean_v) - gradient(world.t, mean_p)
    geometry = jnp.stack([x, y, distance * held, offset], -1)
    # In the units of what was recorded: an effect must not gain by scaling the noise down.
    size = jnp.mean(world.link)
    return jnp.concatenate([geometry / size, speeds / size, forces], -1)


def _compact(v: jax.Array) -> jax.Array:
    """(v[k-1] + 4 v[k] + v[k+1]) / 6, the mean velocity that central differences have to fourth order."""
    inner = (v[:, :-2] + 4 * v[:, 1:-1] + v[:, 2:]) / 6
    return jnp.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def _step(world: World) -> jax.Array:
    return jnp.median(world.t[:, 1:] - world.t[:, :-1])


def shifted(values: jax.Array, steps: jax.Array) -> jax.Array:
    """Values (T, N, C) read `steps` samples later (a fraction allowed): cubic Catmull-Rom."""
    n = values.shape[1]
    whole = jnp.floor(steps)
    s = steps - whole
    index = jnp.arange(n) + whole.astype(int)
    p0, p1, p2, p3 = (values[:, jnp.clip(index + k, 0, n - 1)] for k in (-1, 0, 1, 2))
    cubic = ((-p0 + 3 * p1 - 3 * p2 + p3) * s + (2 * p0 - 5 * p1 + 4 * p2 - p3)) * s + (p2 - p0)
    return p1 + 0.5 * s * cubic


def undelayed(world: World) -> jax.Array:
    """Forces (T, N, 4) before delay and low-pass."""
    force = _when(world, LATE, lambda f: shifted(f, world.delay / _step(world)), world.force)
    return _when(world, SMOOTH, lambda f: f + world.smoothing * gradient(world.t, f), force)


def _filtered(world: World, force: jax.Array) -> jax.Array:
    """Forces (T, N, C) after low-pass (exact between samples for straight lines) and delay."""
    smooth = _when(world, SMOOTH, lambda f: _lowpass(f, world.smoothing, _step(world)), force)
    return _when(world, LATE, lambda f: shifted(f, -world.delay / _step(world)), smooth)


def _when(world: World, mode: int, change: Callable[[jax.Array], jax.Array], values: jax.Array) -> jax.Array:
    """Changed values where a candidate has the mode; else the change is not even evaluated."""
    return jax.lax.cond(jnp.asarray(world.modes)[mode] > 0, change, lambda v: v, values)


def _lowpass(values: jax.Array, time: jax.Array, step: jax.Array) -> jax.Array:
    """First-order low-pass of (T, N, C) along N, started at rest; linear between samples."""
    ratio = step / jnp.maximum(time, 1e-4)
    keep = jnp.exp(-ratio)
    new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
    before = jnp.concatenate([values[:, :1], values[:, :-1]], 1)
    drive = new * values + old * before
    # y[k] = keep y[k-1] + drive[k] by doubling: after j rounds y holds the last 2^j drives.
    out = jnp.concatenate([values[:, :1], drive[:, 1:]], 1)
    reach = 1
    while reach < values.shape[1]:
        before = jnp.concatenate([jnp.zeros_like(out[:, :reach]), out[:, :-reach]], 1)
        out, reach = out + jnp.exp(-ratio * reach) * before, 2 * reach
    return out


def _relaxed(world: World, force: jax.Array) -> jax.Array:
    """Forces (T, N, 4) that would give the pads' displacement at once, for pads that creep."""

    def crept(f: jax.Array) -> jax.Array:
        return f + world.creep * (_lowpass(f, world.creep_time, _step(world)) - f)

    return _when(world, CREEPING, crept, force)


def _known(arrays: Arrays, channel: str) -> jax.Array:
    return jnp.asarray(arrays.there[..., CHANNELS.index(channel)])


def _centred(
    values: jax.Array,
    arrays: Arrays,
    weight: jax.Array,
    place: jax.Array | None,
    sliding: World | None,
) -> jax.Array:
    """Values (T, N) less their weighted mean in every grip (pickup and place apart if `place` is given).

    The progress of a slide in `sliding` is regressed out alike: its amount is free in every grip.
    """
    parts = (
        [arrays.onehot]
        if place is None
        else [arrays.onehot * (1 - place)[..., None], arrays.onehot * place[..., None]]
    )
    out = values
    for part in parts:
        members = part * weight[..., None]
        members = members / jnp.maximum(members.sum(1, keepdims=True), 1e-9)
        out = out - jnp.einsum("tnm,tm->tn", part, jnp.einsum("tnm,tn->tm", members, values))
    if sliding is not None:
        out = _when(sliding, SLIDING, lambda v: _less_slide(v, arrays, weight, sliding.slip), out)
    return out * weight


def _less_slide(values: jax.Array, arrays: Arrays, weight: jax.Array, slip: jax.Array) -> jax.Array:
    """Values (T, N) with the best amount of sliding taken out of every grip."""
    members = arrays.onehot * weight[..., None]
    steps = jnp.cumsum(slip[..., None] * arrays.onehot, axis=1)
    total = (slip[..., None] * arrays.onehot).sum(1, keepdims=True)
    progress = steps / (total + 0.05) * jnp.clip(total / 2, 0.0, 1.0) ** 2  # one bad sample is no slide
    mean = (members * progress).sum(1, keepdims=True) / jnp.maximum(members.sum(1, keepdims=True), 1e-9)
    progress = (progress - mean) * arrays.onehot
    amount = jnp.einsum("tnm,tnm,tn->tm", members, progress, values)
    amount = amount / (jnp.einsum("tnm,tnm,tnm->tm", members, progress, progress) + 1e-2)
    return values - jnp.einsum("tnm,tm->tn", progress, amount)
