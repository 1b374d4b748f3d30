"""The contact equations as residuals: what a recording violates once an effect is corrected for.

Every sample gives as many equations between its four positions and four forces as its unknowns leave
(docs/gap.md): in free motion all forces are zero; in a grip, distance and offset of the fingers follow the
pads' forces; on the ground the block rests; in the air its net force is mass times acceleration plus weight.
Velocities are checked against positions. No equation multiplies the noise of a position by a stiffness.
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
    middle,
    swung,
    tips,
)
from simgap.effects.filters import faded, lowpass
from simgap.gap.frame import CHANNELS, OFFSET, Arrays
from simgap.phases import Phase

# Forces between two samples: their interpolation, their slopes, and the uncertainty of both.

BETWEEN = 0.3  # prior: sd of a force between two samples, over its bend
CURVED = 0.5  # prior: sd of a slope, over the difference of two estimates of it
EVEN = 0.025  # chosen: N; smaller changes between samples have no corner
SHARP = 0.75  # chosen: difference of the two sides over their sum, above which a force has a corner
EITHER = 0.6  # prior: sd of a force between two samples, over its change


def net_forces(force: np.ndarray) -> np.ndarray:
    """Net force, grip and shear (T, N, 4) of both fingers' forces (T, N, 4)."""
    one, two = force[..., :2], force[..., 2:]
    return np.concatenate([one + two, (one - two) / 2], -1)


def sampling_interval(world: World) -> float:
    """Median time between samples [s]."""
    return float(np.median(np.diff(world.t, axis=1)))


def shifted(values: np.ndarray, steps: np.ndarray | float) -> np.ndarray:
    """Values (T, N, C) read `steps` samples later, by cubic Catmull-Rom interpolation.

    At a corner between two samples, such as a contact change, both sides are extrapolated linearly instead:
    before a contact there is no force. Sides that would not meet between the samples are joined by a straight
    line. `steps` is a number or (C,), fractions allowed.
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
    """Four neighbours of values (T, N, C) read `steps` samples later, and the fraction (C,) between the
    middle two.
    """
    steps = np.broadcast_to(steps, values.shape[2:])
    whole, n = np.floor(steps).astype(int), values.shape[1]
    index = np.arange(n)[:, None] + whole
    each = (np.take_along_axis(values, np.clip(index + k, 0, n - 1)[None], axis=1) for k in (-1, 0, 1, 2))
    return *each, steps - whole


def _sharp(left: np.ndarray, right: np.ndarray, even: float) -> np.ndarray:
    """How surely (0 to 1) the changes on both sides are those of a corner; they are alike below `even`.

    A force that rises and falls equally fast has a crest there: at a corner one side is flatter than the
    other.
    """
    left, right = np.abs(left), np.abs(right)
    return expit((np.abs(left - right) / (left + right + even) - SHARP) / 0.08)


def fivepoint(world: World, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates of change (T, N, C) from five samples, accurate to fourth order, and from three."""
    near = gradient(world.t, values)
    far = (values[:, 4:] - values[:, :-4]) / np.maximum(world.t[:, 4:] - world.t[:, :-4], 1e-6)[..., None]
    far = np.concatenate([near[:, :2], far, near[:, -2:]], 1)
    return (4 * near - far) / 3, near


