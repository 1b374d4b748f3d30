"""The contact equations as residuals: what a recording violates once an effect is taken out of it.

Every sample gives as many equations between its four positions and four forces as unknowns leave
(docs/gap.md): in free motion all forces are zero; held, the fingers' distance and offset follow the
pads' forces; on the ground the block rests; in the air its net force is mass times
acceleration and weight. Velocities are checked against
positions. None of them multiplies position noise by a stiffness.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter
from scipy.special import expit

from hmmseg.contact.equations import Pads, block_offset, block_width, block_x, block_y, support_load
from simgap.effects.base import (
    CREEPING,
    LATE,
    RINGING,
    SMOOTH,
    YIELDING,
    DeadBand,
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


def net_forces(force: np.ndarray) -> np.ndarray:
    """Net force, grip and shear (T, N, 4) of both fingers' forces (T, N, 4)."""
    one, two = force[..., :2], force[..., 2:]
    return np.concatenate([one + two, (one - two) / 2], -1)


def sampling_interval(world: World) -> float:
    """The usual time [s] from one sample to the next."""
    return float(np.median(np.diff(world.t, axis=1)))


def shifted(values: np.ndarray, steps: np.ndarray | float) -> np.ndarray:
    """Values (T, N, C) read `steps` samples later (a number or (C,), a fraction allowed): cubic Catmull-Rom.

    Where they have a corner between two samples, as at a contact change, both sides go straight on to it:
    before a contact there is no force yet. Sides that would not meet between the two are joined straight.
    """
    p0, p1, p2, p3, s = _around(values, steps)
    cubic = ((-p0 + 3 * p1 - 3 * p2 + p3) * s + (2 * p0 - 5 * p1 + 4 * p2 - p3)) * s + (p2 - p0)
    before, across, after = p1 - p0, p2 - p1, p3 - p2
    convex = after > before
    before, after = (
        np.where(convex, one(side, across), other(side, across))
        for side, one, other in ((before, np.minimum, np.maximum), (after, np.maximum, np.minimum))
    )
    left, right = p1 + s * before, p2 - (1 - s) * after
    corner = np.where(convex, np.maximum(left, right), np.minimum(left, right))
    corner = np.clip(corner, np.minimum(p1, p2), np.maximum(p1, p2))
    smooth = p1 + 0.5 * s * cubic
    return smooth + _sharp(p1 - p0, p3 - p2, EVEN) * (corner - smooth)


def _around(values: np.ndarray, steps: np.ndarray | float) -> tuple[np.ndarray, ...]:
    """Four neighbours of (T, N, C) read `steps` samples later, a number or (C,), and the fraction (C,)
    between the middle two."""
    steps = np.broadcast_to(steps, values.shape[2:])
    whole, n = np.floor(steps).astype(int), values.shape[1]
    index = np.arange(n)[:, None] + whole
    each = (np.take_along_axis(values, np.clip(index + k, 0, n - 1)[None], axis=1) for k in (-1, 0, 1, 2))
    return *each, steps - whole


def _sharp(left: np.ndarray, right: np.ndarray, even: float) -> np.ndarray:
    """How surely (0 to 1) changes on both sides are those of a corner; both are alike below `even`.

    A force that rises and falls as fast has a crest there: at a corner one side is flatter than the other.
    """
    left, right = np.abs(left), np.abs(right)
    return expit((np.abs(left - right) / (left + right + even) - SHARP) / 0.08)


