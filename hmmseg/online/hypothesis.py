"""One hypothesis: its state, the likelihood of a reading under it, and its update by a reading.

A hypothesis is one history of contact states with its consequences, each quantity in additive form: means as
(precision x mean, precision), squared scales as (weighted sum of squares, weight). A precision of 0 means
that the quantity is unknown.

The log-likelihoods are those of hmmseg.segmentation.emissions (tested against them), with unknowns integrated
out: an unknown weight, width or level has a broad density over the range seen, and known ones add their
variance. A hand that is free, or carries, may also halt: otherwise a halt would pass for a rest on something,
which predicts positions much better. A block that was just lifted moves, and the load of a resting block is
that of the reading before: otherwise a block held on its support would pass for one not yet weighed that is
carried at rest, whose weight is the load on the fingers.

Everything is causal. A reading is the mean of the last WINDOW s, as off line; the vertical acceleration is
the slope of the velocity over the last SLOPE s, and an unmeasured velocity is the difference to the previous
row.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hmmseg.contact.equations import Pads, block_width, block_y, inertia_factor
from hmmseg.densities import EDGE, log_between, log_student
from hmmseg.levels import MOVED, SURE, TAIL
from hmmseg.online.compiled import compiled
from hmmseg.segmentation.emissions import LEAST_SCALE, MAX_RATE, ONE_FINGER, STRAY, TOUCHING, WINDOW
from hmmseg.segmentation.free_contacts import CLOSED

NUM_RING = 8  # numerics: most recent boundaries remembered; a move has four
# numerics: order of the residuals' scales, named as in hmmseg.segmentation.emissions
SCALES = ("force", "carry", "net_x", "shear", "velocity", "level", "width")
FORCE, CARRY, NET_X, SHEAR, VELOCITY, LEVEL, WIDTH = range(7)
FREE_KIND, GROUND_KIND, SLIDING_KIND, ABOVE_KIND = range(4)  # of contact states
# Evidence about blocks is a separate array (num_quantities, 2): weight [N] and width [m] of every block and
# of an unnamed one, then the rise [m] of every move.
HYPOTHESIS = np.dtype([
    ("weight", "f8"),  # log weight
    ("state", "i8"),  # subtasks of the round, then states off the task
    ("round", "i8"), ("crossed", "i8"),  # number of boundaries crossed
    ("missed", "i8"), ("left_at", "f8"),  # after a departure: missing subtask (-1: none), since when [s]
    ("entered", "f8", 2), ("origin", "f8", 2),  # mean and variance: time of entry [s], level at pickup [m]
    ("ring", "f8", (NUM_RING, 2)),  # mean and variance of the last boundaries [s]
    ("bias", "f8", (4, 2)), ("scale", "f8", (7, 2)), # evidence; level: of the support, or highest one carried
    ("level", "f8", 2),
    ("apart", "f8", 2), ("firm", "f8", 2),  # sum, weight: distance [m] of a grip; its force [N] while carried
])  # fmt: skip
READING = np.dtype([
    ("t", "f8"), ("force", "f8", 4), ("vx", "f8"), ("vy", "f8"), ("ay", "f8"), ("y", "f8"), ("d", "f8"),
    ("sd_y", "f8"), ("sd_d", "f8"), ("sd_vx", "f8"), ("sd_vy", "f8"),
    ("last_y", "f8"), ("last_d", "f8"), ("last_fy", "f8"),  # previous reading's; net fy 1 / MAX_RATE s before
    ("last_force", "f8", 4),  # the last ones that were read
    ("sd_fx", "f8"), ("sd_fy", "f8"),  # error of net forces from the tool on a wrist's sensor
    ("gripped", "f8"),  # known apart from forces: 0: nothing is held, 2: something is; 1: unknown
])  # fmt: skip
# Ranges of unconstrained quantities (see hmmseg.segmentation.emissions).
RANGES = np.dtype([(name, "f8") for name in ("vx", "vy", "y", "d", "force", "press")])
# A row kept for averages: reach of the joints' noise (x, y); forces, vx, vy, y and d; mean net fy.
ROW = np.dtype([("t", "f8"), ("reach", "f8", 2), ("value", "f8", 8), ("fy", "f8")])

Record = Any  # one element of such an array: numba gives it attributes, NumPy's types do not

SLOPE = 1.0 / MAX_RATE
ROWS = 512  # numerics: most rows kept: 20 kHz over SLOPE


@compiled
def read(
    rows: np.ndarray, head: int, filled: int, t: float, dt: float, channels: np.ndarray, jointed: bool,
    geometry: np.ndarray, measured: bool, before: np.ndarray, noise: np.ndarray, out: np.ndarray
) -> None:  # fmt: skip
    """Add a row to the ring and fill `out` with the reading at `t` [s].

    `rows` (ROWS,): ring whose newest row goes to `head`, with `filled` rows; `dt` [s] since the previous row,
    whose channels are `before` (12,). `channels` (12,): q11, q12, dq11, dq12, fx1, fy1, q21, ..., or x1, y1,
    vx1, vy1, ...; `geometry` (8,): bases and links of both fingers; `measured`: whether velocities are;
    `noise` (2,): squared noise of one position and of one velocity [rad or m, and per s].
    """
    here, x = rows[head], out[0]
    x.last_y, x.last_d = x.y, x.d
    here.t = t
    here.reach[:] = 0.0 if jointed else 1.0
    for k in range(4, 8):
        here.value[k] = 0.0
    for i in range(2):
        at, sign = 6 * i, 2.0 * i - 1.0
        here.value[2 * i], here.value[2 * i + 1] = channels[at + 4], channels[at + 5]
        tip_vx = tip_vy = math.nan
        if jointed:
            tip_x, tip_y, tip_vx, tip_vy = geometry[4 * i], geometry[4 * i + 1], 0.0, 0.0
            for j in range(2):
                link, q, dq = geometry[4 * i + 2 + j], channels[at + j], channels[at + 2 + j]
                across, along = link * math.cos(q), link * math.sin(q)
                tip_x, tip_y = tip_x + across, tip_y + along
                tip_vx, tip_vy = tip_vx - along * dq, tip_vy + across * dq
                here.reach[0] += along * along / 2  # of one finger's x, then y
                here.reach[1] += across * across / 2
        else:
            tip_x, tip_y = channels[at], channels[at + 1]
            if measured:
                tip_vx, tip_vy = channels[at + 2], channels[at + 3]
            elif dt > 0.0:
                tip_vx, tip_vy = (tip_x - before[at]) / dt, (tip_y - before[at + 1]) / dt
        here.value[4] += tip_vx / 2
        here.value[5] += tip_vy / 2
        here.value[6] += tip_y / 2
        here.value[7] += sign * tip_x
    number = 1
    while number < filled and rows[(head - number) % ROWS].t > t - WINDOW + 1e-9:
        number += 1
    for k in range(4):
        x.force[k] = _mean(rows, head, number, k)
        if not math.isnan(x.force[k]):
            x.last_force[k] = x.force[k]
    x.vx, x.vy = _mean(rows, head, number, 4), _mean(rows, head, number, 5)
    x.y, x.d = _mean(rows, head, number, 6), _mean(rows, head, number, 7)
    here.fy = x.force[1] + x.force[3]
    x.last_fy = math.nan
    sum_t = sum_v = sum_tt = sum_tv = 0.0
    num = 0
    for back in range(filled):
        old = rows[(head - back) % ROWS]
        if back > 1 and old.t < t - SLOPE - 1e-9:
            break
        if back > 0:
            x.last_fy = old.fy
        if not math.isnan(old.value[5]):
            age, v = old.t - t, old.value[5]
            sum_t, sum_v, num = sum_t + age, sum_v + v, num + 1
            sum_tt, sum_tv = sum_tt + age * age, sum_tv + age * v
    spread = num * sum_tt - sum_t * sum_t
    x.ay = (num * sum_tv - sum_t * sum_v) / spread if num > 1 and spread > 0.0 else math.nan
    x.t = t
    # A fingertip's noise is `reach` times the joints'; y and velocities are means over both fingers, d the
    # difference.
    share = 1.0 / (2 * number)
    x.sd_y = math.sqrt(noise[0] * here.reach[1] * share)
    x.sd_d = 2 * math.sqrt(noise[0] * here.reach[0] * share)
    velocity = noise[1] if measured else 2 * noise[0] / max(dt * dt * number, 1e-12)
    x.sd_vx = math.sqrt(velocity * here.reach[0] * share)
    x.sd_vy = math.sqrt(velocity * here.reach[1] * share)


@compiled
def _mean(rows: np.ndarray, head: int, number: int, k: int) -> float:
    """Mean of a value over the last rows, NaN if missing in all of them."""
    total, num = 0.0, 0
    for back in range(number):
        value = rows[(head - back) % ROWS].value[k]
        if not math.isnan(value):
            total += value
            num += 1
    return total / num if num > 0 else math.nan


@compiled
def widen(extremes: np.ndarray, ranges: np.ndarray, least: np.ndarray, x: Any) -> None:
    """Extend the ranges of the emissions by a reading; they stay above `least` (4,)."""
    span, x = ranges[0], x[0]
    for k, value in enumerate((x.vx, x.vy, x.y, x.d)):
        if not math.isnan(value):
            extremes[k, 0], extremes[k, 1] = min(extremes[k, 0], value), max(extremes[k, 1], value)
    span.vx = max(least[0], extremes[0, 1] - extremes[0, 0])
    span.vy = max(least[1], extremes[1, 1] - extremes[1, 0])
    span.y = max(least[2], extremes[2, 1] - extremes[2, 0])
    span.d = max(least[3], extremes[3, 1] - extremes[3, 0])
    for c in range(4):
        if not math.isnan(x.force[c]):
            span.force = max(span.force, 1.5 * abs(x.force[c]))
    if not math.isnan(x.force[1] + x.force[3]):
        span.press = max(span.press, 1.5 * abs(x.force[1] + x.force[3]))


STILL = 0.2  # prior: share of samples at which a moving hand stands still
JUST_LIFTED = 0.05  # prior: factor of STILL while a lift begins: slow, but a motion
_LOG_CLOSE, _LOG_STRAY, _LOG_REST = math.log1p(-STRAY), math.log(STRAY), math.log1p(-2 * STRAY)
_LOG_SILENT, _LOG_ONE = math.log1p(-ONE_FINGER), math.log(ONE_FINGER / 2)
_LOG_MOVING, _LOG_STILL = math.log1p(-STILL), math.log(STILL)


@compiled
def log_sum(a: float, b: float) -> float:
    """log(exp(a) + exp(b))."""
    high, low = (a, b) if a > b else (b, a)
    return high + math.log1p(math.exp(low - high)) if low > -math.inf else high


@compiled
def _log_broad(value: float, span: float) -> float:
    """Log density of a value uniform over `span`; 0 where missing."""
    return 0.0 if math.isnan(value) else -math.log(span)


@compiled
def _force(h: Record, x: Record, c: int) -> float:
    """One force without its bias [N]."""
    return x.force[c] - h.bias[c, 0] / h.bias[c, 1]


@compiled
def _square(h: Record, which: int) -> float:
    """Squared scale of one kind of residual."""
    return h.scale[which, 0] / h.scale[which, 1]


@compiled
def _carry(h: Record, x: Record) -> float:
    """Variance of the net vertical force of a carried block [N^2]."""
    return _square(h, CARRY) + x.sd_fy * x.sd_fy


@compiled
def _shown(h: Record, x: Record, c: int, sign: float) -> float:
    """A force without its bias [N]; one missing is the other finger's times `sign`, both are as last seen."""
    if not math.isnan(x.force[c]):
        return _force(h, x, c)
    other = sign * _force(h, x, (c + 2) % 4)
    return x.last_force[c] - h.bias[c, 0] / h.bias[c, 1] if math.isnan(other) else other


