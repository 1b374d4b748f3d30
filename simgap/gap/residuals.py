"""The contact equations as residuals: what a recording violates once an effect is taken out of it.

Every sample gives as many equations between its four positions and four forces as unknowns leave
(docs/gap.md): in free motion all forces are zero; held, the fingers' distance and offset follow the
pads' forces; on the ground the block rests; in the air its net force is mass times
acceleration and weight. Velocities are checked against
positions. None of them multiplies position noise by a stiffness.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from hmmseg.contact.equations import Pads, block_offset, block_width, block_x, block_y, support_load
from simgap.effects.base import (
    CREEPING,
    LATE,
    RINGING,
    SLIDING,
    SMOOTH,
    YIELDING,
    World,
    gradient,
    swung,
    tips,
)
from simgap.effects.filters import faded, lowpass
from simgap.gap.frame import CHANNELS, Arrays
from simgap.phases import Phase

# Forces between two samples: read at other times, their slopes, and by how much these are in doubt.

BETWEEN = 0.3  # prior: of a bend, sd: a force read between samples
CURVED = 0.5  # prior: of the difference of two ways to take a slope, sd: how far it may be off
EVEN = 0.025  # chosen: N; changes from one sample to the next below this have no corner
SHARP = 0.75  # chosen: by how much one side is flatter, as a share of both, beyond which a force has a corner
EITHER = 0.6  # prior: of a force's change, sd: how a force between two samples goes from one to the other


def net_forces(force: jax.Array) -> jax.Array:
    """Net force, grip and shear (T, N, 4) of both fingers' forces (T, N, 4)."""
    one, two = force[..., :2], force[..., 2:]
    return jnp.concatenate([one + two, (one - two) / 2], -1)


def sampling_interval(world: World) -> jax.Array:
    """The usual time [s] from one sample to the next."""
    return jnp.median(world.t[:, 1:] - world.t[:, :-1])


def shifted(values: jax.Array, steps: jax.Array) -> jax.Array:
    """Values (T, N, C) read `steps` samples later (a number or (C,), a fraction allowed): cubic Catmull-Rom.

    Where they have a corner between two samples, as at a contact change, both sides go straight on to it:
    before a contact there is no force yet. Sides that would not meet between the two are joined straight.
    """
    return jax.vmap(_shifted, (2, 0), 2)(values, jnp.broadcast_to(steps, values.shape[2:]))


def _around(values: jax.Array, steps: jax.Array) -> tuple[jax.Array, ...]:
    """Four neighbours of (T, N) read `steps` samples later, and the fraction between the middle two."""
    n, whole = values.shape[1], jnp.floor(steps)
    index = jnp.arange(n) + whole.astype(int)
    return *(values[:, jnp.clip(index + k, 0, n - 1)] for k in (-1, 0, 1, 2)), steps - whole


def _shifted(values: jax.Array, steps: jax.Array) -> jax.Array:
    p0, p1, p2, p3, s = _around(values, steps)
    cubic = ((-p0 + 3 * p1 - 3 * p2 + p3) * s + (2 * p0 - 5 * p1 + 4 * p2 - p3)) * s + (p2 - p0)
    before, across, after = p1 - p0, p2 - p1, p3 - p2
    convex = after > before
    before, after = (
        jnp.where(convex, one(side, across), other(side, across))
        for side, one, other in ((before, jnp.minimum, jnp.maximum), (after, jnp.maximum, jnp.minimum))
    )
    left, right = p1 + s * before, p2 - (1 - s) * after
    corner = jnp.where(convex, jnp.maximum(left, right), jnp.minimum(left, right))
    corner = jnp.clip(corner, jnp.minimum(p1, p2), jnp.maximum(p1, p2))
    smooth = p1 + 0.5 * s * cubic
    return smooth + _sharp(p1 - p0, p3 - p2, EVEN) * (corner - smooth)


def _sharp(left: jax.Array, right: jax.Array, even: float | jax.Array) -> jax.Array:
    """How surely (0 to 1) changes on both sides are those of a corner; both are alike below `even`.

    A force that rises and falls as fast has a crest there: at a corner one side is flatter than the other.
    """
    left, right = jnp.abs(left), jnp.abs(right)
    return jax.nn.sigmoid((jnp.abs(left - right) / (left + right + even) - SHARP) / 0.08)