def slope(world: World, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of change (T, N, C) of forces from five samples, and its uncertainty.

    Three samples alone give sin(w) for w [rad per sample]: a low-pass would appear too slow. Where a force
    bends too sharply for either, at a contact change, the flatter side counts (a minmod limiter: Sweby, SIAM
    J. Numer. Anal. 21, 1984): before a contact there is no force.
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

    The low-pass is exact for forces that are linear between samples. The variance is that of readings between
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
        # Read at 1 - ahead of a sample after the later one.
        _, old, new, _, ahead = _around(each, -world.delay / step)
        either = np.sqrt(ahead * (1 - ahead) + 1e-12) * EITHER * (new - old)
        each, variance = old + ahead * (new - old), variance + np.square(net_forces(either))
    return net_forces(each), variance


def _unsure(values: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """Variance (T, N, 4) of net force, grip and shear behind the low-pass of each finger's force (T, N, 4).

    A change between two samples may have happened at any moment, for both fingers at once.
    """
    ratio = step / np.maximum(time, 1e-4)
    share = (1 - np.exp(-2 * ratio)) / (2 * ratio) - np.square((1 - np.exp(-ratio)) / ratio)
    change = np.concatenate([np.zeros_like(values[:, :1]), values[:, 1:] - values[:, :-1]], 1)
    sd = EITHER * np.sqrt(np.maximum(share, 1e-12)) * change
    return faded(np.square(net_forces(sd)), 2 * float(np.mean(ratio)))


def doubt_between(world: World) -> np.ndarray:
    """Variance (T, N, 4) [N^2] of forces before delay and low-pass, from their bends."""
    out = np.zeros_like(world.force)
    if world.modes[LATE]:
        p0, p1, p2, p3, share = _around(world.force, world.delay / sampling_interval(world))
        share = share * (1 - share)
        bend = np.maximum(np.abs(p2 - 2 * p1 + p0), np.abs(p3 - 2 * p2 + p1))
        # A change that continues on neither side may have happened at any moment between the two samples.
        jump = np.maximum(np.abs(p2 - p1) - np.maximum(np.abs(p1 - p0), np.abs(p3 - p2)), 0.0)
        out = np.square(BETWEEN * share * bend) + share * np.square(EITHER * jump)
    if world.modes[SMOOTH]:
        out = out + np.square(CURVED * world.smoothing * slope(world, world.force)[1])
    return out


# Mechanics with memory: a ringing mode, a support that yields late, pads that creep.


def sunk(world: World, load: np.ndarray) -> np.ndarray:
    """How far (T, N) [m] the support yields, with its delay, to the part of a block's weight that it carries.

    Before a grip it has settled under the block; it carries nothing of a lifted one.
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
    """Loads (T, N, C) with the oscillation of a mode that their changes excite.

    With `back` the loads behind such readings. Exact for loads that are linear between samples.
    """
    frequency, damping, drive = world.ring
    # The mode is a complex number z: `keep` turns it by one step, and `gain` is the oscillation excited by a
    # unit of load that rises evenly over that step, so that z[k] = keep z[k-1] + gain (f[k] - f[k-1]).
    # Readings are f + drive Im z: a rational filter of loads, which has an inverse.
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
    """Forces (T, N, 4) that would displace the pads as far at once, for pads that creep."""
    if not world.modes[CREEPING]:
        return force
    return force + world.creep * (lowpass(force, world.creep_time, sampling_interval(world)) - force)


# Grips: how firmly they hold, and positions relative to the constants of each grip.

HELD = 0.1  # chosen: N; a weaker grip holds nothing,
# chosen: nor one below this share of its usual force: pads that let go slide by as much as they shear
LOOSE = 0.35
USUAL = 11.0  # numerics: logit of the weight of a grip of the usual force
SLIDE = 2e-3  # prior: m; slip of a pad from one sample to the next
ANYWHERE = 0.05  # prior: m; sd of the place at which a grip takes its block


def firmness(grip: np.ndarray, held: np.ndarray, moves: np.ndarray, loose: float = LOOSE) -> np.ndarray:
    """How surely (T, N) a grip's pads hold the block rather than slide on it while they close or open."""
    mine = moves * held[..., None]
    usual = (grip[:, None] @ mine)[:, 0] / np.maximum(mine.sum(1), 1.0)
    least = np.maximum(HELD, loose * (moves @ usual[..., None])[..., 0])
    return expit((grip / least - 1) * USUAL / (1 / loose - 1))


# prior: variances of unseen motion of joints between two samples, as shares of that of anywhere in the dead
# band
SHARES = np.array([0.0, 0.01, 1.0])


def in_grip(
    values: np.ndarray, weight: np.ndarray, noise: np.ndarray, firm: np.ndarray, world: World,
    arrays: Arrays,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """x, y, distance and offset (T, N, 4) minus their prediction from earlier samples.

    All but the distance are constant within a grip, except that a hand that moves takes a block on the ground
    along, pads may slide, and joints move within their dead bands. The first value of a grip sets its
    constant and is no evidence.

    Args:
        values: x, y, distance and offset (T, N, 4) [m].
        weight: Weight (T, N, 4) of each value.
        noise: Its standard deviation (T, N, 4).
        firm: How surely (T, N) the block is held; weighs the distance.
        world: The world, corrected for effects.
        arrays: Constants of the equations.

    Returns:
        Residuals, their variance over the squared noise, and the cost of unseen motion [nats].
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
        band.wander, band.jump, SHARES,
    )  # fmt: skip


def _wider(values: np.ndarray) -> np.ndarray:
    """The larger of each value (T, N) and the one before."""
    return np.maximum(values, np.concatenate([values[:, :1], values[:, :-1]], 1))


TOUCH = 2e-5  # numerics: m; the onset of contact is rounded over this depth, below the joints' resolution
SURE = 4.0  # chosen: sds of the distance by which fingers must be closer than the block's width to touch it
STANCES = (0.6, 1.0)  # prior: distance between a block's feet over its width; values between are a mixture
CLOSED = 0.8  # chosen: share of its usual force at which a grip has closed: until then it pushes the block


def residuals(
    world: World, arrays: Arrays, properties: np.ndarray, turning: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Residuals of the contact equations.

    Args:
        world: The world, corrected for effects.
        arrays: Constants of the equations.
        properties: Weight [N], width and height [m] of the blocks (O, 3).
        turning: How easily blocks turn in the grip [rad/(N m)], for each of STANCES.
        noise: Standard deviation (T, N, C) of the residuals.

    Returns:
        Residuals (T, N, C) in units of the channels, their variance over the squared noise (1 where
            corrections
        leave no doubt), and the cost of unseen motion of joints [nats].
    """
    weight, width = np.moveaxis(arrays.onehot @ (arrays.objects @ properties[:, :2]), -1, 0)
    rise = arrays.onehot @ (arrays.rises @ properties[:, 2])
    position, velocity = tips(world)
    force = contact(world)
    pads = relaxed(world, force)
    x1, y1, x2, y2 = (position[..., k] for k in range(4))
    fx1, fy1, fx2, fy2 = (pads[..., k] for k in range(4))
    (n1, n2), (s1, s2) = world.give_normal, world.give_shear

    pads_give = Pads(n1, n2, s1, s2)
    apart = block_offset(y2 - y1, fy1, fy2, pads_give)
    turn, tipped, ease = turned(world, weight, width, turning, force, apart)
    # Grips at unequal heights are nearer to each other on a block that turns towards the lower one.
    sine = np.sin(turn)
    gap = x2 - x1 - width + sine * (apart - width * sine / 2)
    squeeze = block_width(0.0, fx1, fx2, pads_give)
    # Pads that have crept recover late: fingers may be closer for a while without pressing.
    late = (pads - force)[..., 0] * n1 - (pads - force)[..., 2] * n2
    # The distance does not determine lighter touches: its noise would appear as force.
    unsure = SURE * arrays.sd[..., CHANNELS.index("distance")]
    touching = TOUCH * np.logaddexp(0.0, -(gap + late + unsure * world.free) / TOUCH)
    held = world.ground + world.carry
    firm = firmness(0.5 * (force[..., 0] - force[..., 2]), held, arrays.onehot)
    # In a firm grip the fingers are as far apart as the block is wide, pads or none; else only not closer.
    distance = firm * (squeeze + gap) + (1 - firm) * (squeeze - late - touching)
    place = arrays.phase[..., Phase.PLACE]
    offset = apart + world.hang * width * world.carry - width * turn
    x = block_x((x1 + x2) / 2, fx1, fx2, pads_give)
    load = support_load(weight, force[..., 1] + force[..., 3])
    y = block_y((y1 + y2) / 2, fy1, fy2, pads_give) + sunk(world, load)
    y = y - np.tan(world.tilt) * (x1 + x2) / 2 - tipped - rise * place
    # Closing fingers push the block and slide on it; it rests only once both hold it.
    lesser = np.minimum(force[..., 0], -force[..., 2])
    both = firmness(lesser, held, arrays.onehot, CLOSED)
    closed = firm * both
    still = closed * (arrays.phase[..., Phase.PICKUP] + place)
    there = arrays.there[..., :4]
    weight_of = np.stack([still, closed * world.ground, held, closed * held], -1) * there
    sd = np.sqrt(np.square(noise[..., :4]) + _doubt(world, firm))
    wider = _misread_moment(world, arrays, width, ease, force, sd[..., OFFSET])
    sd[..., OFFSET] *= wider
    geometry, loose, unseen = in_grip(
        np.stack([x, y, distance, offset], -1) + world.off, weight_of, sd, firm, world, arrays
    )
    factor = loose * np.square(sd / noise[..., :4])
    # True moments are unknown one by one: their likeliest values leave the misfit over its variance, without
    # the variance's logarithm (total least squares).
    unseen -= float(np.log(wider[there[..., OFFSET] > 0]).sum())

    acceleration, _ = fivepoint(world, velocity)
    ax, ay = np.moveaxis(middle(acceleration), -1, 0)
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

    speeds = _compact(middle(velocity)) - gradient(world.t, middle(position))
    # In recorded units: an effect must not gain by scaling the noise down.
    size = np.mean(world.link)
    return (
        np.concatenate([geometry / size, speeds / size, forces], -1),
        np.concatenate([factor, np.ones_like(speeds), 1 + either / np.square(noise[..., 6:])], -1),
        unseen,
    )


def turned(
    world: World, weight: np.ndarray, width: np.ndarray, turning: np.ndarray, force: np.ndarray,
    apart: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Angle (T, N) [rad] by which a block turns in the grip to the left, how far (T, N) [m] it rises, and how
    easily (T, N) [rad/(N m)] it turns on.

    Balance of moments about the block's middle: shears of the fingers, the couple of grips at unequal heights
    and a mass off the middle turn a block against the pads unless its support holds it upright. The load of
    the support acts within the feet, so it withstands a moment up to the load times half the stance; beyond
    that the block tips about a foot and its middle rises.

    Args:
        world: The world, corrected for effects.
        weight, width: Of the nearest block (T, N) [N, m].
        turning: Compliance [rad/(N m)] for each of STANCES.
        force: Contact forces (T, N, 4) [N].
        apart: Height (T, N) of the right contact over the left [m].
    """
    grip, shear = (force[..., k] - force[..., 2 + k] for k in (0, 1))
    moment = grip / 2 * apart - shear * width / 2 - weight * world.couple * world.carry
    load = np.maximum(weight - force[..., 1] - force[..., 3], 0.0) * (1 - world.carry)
    turn, rise, ease = np.zeros_like(weight), np.zeros_like(weight), np.zeros_like(weight)
    for share, compliance in zip(STANCES, turning, strict=True):
        stance = share * width / 2
        beyond = np.maximum(np.abs(moment) - load * stance, 0.0)
        by = compliance * np.sign(moment) * beyond
        turn, rise = turn + by, rise + stance * np.abs(by) * (1 - world.carry)
        ease = ease + compliance * (beyond > 0)
    return turn, rise, ease


def _misread_moment(
    world: World, arrays: Arrays, width: np.ndarray, ease: np.ndarray, force: np.ndarray, sd: np.ndarray
) -> np.ndarray:
    """Standard deviation (T, N) of the offset with the noise of the moment that turns the block, over `sd`
    without it.

    The offset's own noise enters twice: grips at unequal heights turn the block, which takes some of it back.
    """
    shear = 2 * arrays.plain[..., CHANNELS.index("shear")]  # of the difference of both fingers' forces
    give = np.mean(world.give_shear)
    of_place = np.maximum(np.square(arrays.plain[..., OFFSET]) - np.square(give * shear), 0.0)
    left = 1 - width * ease * (force[..., 0] - force[..., 2]) / 2
    of_force = np.square((give * left + np.square(width) * ease / 2) * shear)
    more = np.square(left) * of_place + of_force - np.square(arrays.plain[..., OFFSET])
    return np.sqrt(1 + more / np.square(sd))


def _doubt(world: World, firm: np.ndarray) -> np.ndarray:
    """Variance (T, N, 4) [m^2] of x, y, distance and offset from the uncertainty of forces."""
    if not (world.modes[LATE] or world.modes[SMOOTH]):
        return np.zeros((*firm.shape, 4))
    pads = doubt_between(world)
    x = (pads[..., ::2] * np.square(world.give_normal)).sum(-1)
    y = (pads[..., 1::2] * np.square(world.give_shear)).sum(-1)
    return np.stack([x / 4, y / 4, x, y], -1) * np.square(firm)[..., None]


def _compact(v: np.ndarray) -> np.ndarray:
    """(v[k-1] + 4 v[k] + v[k+1]) / 6, the mean velocity of central differences to fourth order."""
    inner = (v[:, :-2] + 4 * v[:, 1:-1] + v[:, 2:]) / 6
    return np.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def contact(world: World) -> np.ndarray:
    """Contact forces (T, N, 4): before delay, low-pass and ringing, without loads."""
    force = world.force
    if world.modes[RINGING]:
        force = driven(world, force, back=True)
    if world.modes[LATE]:
        force = shifted(force, world.delay / sampling_interval(world))
    if world.modes[SMOOTH]:
        force = force + world.smoothing * slope(world, force)[0]
    return force - world.load