@compiled
def _held_width(h: Record, x: Record, pads: Pads) -> float:
    """Width of the held block [m]."""
    return block_width(x.d, _shown(h, x, 0, -1.0), _shown(h, x, 2, -1.0), pads)


@compiled
def _held_height(h: Record, x: Record, pads: Pads) -> float:
    """Height of the held block [m]."""
    return block_y(x.y, _shown(h, x, 1, 1.0), _shown(h, x, 3, 1.0), pads)


@compiled
def _ungripped(h: Record, x: Record, span: float) -> float:
    """Log density of the forces without a grip: silent, or from one finger only."""
    silent1 = silent2 = touch1 = touch2 = 0.0
    noise = _square(h, FORCE)
    scale = math.sqrt(noise)
    for c in range(4):
        force = _force(h, x, c)
        silent = log_student(force, math.sqrt(noise + 1.0 / h.bias[c, 1]))
        if c % 2 == 0:
            touch = log_between(force if c == 0 else -force, 0.0, span, scale)
        else:
            touch = log_between(force, -span, span, scale)
        if c < 2:
            silent1, touch1 = silent1 + silent, touch1 + touch
        else:
            silent2, touch2 = silent2 + silent, touch2 + touch
    one = log_sum(touch1 + silent2, silent1 + touch2)
    return log_sum(_LOG_SILENT + silent1 + silent2, _LOG_ONE + one)