def per_channel(values: jax.Array) -> jax.Array:
    """Values (C,), or one, to go with (T, N, C)."""
    return jnp.reshape(values, (1, 1, -1))


def fivepoint(world: World, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rate of change (T, N, C) from five samples, exact to fourth order, and from three."""
    near = gradient(world.t, values)
    far = (values[:, 4:] - values[:, :-4]) / jnp.maximum(world.t[:, 4:] - world.t[:, :-4], 1e-6)[..., None]
    far = jnp.concatenate([near[:, :2], far, near[:, -2:]], 1)
    return (4 * near - far) / 3, near


def slope(world: World, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rate of change (T, N, C) of forces from five samples, and by how much it is in doubt.

    Three samples alone take sin(w) for w [rad a sample]: a low-pass would come out too slow. Where a force
    bends too sharply for either, at a contact change, the flatter side counts (a minmod limiter: Sweby, SIAM
    J. Numer. Anal. 21, 1984): before a contact there is no force yet.
    """
    smooth, near = fivepoint(world, force)
    side = (force[:, 1:] - force[:, :-1]) / jnp.maximum(world.t[:, 1:] - world.t[:, :-1], 1e-6)[..., None]
    left, right = jnp.concatenate([side[:, :1], side], 1), jnp.concatenate([side, side[:, -1:]], 1)
    sharp = _sharp(left, right, EVEN / sampling_interval(world))
    flatter = jnp.where(left * right > 0, jnp.where(jnp.abs(left) < jnp.abs(right), left, right), 0.0)
    doubt = (1 - sharp) * jnp.abs(smooth - near) + sharp * jnp.abs(smooth - flatter)
    return smooth + sharp * (flatter - smooth), doubt


def sensed(world: World, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Net force, grip and shear (T, N, 4) behind each sensor's low-pass and delay, and their variance.

    The low-pass is exact between samples for straight lines. The variance is that of what is read between
    two samples: a contact may have changed before or after, for both fingers at once.
    """

    def slow(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        return lowpass(f, world.smoothing, sampling_interval(world)), _unsure(
            f, world.smoothing, sampling_interval(world)
        )

    def late(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        steps = world.delay / sampling_interval(world)

        def one(f: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
            _, old, new, _, ahead = _around(f, -steps)  # read (1 - ahead) of a sample after the later one
            return old + ahead * (new - old), jnp.sqrt(ahead * (1 - ahead) + 1e-12) * EITHER * (new - old)

        return jax.vmap(one, (2, 0), 2)(f, jnp.broadcast_to(steps, f.shape[2:]))

    modes = jnp.asarray(world.modes)
    prompt = (force, jnp.zeros_like(force))

    def fingers(net: jax.Array) -> tuple[jax.Array, jax.Array]:
        each = jnp.concatenate([net[..., :2] / 2 + net[..., 2:], net[..., :2] / 2 - net[..., 2:]], -1)
        smooth, jumps = jax.lax.cond(modes[SMOOTH] > 0, slow, lambda f: (f, jnp.zeros_like(f)), each)
        delayed, either = jax.lax.cond(modes[LATE] > 0, late, lambda f: (f, jnp.zeros_like(f)), smooth)
        return net_forces(delayed), jumps + jnp.square(net_forces(either))

    return jax.lax.cond(modes[SMOOTH] + modes[LATE] > 0, fingers, lambda f: prompt, force)


def when(world: World, mode: int, change: Callable[[jax.Array], jax.Array], values: jax.Array) -> jax.Array:
    """Changed values where a candidate has the mode; else the change is not even evaluated."""
    return jax.lax.cond(jnp.asarray(world.modes)[mode] > 0, change, lambda v: v, values)


def _unsure(values: jax.Array, time: jax.Array, step: jax.Array) -> jax.Array:
    """Variance (T, N, 4) of net force, grip and shear behind the low-pass of each finger's force (T, N, 4),
    from what may have changed at any moment between two samples, for both fingers at once."""
    ratio = step / jnp.maximum(jnp.reshape(time, (1, 1, -1)), 1e-4)
    share = (1 - jnp.exp(-2 * ratio)) / (2 * ratio) - jnp.square((1 - jnp.exp(-ratio)) / ratio)
    change = jnp.concatenate([jnp.zeros_like(values[:, :1]), values[:, 1:] - values[:, :-1]], 1)
    sd = EITHER * jnp.sqrt(jnp.maximum(share, 1e-12)) * change
    return faded(jnp.square(net_forces(sd)), 2 * jnp.mean(ratio))


def doubt_between(world: World) -> jax.Array:
    """Variance (T, N, 4) [N^2] of forces before delay and low-pass, from how sharply they bend."""

    def rough(f: jax.Array) -> jax.Array:
        def one(f: jax.Array, steps: jax.Array) -> jax.Array:
            p0, p1, p2, p3, share = _around(f, steps)
            share = share * (1 - share)
            bend = jnp.maximum(jnp.abs(p2 - 2 * p1 + p0), jnp.abs(p3 - 2 * p2 + p1))
            # A change that neither side continues may have come at any moment between the two samples.
            jump = jnp.maximum(jnp.abs(p2 - p1) - jnp.maximum(jnp.abs(p1 - p0), jnp.abs(p3 - p2)), 0.0)
            return jnp.square(BETWEEN * share * bend) + share * jnp.square(EITHER * jump)

        return jax.vmap(one, (2, 0), 2)(
            f, jnp.broadcast_to(world.delay / sampling_interval(world), f.shape[2:])
        )

    def steep(f: jax.Array) -> jax.Array:
        return jnp.square(CURVED * per_channel(world.smoothing) * slope(world, f)[1])

    force = jnp.asarray(world.force)
    late = jax.lax.cond(jnp.asarray(world.modes)[LATE] > 0, rough, jnp.zeros_like, force)
    return late + jax.lax.cond(jnp.asarray(world.modes)[SMOOTH] > 0, steep, jnp.zeros_like, force)


# Mechanics with a memory: a mode that rings, a support that yields late, pads that creep.


def sunk(world: World, load: jax.Array) -> jax.Array:
    """How far (T, N) [m] the support yields to what it carries of a block's weight, with its delay.

    Before a grip it has settled under the block; it carries nothing of one that is in the air.
    """

    def sinking(load: jax.Array) -> jax.Array:
        borne = load * (1 - world.carry)
        ratio = sampling_interval(world) / jnp.maximum(world.support_time, 1e-4)
        keep = jnp.exp(-ratio)
        new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
        before = jnp.concatenate([borne[:, :1], borne[:, :-1]], 1)

        def step(depth, now):
            drive, borne, free, carry = now
            depth = (1 - carry) * ((1 - free) * (keep * depth + drive) + free * borne)
            return depth, depth

        rows = tuple(z.T for z in (new * borne + old * before, borne, world.free, world.carry))
        _, out = jax.lax.scan(step, borne[:, 0], rows)
        return out.T

    return world.give_support * when(world, YIELDING, sinking, load)


def driven(world: World, force: jax.Array, back: bool) -> jax.Array:
    """Loads (T, N, C) with the mode that their changes ring; `back`: the loads that rang to these readings.

    The load goes straight from sample to sample: exact in between, a step at a time.
    """
    frequency, damping, drive = (jnp.asarray(world.ring)[k] for k in range(3))
    # The mode as a complex number: (keep_r, keep_i) turns it by a step, (gain_r, gain_i) is what a unit of
    # load, put on evenly over that step, rings it to: (keep - 1) / (fall + 1j turn).
    angle = 2 * jnp.pi * frequency * sampling_interval(world)
    fall, turn = -damping * angle, jnp.sqrt(jnp.maximum(1 - damping**2, 1e-6)) * angle
    keep_r, keep_i = jnp.exp(fall) * jnp.cos(turn), jnp.exp(fall) * jnp.sin(turn)
    size = fall**2 + turn**2
    gain_r = ((keep_r - 1) * fall + keep_i * turn) / size
    gain_i = (keep_i * fall - (keep_r - 1) * turn) / size

    def step(state, now):
        load, ring_r, ring_i = state
        free_r = keep_r * ring_r - keep_i * ring_i - gain_r * load
        free_i = keep_r * ring_i + keep_i * ring_r - gain_i * load
        new = (now - drive * free_i) / (1 + drive * gain_i) if back else now
        state = new, free_r + gain_r * new, free_i + gain_i * new
        return state, new if back else new + drive * state[2]

    start = force[:, 0], jnp.zeros_like(force[:, 0]), jnp.zeros_like(force[:, 0])
    _, out = jax.lax.scan(step, start, jnp.moveaxis(force, 1, 0))
    return jnp.moveaxis(out, 0, 1)


def relaxed(world: World, force: jax.Array) -> jax.Array:
    """Forces (T, N, 4) that would give the pads' displacement at once, for pads that creep."""

    def crept(f: jax.Array) -> jax.Array:
        return f + world.creep * (lowpass(f, world.creep_time, sampling_interval(world)) - f)

    return when(world, CREEPING, crept, force)


# Grips: how firmly they hold, and values less what stays the same while one holds.

HELD = 0.1  # chosen: N; a grip below this holds nothing,
# chosen: nor one below this share of its usual force: pads that let go slide by what shears they bear
LOOSE = 0.35
USUAL = 11.0  # numerics: logit of the weight of a grip of the usual force
SLIDE = 2e-3  # prior: m; how far a pad may slide from one sample to the next
ANYWHERE = 0.05  # prior: m; sd of where a grip takes its block


def firmness(grip: jax.Array, held: jax.Array, moves: jax.Array, loose: float = LOOSE) -> jax.Array:
    """How surely (T, N) a grip's pads hold the block rather than slide on it as they close or let go."""
    mine = moves * held[..., None]
    usual = jnp.einsum("tnm,tn->tm", mine, grip) / jnp.maximum(mine.sum(1), 1.0)
    least = jnp.maximum(HELD, loose * jnp.einsum("tnm,tm->tn", moves, usual))
    return jax.nn.sigmoid((grip / least - 1) * USUAL / (1 / loose - 1))


def recorded(arrays: Arrays, channel: str) -> jax.Array:
    """Where (T, N) a channel's residual is defined and its signals were recorded."""
    return jnp.asarray(arrays.there[..., CHANNELS.index(channel)])


def less_mean(values: jax.Array, arrays: Arrays, weight: jax.Array, place: jax.Array | None) -> jax.Array:
    """Values (T, N) less their weighted mean in every grip (pickup and place apart if `place` is given)."""
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
    return out * weight


def in_grip(
    values: jax.Array, firm: jax.Array, channel: str, arrays: Arrays, noise: jax.Array, world: World
) -> tuple[jax.Array, jax.Array]:
    """Values (T, N) that are one constant in every grip, less that constant; and their variance's factor.

    Where pads may slide the constant walks at random; the values are less its prediction from those before.
    """
    weight = firm * recorded(arrays, channel)
    sd = noise[..., CHANNELS.index(channel)]

    def followed(values: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _followed(values, weight, sd, world.slip, jnp.asarray(arrays.onehot))

    def centred(values: jax.Array) -> tuple[jax.Array, jax.Array]:
        return less_mean(values, arrays, weight, None), jnp.ones_like(values)

    return jax.lax.cond(jnp.asarray(world.modes)[SLIDING] > 0, followed, centred, values)


def _followed(
    values: jax.Array, weight: jax.Array, sd: jax.Array, slip: jax.Array, grips: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Innovations (T, N) of a Kalman filter, and their variances over sd squared.

    The state is where a grip holds its block; it walks by SLIDE from one sample to the next where pads slide
    at either. A grip's first value sets it and tells nothing.
    """
    other = jnp.concatenate([jnp.ones_like(slip[:, :1]), 1 - (grips[:, 1:] * grips[:, :-1]).sum(-1)], 1)
    before = jnp.concatenate([slip[:, :1], slip[:, :-1]], 1)
    walk = jnp.square(jnp.maximum(slip, before) * SLIDE)

    def step(state, now):
        place, variance, fresh = state
        value, w, s, q, new = now
        variance = jnp.where(new > 0.5, ANYWHERE**2, variance + q)
        fresh = jnp.where(new > 0.5, 1.0, fresh)
        factor = 1 + w * variance / s**2
        miss = value - place
        place = place + w * variance / (s**2 * factor) * miss
        known = 1 - fresh
        out = known * w * miss, 1 + known * (factor - 1)
        return (place, variance / factor, fresh * (1 - w)), out

    rows = [jnp.moveaxis(z, 1, 0) for z in (values, weight, sd, walk, other)]
    start = (values[:, 0], jnp.full_like(values[:, 0], ANYWHERE**2), jnp.ones_like(values[:, 0]))
    _, (out, factor) = jax.lax.scan(step, start, tuple(rows))
    return jnp.moveaxis(out, 0, 1), jnp.moveaxis(factor, 0, 1)


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