def fivepoint(world: World, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of change (T, N, C) from five samples, exact to fourth order, and from three."""
    near = gradient(world.t, values)
    far = (values[:, 4:] - values[:, :-4]) / np.maximum(world.t[:, 4:] - world.t[:, :-4], 1e-6)[..., None]
    far = np.concatenate([near[:, :2], far, near[:, -2:]], 1)
    return (4 * near - far) / 3, near


def slope(world: World, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of change (T, N, C) of forces from five samples, and by how much it is in doubt.

    Three samples alone take sin(w) for w [rad a sample]: a low-pass would come out too slow. Where a force
    bends too sharply for either, at a contact change, the flatter side counts (a minmod limiter: Sweby, SIAM
    J. Numer. Anal. 21, 1984): before a contact there is no force yet.
    """
    smooth, near = fivepoint(world, force)
    side = (force[:, 1:] - force[:, :-1]) / np.maximum(world.t[:, 1:] - world.t[:, :-1], 1e-6)[..., None]
    left, right = np.concatenate([side[:, :1], side], 1), np.concatenate([side, side[:, -1:]], 1)
    sharp = _sharp(left, right, EVEN / sampling_interval(world))
    flatter = np.where(left * right > 0, np.where(np.abs(left) < np.abs(right), left, right), 0.0)
    doubt = (1 - sharp) * np.abs(smooth - near) + sharp * np.abs(smooth - flatter)
    return smooth + sharp * (flatter - smooth), doubt


def sensed(world: World, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Net force, grip and shear (T, N, 4) behind each sensor's low-pass and delay, and their variance.

    The low-pass is exact between samples for straight lines. The variance is that of what is read between
    two samples: a contact may have changed before or after, for both fingers at once.
    """

    variance = np.zeros_like(force)
    if not (world.modes[SMOOTH] or world.modes[LATE]):
        return force, variance
    each = np.concatenate([force[..., :2] / 2 + force[..., 2:], force[..., :2] / 2 - force[..., 2:]], -1)
    step = sampling_interval(world)
    if world.modes[SMOOTH]:
        variance = variance + _unsure(each, world.smoothing, step)
        each = lowpass(each, world.smoothing, step)
    if world.modes[LATE]:
        # Read (1 - ahead) of a sample after the later one.
        _, old, new, _, ahead = _around(each, -world.delay / step)
        either = np.sqrt(ahead * (1 - ahead) + 1e-12) * EITHER * (new - old)
        each, variance = old + ahead * (new - old), variance + np.square(net_forces(either))
    return net_forces(each), variance


def _unsure(values: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """Variance (T, N, 4) of net force, grip and shear behind the low-pass of each finger's force (T, N, 4),
    from what may have changed at any moment between two samples, for both fingers at once."""
    ratio = step / np.maximum(time, 1e-4)
    share = (1 - np.exp(-2 * ratio)) / (2 * ratio) - np.square((1 - np.exp(-ratio)) / ratio)
    change = np.concatenate([np.zeros_like(values[:, :1]), values[:, 1:] - values[:, :-1]], 1)
    sd = EITHER * np.sqrt(np.maximum(share, 1e-12)) * change
    return faded(np.square(net_forces(sd)), 2 * float(np.mean(ratio)))


def doubt_between(world: World) -> np.ndarray:
    """Variance (T, N, 4) [N^2] of forces before delay and low-pass, from how sharply they bend."""
    out = np.zeros_like(world.force)
    if world.modes[LATE]:
        p0, p1, p2, p3, share = _around(world.force, world.delay / sampling_interval(world))
        share = share * (1 - share)
        bend = np.maximum(np.abs(p2 - 2 * p1 + p0), np.abs(p3 - 2 * p2 + p1))
        # A change that neither side continues may have come at any moment between the two samples.
        jump = np.maximum(np.abs(p2 - p1) - np.maximum(np.abs(p1 - p0), np.abs(p3 - p2)), 0.0)
        out = np.square(BETWEEN * share * bend) + share * np.square(EITHER * jump)
    if world.modes[SMOOTH]:
        out = out + np.square(CURVED * world.smoothing * slope(world, world.force)[1])
    return out


# Mechanics with a memory: a mode that rings, a support that yields late, pads that creep.


def sunk(world: World, load: np.ndarray) -> np.ndarray:
    """How far (T, N) [m] the support yields to what it carries of a block's weight, with its delay.

    Before a grip it has settled under the block; it carries nothing of one that is in the air.
    """
    if not world.modes[YIELDING]:
        return world.give_support * load
    from simgap.recursions import recursion

    borne = load * (1 - world.carry)
    ratio = sampling_interval(world) / np.maximum(world.support_time, 1e-4)
    keep = np.exp(-ratio)
    new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
    drive = new * borne + old * np.concatenate([borne[:, :1], borne[:, :-1]], 1)
    stays, free = (1 - world.carry) * (1 - world.free), (1 - world.carry) * world.free
    return world.give_support * recursion(keep * stays, stays * drive + free * borne, borne[:, 0])


def driven(world: World, force: np.ndarray, back: bool) -> np.ndarray:
    """Loads (T, N, C) with the mode that their changes ring; `back`: the loads that rang to these readings.

    The load goes straight from sample to sample: exact in between, a step at a time.
    """
    frequency, damping, drive = world.ring
    # The mode as a complex number z: `keep` turns it by a step, `gain` is what a unit of load, put on evenly
    # over that step, rings it to, so that z[k] = keep z[k-1] + gain (f[k] - f[k-1]); readings are
    # f + drive Im z: a rational filter of loads, and its inverse.
    rate = complex(-damping, np.sqrt(max(1 - damping**2, 1e-6))) * 2 * np.pi * frequency
    rate *= sampling_interval(world)
    keep = np.exp(rate)
    gain = (keep - 1) / rate
    poles = np.array([1.0, -2 * keep.real, abs(keep) ** 2])
    ring = np.convolve([gain.imag, -(gain * keep.conjugate()).imag], [1.0, -1.0])
    loads, rest = poles + drive * ring, force[:, :1]
    top, bottom = (poles, loads) if back else (loads, poles)
    return rest + np.asarray(lfilter(top, bottom, force - rest, axis=1))


def relaxed(world: World, force: np.ndarray) -> np.ndarray:
    """Forces (T, N, 4) that would give the pads' displacement at once, for pads that creep."""
    if not world.modes[CREEPING]:
        return force
    return force + world.creep * (lowpass(force, world.creep_time, sampling_interval(world)) - force)


# Grips: how firmly they hold, and values less what stays the same while one holds.

HELD = 0.1  # chosen: N; a grip below this holds nothing,
# chosen: nor one below this share of its usual force: pads that let go slide by what shears they bear
LOOSE = 0.35
USUAL = 11.0  # numerics: logit of the weight of a grip of the usual force
SLIDE = 2e-3  # prior: m; how far a pad may slide from one sample to the next
ANYWHERE = 0.05  # prior: m; sd of where a grip takes its block


def firmness(grip: np.ndarray, held: np.ndarray, moves: np.ndarray, loose: float = LOOSE) -> np.ndarray:
    """How surely (T, N) a grip's pads hold the block rather than slide on it as they close or let go."""
    mine = moves * held[..., None]
    usual = (grip[:, None] @ mine)[:, 0] / np.maximum(mine.sum(1), 1.0)
    least = np.maximum(HELD, loose * (moves @ usual[..., None])[..., 0])
    return expit((grip / least - 1) * USUAL / (1 / loose - 1))


def recorded(arrays: Arrays, channel: str) -> np.ndarray:
    """Where (T, N) a channel's residual is defined and its signals were recorded."""
    return arrays.there[..., CHANNELS.index(channel)]


# prior: shares of the variance of anywhere in a dead band, by which joints move unseen between two samples,
# and their chances: as a rule they do not
SHARES, CHANCES = np.array([0.0, 0.01, 1.0]), np.array([0.8, 0.1, 0.1])


def in_grip(
    values: np.ndarray, weight: np.ndarray, noise: np.ndarray, firm: np.ndarray, world: World,
    arrays: Arrays,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """x, y, distance and offset (T, N, 4), of which all but the distance are one constant in every grip, less
    their prediction from the samples before; its variance over the `noise`'s squared, and what unseen moves
    cost [nats].

    A block on the ground is taken along by a hand that moves: it stays where it was pushed to. Pads may
    slide, and joints move in their dead bands. A grip's first value sets its constant and says nothing; the
    distance counts as `firm`ly as the block is held.
    """
    from simgap.recursions import tracked

    slide = _wider(SLIDE * world.slip)
    walk = np.square(np.stack([_wider(arrays.pushed), slide, slide], -1))
    band, none = world.dead_band, np.zeros((*firm.shape, 0))
    if band is None:
        band, levers = DeadBand(none, none > 0, none, none, none[:, 0]), np.zeros((*firm.shape, 4, 0))
    else:
        (x, y), apart = swung(world), np.array([-1.0, -1.0, 1.0, 1.0])
        levers = np.stack([x / 2, y / 2, apart * x * firm[..., None], apart * y], -2)
        values = values - (levers @ band.place[..., None])[..., 0]
    return tracked(
        values, weight, noise, -levers, walk, arrays.new, ANYWHERE**2, band.pinned, band.place, band.drift,
        band.wander, band.jump, SHARES, CHANCES,
    )  # fmt: skip


def _wider(values: np.ndarray) -> np.ndarray:
    """The larger of each value (T, N) and the one before."""
    return np.maximum(values, np.concatenate([values[:, :1], values[:, :-1]], 1))


TOUCH = 2e-5  # numerics: m; the corner of contact is rounded over this depth, below the joints' resolution
SURE = 4.0  # chosen: sds of the distance by which fingers must be nearer than the block is wide to touch it
CLOSED = 0.8  # chosen: share of its usual force by which a grip has closed: until then it pushes the block


def residuals(
    world: World, arrays: Arrays, properties: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Residuals (T, N, C) in units of the channels, how far their variance exceeds `noise` squared, and what
    joints cost [nats] that move unseen.

    `properties` (O, 3): weight, width, height. The variance's factor is 1 where the correction of an effect
    leaves nothing in doubt.
    """
    weight, width = np.moveaxis(arrays.onehot @ (arrays.objects @ properties[:, :2]), -1, 0)
    rise = arrays.onehot @ (arrays.rises @ properties[:, 2])
    position, velocity = tips(world)
    force = contact(world)
    pads = relaxed(world, force)
    x1, y1, x2, y2 = (position[..., k] for k in range(4))
    fx1, fy1, fx2, fy2 = (pads[..., k] for k in range(4))
    couple = world.couple * weight / np.maximum(width, 1e-3) * world.carry
    fy1, fy2 = fy1 + couple, fy2 - couple
    (n1, n2), (s1, s2) = world.give_normal, world.give_shear

    pads_give = Pads(n1, n2, s1, s2)
    gap = x2 - x1 - width
    squeeze = block_width(0.0, fx1, fx2, pads_give)
    # Pads that have crept come back late: fingers may be nearer for a while without pressing.
    late = (pads - force)[..., 0] * n1 - (pads - force)[..., 2] * n2
    # A distance known to so much says nothing of a lighter touch: its noise would come out as force.
    unsure = SURE * arrays.sd[..., CHANNELS.index("distance")]
    touching = TOUCH * np.logaddexp(0.0, -(gap + late + unsure * world.free) / TOUCH)
    held = world.ground + world.carry
    firm = firmness(0.5 * (force[..., 0] - force[..., 2]), held, arrays.onehot)
    # Held firmly the fingers are as far apart as the block is wide, pads or none; else only not nearer.
    distance = firm * (squeeze + gap) + (1 - firm) * (squeeze - late - touching)
    place = arrays.phase[..., Phase.PLACE]
    offset = block_offset(y2 - y1, fy1, fy2, pads_give) + world.hang * width * world.carry
    x = block_x((x1 + x2) / 2, fx1, fx2, pads_give)
    load = support_load(weight, force[..., 1] + force[..., 3])
    y = block_y((y1 + y2) / 2, fy1, fy2, pads_give) + sunk(world, load)
    y = y - np.tan(world.tilt) * (x1 + x2) / 2 - rise * place
    # Fingers that close push the block and slide on it until both hold it: only then it rests.
    lesser = np.minimum(force[..., 0], -force[..., 2])
    both = firmness(lesser, held, arrays.onehot, CLOSED)
    closed = firm * both
    still = closed * (arrays.phase[..., Phase.PICKUP] + place)
    there = arrays.there[..., :4]
    weight_of = np.stack([still, closed * world.ground, held, closed * held], -1) * there
    sd = np.sqrt(np.square(noise[..., :4]) + _doubt(world, firm))
    geometry, loose, unseen = in_grip(
        np.stack([x, y, distance, offset], -1) + world.off, weight_of, sd, firm, world, arrays
    )
    factor = loose * np.square(sd / noise[..., :4])

    acceleration, _ = fivepoint(world, velocity)
    ax, ay = ((acceleration[..., k] + acceleration[..., k + 2]) / 2 for k in (0, 1))
    mass = weight / world.gravity * world.inertia
    ground, carry = world.ground, world.carry
    net_x = carry * mass * ax + ground * (force[..., 0] + force[..., 2])
    net_y = carry * (weight + mass * ay) + ground * (force[..., 1] + force[..., 3])
    half = (force[..., 0] - force[..., 2]) / 2, (force[..., 1] - force[..., 3]) / 2
    free = touching / np.maximum(n1 + n2, 2e-4) * world.free
    expected = np.stack([net_x, net_y, held * half[0] + free, held * half[1]], -1) + net_forces(world.load)
    filtered, either = sensed(world, expected)
    if world.modes[RINGING]:
        filtered = driven(world, filtered, back=False)
    forces = (net_forces(world.force) - filtered) * world.loudness

    mean_p = (position[..., :2] + position[..., 2:]) / 2
    mean_v = (velocity[..., :2] + velocity[..., 2:]) / 2
    speeds = _compact(mean_v) - gradient(world.t, mean_p)
    # In the units of what was recorded: an effect must not gain by scaling the noise down.
    size = np.mean(world.link)
    return (
        np.concatenate([geometry / size, speeds / size, forces], -1),
        np.concatenate([factor, np.ones_like(speeds), 1 + either / np.square(noise[..., 6:])], -1),
        unseen,
    )


def _doubt(world: World, firm: np.ndarray) -> np.ndarray:
    """Variance (T, N, 4) [m^2] of x, y, distance and offset from what is in doubt of forces."""
    if not (world.modes[LATE] or world.modes[SMOOTH]):
        return np.zeros((*firm.shape, 4))
    pads = doubt_between(world)
    x = (pads[..., ::2] * np.square(world.give_normal)).sum(-1)
    y = (pads[..., 1::2] * np.square(world.give_shear)).sum(-1)
    return np.stack([x / 4, y / 4, x, y], -1) * np.square(firm)[..., None]


def _compact(v: np.ndarray) -> np.ndarray:
    """(v[k-1] + 4 v[k] + v[k+1]) / 6, the mean velocity that central differences have to fourth order."""
    inner = (v[:, :-2] + 4 * v[:, 1:-1] + v[:, 2:]) / 6
    return np.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def contact(world: World) -> np.ndarray:
    """Forces (T, N, 4) of the contacts: before delay and low-pass, before they rang a mode, without loads."""
    force = world.force
    if world.modes[RINGING]:
        force = driven(world, force, back=True)
    if world.modes[LATE]:
        force = shifted(force, world.delay / sampling_interval(world))
    if world.modes[SMOOTH]:
        force = force + world.smoothing * slope(world, force)[0]
    return force - world.load