@compiled
def _log_known(
    value: float, factor: float, known: np.ndarray, q: int, variance: float, share: float, span: float,
    positive: bool
) -> float:  # fmt: skip
    """Log density of value = factor x quantity `q` given the evidence `known`; broad if unknown.

    `positive`: it is positive, as a weight is.
    """
    if math.isnan(value):
        return 0.0
    precision = known[q, 1]
    if precision <= 0.0:
        return log_between(value, 0.0, span, math.sqrt(variance)) if positive else -math.log(span)
    mean = known[q, 0] / precision
    if positive:
        mean = max(mean, 0.0)
    close = log_student(value - factor * mean, math.sqrt(variance + factor * factor / precision))
    return log_sum(math.log1p(-share) + close, math.log(share) - math.log(span)) if share > 0 else close


@compiled
def _halting(h: Record, x: Record, span: Record) -> tuple[float, float]:
    """Log density ratios of a hand that halts to one that moves: of motion aside, and of vertical motion."""
    aside = upward = 0.0
    moving = _square(h, VELOCITY)
    if not math.isnan(x.vx):
        aside = log_student(x.vx, math.sqrt(x.sd_vx**2 + moving)) + math.log(span.vx)
    if not math.isnan(x.vy):
        upward = log_student(x.vy, math.sqrt(x.sd_vy**2 + moving)) + math.log(span.vy)
    if not math.isnan(x.y - x.last_y):
        sd = math.sqrt(2 * x.sd_y**2 + _square(h, LEVEL))
        upward += log_student(x.y - x.last_y, sd) + math.log(span.y)
    return aside, upward


@compiled
def _moves(h: Record, x: Record, span: Record, still: float, kept: float) -> float:
    """Log density of the motion of a hand in the air.

    It may halt, in a share `still`, or else aside, upward or in its opening alone (`kept`: log density ratio
    of that): a straight lift must not pass for a rest, nor a reach of an open hand for a carry.
    """
    aside, upward = _halting(h, x, span)
    each = log_sum(_LOG_MOVING, _LOG_STILL + aside) + log_sum(_LOG_MOVING, _LOG_STILL + kept)
    each += log_sum(math.log1p(-still), math.log(still) + upward)
    broad = _log_broad(x.vx, span.vx) + _log_broad(x.vy, span.vy) + _log_broad(x.y, span.y)
    return broad + log_sum(math.log1p(-still) + each, math.log(still) + aside + upward + kept)


@compiled
def free(h: Record, x: Record, span: Record) -> float:
    """Log-likelihood of a reading in free motion."""
    kept = 0.0
    if not math.isnan(x.d - x.last_d):
        sd = math.sqrt(2 * x.sd_d**2 + _square(h, WIDTH))
        kept = log_student(x.d - x.last_d, sd) + math.log(span.d)
    out = _ungripped(h, x, span.force) + _log_broad(x.d, span.d) + _moves(h, x, span, STILL, kept)
    return out + EDGE if x.gripped == 2.0 else out


@compiled
def held(h: Record, known: np.ndarray, block: int, x: Record, span: Record, pads: Pads) -> float:
    """Log-likelihood of the features of a reading common to all grips of this block."""
    fx1, fx2 = _force(h, x, 0), _force(h, x, 2)
    out = log_between((fx1 - fx2) / 2, 0.0, span.force, math.sqrt(_square(h, FORCE)))
    if x.gripped == 0.0:
        out += EDGE
    out += log_student(fx1 + fx2, math.sqrt(_square(h, NET_X) + x.sd_fx * x.sd_fx))
    out += log_student((_force(h, x, 1) - _force(h, x, 3)) / 2, math.sqrt(_square(h, SHEAR)))
    spread = x.sd_d * x.sd_d + _square(h, WIDTH)
    width = _held_width(h, x, pads)
    return out + _log_known(width, 1.0, known, 2 * block + 1, spread, TOUCHING, span.d, False)


@compiled
def lifted(
    h: Record, known: np.ndarray, block: int, x: Record, span: Record, gravity: float, settled: float
) -> float:  # fmt: skip
    """Log-likelihood of the remaining features, of a block above the ground.

    `settled`: probability that it has been there for a while, and may keep its height.
    """
    factor = 1.0 if math.isnan(x.ay) else inertia_factor(x.ay, gravity)
    fy = _force(h, x, 1) + _force(h, x, 3)
    out = _log_known(fy, factor, known, 2 * block, _carry(h, x), 0.0, span.force, True)
    return out + _moves(h, x, span, STILL * max(settled, JUST_LIFTED), 0.0)


@compiled
def supported(
    h: Record, known: np.ndarray, kind: int, block: int, x: Record, span: Record, pads: Pads, levels: bool
) -> float:
    """Log-likelihood of the remaining features, of a block on its support.

    `levels`: whether the height at which the block rests counts.
    """
    weighed = known[2 * block, 1] > 0.0
    most, variance = span.press, _carry(h, x)
    if weighed:
        most, variance = known[2 * block, 0] / known[2 * block, 1], variance + 1.0 / known[2 * block, 1]
    load, sd = _force(h, x, 1) + _force(h, x, 3), math.sqrt(variance)
    force = log_between(load, -span.press, most, sd)
    moving = _square(h, VELOCITY)
    upward, broad = log_student(x.vy, math.sqrt(x.sd_vy**2 + moving)), _log_broad(x.vy, span.vy)
    resting, change = force + upward, x.force[1] + x.force[3] - x.last_fy
    # The load of a resting block is steady; so is a weight, where nothing else rests.
    if not math.isnan(change) and (not weighed or load < most - SURE * sd):
        same = log_student(change, 2 * math.sqrt(_square(h, FORCE)))
        resting = log_sum(_LOG_MOVING + resting, _LOG_STILL + same + upward)
    if levels and h.level[1] > 0.0:
        spread = x.sd_y * x.sd_y + _square(h, LEVEL) + 1.0 / h.level[1]
        risen = _held_height(h, x, pads) - h.level[0] / h.level[1]
        level = log_student(risen, math.sqrt(spread))
        resting, upward = resting + level, upward + level
        broad += log_student(risen, MOVED)
    else:
        force += _log_broad(x.y, span.y)
        resting += _log_broad(x.y, span.y)
    aside = _log_broad(x.vx, span.vx)
    if kind != GROUND_KIND:
        return aside + log_sum(_LOG_CLOSE + resting, _LOG_STRAY + broad + force)
    still = log_student(x.vx, math.sqrt(x.sd_vx**2 + moving))
    return log_sum(_LOG_REST + still + resting, force + _LOG_STRAY + aside + log_sum(upward, broad))


# What tells a block that is set down and released from one that falls, as off line
# (`hmmseg.segmentation.free_contacts`).


@compiled
def lowered(h: Record, x: Record, span: Record, pads: Pads) -> float:
    """Log-likelihood ratio, to any height, of the height at which a carried block meets its support.

    It has come down, unless it stays where it was carried.
    """
    height = _held_height(h, x, pads)
    if math.isnan(height) or h.level[1] <= 0.0:
        return 0.0
    spread = x.sd_y * x.sd_y + _square(h, LEVEL) + 1.0 / h.level[1]
    aloft = _LOG_STILL + math.log(span.y) + log_student(height - h.level[0] / h.level[1], math.sqrt(spread))
    return -log_sum(_LOG_MOVING, aloft)


@compiled
def opened(h: Record, known: np.ndarray, block: int, x: Record) -> float:
    """Log-likelihood ratio, to any distance, of that of fingers that release a block which stays in place.

    Pads relax before they leave it: the fingers are farther apart than while holding, by at least half of
    what the pads gave.
    """
    width = known[2 * block + 1]
    if math.isnan(x.d) or h.apart[1] <= 0.0 or width[1] <= 0.0:
        return 0.0
    least = (h.apart[0] / h.apart[1] + width[0] / width[1]) / 2
    beyond = (x.d - least) / math.sqrt(x.sd_d * x.sd_d + _square(h, WIDTH))
    return math.log((1.0 - CLOSED) * math.erfc(-beyond / math.sqrt(2.0)) / 2 + CLOSED)


@compiled
def sliding_out(h: Record, known: np.ndarray, block: int, x: Record, span: Record, pads: Pads) -> float:
    """Log-likelihood of a reading while a block slides out of opening fingers in the air.

    It loads them more, for their grip, than while carried; a support takes the load before the grip goes.
    """
    of_weight = known[2 * block]
    if h.firm[1] <= 0.0 or of_weight[1] <= 0.0:
        return -math.inf
    load, grip = abs(_force(h, x, 1) + _force(h, x, 3)), (_force(h, x, 0) - _force(h, x, 2)) / 2
    weight, noise = of_weight[0] / of_weight[1], math.sqrt(2 * _square(h, FORCE))
    if not h.firm[0] / h.firm[1] * (load - SURE * noise) > weight * grip:
        return -math.inf
    out = log_between(load, 0.0, weight, math.sqrt(_carry(h, x)))
    return out + _moves(h, x, span, STILL, 0.0) + held(h, known, block, x, span, pads)


MOST_BIAS = 2000.0  # chosen: readings that a bias remembers: sensors drift
MOST_SCALE = 200.0  # chosen: readings that a scale remembers
LEAST = 1e-12  # numerics: N^2, m^2; least squared scale
FLOOR = LEAST_SCALE**2  # squared, over a sample's variance


@compiled
def _learn_mean(evidence: np.ndarray, value: float, variance: float, share: float, most: float) -> None:
    """Robust conjugate update of a mean by a value of this variance, with weight `share`."""
    if math.isnan(value):
        return
    robust = 1.0
    if evidence[1] > 0.0:
        residual = value - evidence[0] / evidence[1]
        robust = (TAIL + 1) / (TAIL + residual * residual / (variance + 1.0 / evidence[1]))
    add = share * robust / variance
    evidence[0] += add * value
    evidence[1] += add
    if evidence[1] > most / variance:
        forget = most / variance / evidence[1]
        evidence[0] *= forget
        evidence[1] *= forget


@compiled
def _learn_scale(evidence: np.ndarray, residual: float, share: float, least: float) -> None:
    """Robust update of a squared scale, bounded below by `least`."""
    if math.isnan(residual):
        return
    square = residual * residual
    robust = (TAIL + 1) / (TAIL + square / (evidence[0] / evidence[1]))
    evidence[0] += share * robust * square
    evidence[1] += share
    if evidence[1] > MOST_SCALE:
        forget = MOST_SCALE / evidence[1]
        evidence[0] *= forget
        evidence[1] *= forget
    evidence[0] = max(evidence[0], max(least, LEAST) * evidence[1])


@compiled
def learn(
    h: Record, known: np.ndarray, kind: int, block: int, x: Record, pads: Pads, gravity: float,
    share: float, levels: bool
) -> None:  # fmt: skip
    """Update a hypothesis by a reading taken in its state, with weight `share`."""
    noise = _square(h, FORCE)
    if kind == FREE_KIND:
        for c in range(4):
            residual = _force(h, x, c)
            _learn_mean(h.bias[c], x.force[c], noise, share, MOST_BIAS)
            _learn_scale(h.scale[FORCE], residual, share / 4, LEAST)
        return
    if not math.isnan(x.d):
        h.apart[0], h.apart[1] = h.apart[0] + share * x.d, h.apart[1] + share
    fy1, fy2 = _force(h, x, 1), _force(h, x, 3)
    _learn_scale(h.scale[NET_X], _force(h, x, 0) + _force(h, x, 2), share, noise)
    _learn_scale(h.scale[SHEAR], (fy1 - fy2) / 2, share, noise)
    weight, width, measured = known[2 * block], known[2 * block + 1], _held_width(h, x, pads)
    if width[1] > 0.0:
        _learn_scale(h.scale[WIDTH], measured - width[0] / width[1], share, FLOOR * x.sd_d**2)
    _learn_mean(width, measured, x.sd_d * x.sd_d + _square(h, WIDTH), share, math.inf)
    if kind == ABOVE_KIND:
        grip = (_force(h, x, 0) - _force(h, x, 2)) / 2
        if not math.isnan(grip):
            h.firm[0], h.firm[1] = h.firm[0] + share * grip, h.firm[1] + share
        height = _held_height(h, x, pads)
        spread = x.sd_y * x.sd_y + _square(h, LEVEL)
        rise = height - h.level[0] / h.level[1] if h.level[1] > 0.0 else math.inf
        if rise > SURE * math.sqrt(spread):
            h.level[:] = 0.0
        if rise > -SURE * math.sqrt(spread):
            _learn_mean(h.level, height, spread, share, math.inf)
        factor = 1.0 if math.isnan(x.ay) else inertia_factor(x.ay, gravity)
        if weight[1] > 0.0:
            _learn_scale(h.scale[CARRY], fy1 + fy2 - factor * weight[0] / weight[1], share, noise)
        if factor > 0.1:  # in free fall forces do not show the weight
            _learn_mean(weight, (fy1 + fy2) / factor, _carry(h, x) / (factor * factor), share, math.inf)
        return
    _learn_scale(h.scale[VELOCITY], x.vy, share, FLOOR * x.sd_vy**2)
    if levels:
        height = _held_height(h, x, pads)
        if h.level[1] > 0.0:
            _learn_scale(h.scale[LEVEL], height - h.level[0] / h.level[1], share, FLOOR * x.sd_y**2)
        _learn_mean(h.level, height, x.sd_y**2 + _square(h, LEVEL), share, math.inf)
