"""What grips themselves say of the pads: how readings change with the force that squeezes or shears.

A pad that gives as the rig says leaves `block_width` and `block_y` alone, whatever the force. Where its
compliance is truly (1 + e) times the nominal, the block's width reads e times the give too small, and its
height e times the shear give too large; so the slope of either reading over the give, within one grip,
shows -e or e whatever the block. Loading and unloading take part, so what viscosity adds to the one it
takes from the other, and the rate is fitted as well. A landing, where the load goes from fingers to ground
within a few samples, shows the shear give once more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hmmseg.contact.equations import Pads, block_width, block_y, pads_of
from hmmseg.errors_in_variables import slope_between
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.levels import TAIL
from hmmseg.robust import robust_sd, weighted_median, white_sd
from hmmseg.tables import Brief

RIGID = 4000.0  # chosen: N/m; a rig whose pads are `inf` has no give to take shares of: that of such a pad
UNSTATED = 0.8  # prior: sd of their give, in these shares: 2e-4 m/N, as in hmmseg.segmentation.pads
STATED_SD = (
    0.3  # prior: how far, as a share, pads are off a stiffness that is wrong: foams of one make differ by it
)
MISSTATED = 0.1  # prior: share of rigs whose pads are off by more than they admit
CLOSED = 0.15  # chosen: of the grip's own force: below it, one finger may not touch yet
MIN_SAMPLES = 6  # numerics: of a grip: fewer give a slope no interval of its own
# prior: standard deviation of one slope beyond its sampling, and of all alike, as forces and positions are
# read apart in time: measured on a robot arm's recordings whose pads are known springs (0.04 and 0.08 off).
SLOPE_SD = 0.1


@dataclass(frozen=True, repr=False)
class Slope(Brief):
    """Weights (num_timesteps,) whose sum with readings is their slope over the give, and its variance.

    `alike`: what all slopes of a hand may be off by together, for one reason (part of `variance`).
    """

    weights: np.ndarray
    variance: float
    alike: float = 0.0


def unit_pads(rig: Rig) -> Pads:
    """The rig's pads, a rigid one replaced by what shares are taken of."""
    return Pads(*(c if c > 0 else 1 / RIGID for c in pads_of(rig)))


def squeeze_give(signals: Signals, rig: Rig) -> np.ndarray:
    """How far both pads give under the grip (num_timesteps,) [m]."""
    return block_width(0.0, signals.fx1, signals.fx2, unit_pads(rig))


def shear_give(signals: Signals, rig: Rig) -> np.ndarray:
    """How far the pads' shear moves the fingers off the block (num_timesteps,) [m]."""
    return -block_y(0.0, signals.fy1, signals.fy2, unit_pads(rig))


def closed(signals: Signals, inside: np.ndarray) -> np.ndarray:
    """Samples (num_timesteps,) of `inside` in which both fingers hold the block."""
    grip = np.where(np.isfinite(signals.grip), signals.grip, -np.inf)
    there = inside & np.isfinite(grip)
    return there & (grip > CLOSED * np.median(grip[there])) if there.any() else there


def slope(
    t: np.ndarray, reading: np.ndarray, place: np.ndarray, give: np.ndarray, groups: list[np.ndarray],
    noise: float, sds: tuple[float, float] = (0.0, 0.0),
) -> Slope | None:  # fmt: skip
    """Robust slope of readings over the give, each group (num_timesteps,) with a level of its own.

    `reading` is what `place`, which positions alone give, becomes with the nominal give; `place` grows with
    the give. The rate of the give is fitted as well: it takes what a pad's viscosity, or a force that is
    late, adds while the give changes. `t` [s]; `noise`: sd of one reading at least; `sds`: those that sensors
    are known to have, of a give and of a place [m]. None for too few samples.
    """
    rate = np.gradient(give, t)
    groups = [g & np.isfinite(reading) & np.isfinite(give) & np.isfinite(rate) for g in groups]
    groups = [g for g in groups if g.sum() >= MIN_SAMPLES]
    if not groups:
        return None
    every = np.logical_or.reduce(groups)
    levels = np.stack([np.where(g, 1.0, 0.0) for g in groups])
    others = np.concatenate([levels, np.where(every, np.nan_to_num(rate), 0.0)[None]])
    values = np.nan_to_num(np.stack([give, reading, place], axis=1)) * every[:, None]
    trust, found, doubt = every.astype(float), None, None
    for _ in range(10):
        root = np.sqrt(trust)
        fitted, *_ = np.linalg.lstsq((others * root).T, values * root[:, None], rcond=None)
        x, y, p = (values - others.T @ fitted).T
        power = float((trust * x**2).sum())
        if power <= 1e-12 * float((np.nan_to_num(give)[every] ** 2).sum()):
            return None
        along, alike = _between(x, p, trust, sds, len(others))
        # Of all samples alike: those that agree with a flat line are those it was weighed by.
        doubt = alike if doubt is None else max(doubt, alike)
        if not np.isfinite(doubt):
            return None
        weights = trust * along / float((trust * along) @ x)
        residual = np.where(every, y - float(weights @ y) * x, 0.0)
        scale = max(robust_sd(residual[every]), noise)
        trust = np.where(every, (TAIL + 1) / (TAIL + (residual / scale) ** 2), 0.0)
        # A sample that bears the fit alone shows no residual: the jackknife's (MacKinnon and White 1985) of
        # least squares, which is the flat line.
        basis, _ = np.linalg.qr((np.concatenate([x[None], others]) * np.sqrt(trust)).T)
        flat = np.where(every, y - float((trust * x) @ y) / power * x, 0.0)
        alone = trust * x / power * flat / np.maximum(1 - (basis**2).sum(axis=1), 1e-3)
        variance = max(float((alone**2).sum()), scale**2 / power) + doubt**2
        found = Slope(weights, variance, doubt)
    return found


def _between(
    give: np.ndarray, place: np.ndarray, trust: np.ndarray, sds: tuple[float, float], fitted: int
) -> tuple[np.ndarray, float]:
    """What to weigh samples by (num_timesteps,) for a slope amid those that noise allows, and its doubt.

    Forces that ring make the slope over their give flat, places that are off make it steep
    (`hmmseg.errors_in_variables`).
    """
    count = float(trust.sum()) * max(1 - fitted / max(np.count_nonzero(trust), 1), 0.0)
    both = float(trust @ (give * place))
    square_give, square_place = float(trust @ give**2), float(trust @ place**2)
    middle, apart = slope_between(square_give, both, square_place, count, sds)
    if middle <= both / square_give or square_place <= middle * both:
        return give, apart
    # Weighed by give + k place the slope is (both + k square_place) / (square_give + k both).
    k = (middle * square_give - both) / (square_place - middle * both)
    return give + k * place, apart


def middle_share(shares: np.ndarray, variances: np.ndarray, error: np.ndarray | float) -> tuple[float, float]:
    """Weighted median of slopes (K,) and its standard error, each off by `error` besides its variance."""
    weights = 1 / (variances + error**2)
    # A median of normal draws has pi / 2 times the variance of their mean.
    return weighted_median(shares, weights), float(np.sqrt(np.pi / 2 / weights.sum()))


def shared_error(alike: np.ndarray, variances: np.ndarray) -> float:
    """What the mean of slopes (K,), weighed by their variances, is off by for the reason they have alike."""
    return float((alike / variances).sum() / (1 / variances).sum()) if alike.size else 0.0


def misstated(
    shares: np.ndarray, variances: np.ndarray, stated: bool, admitted: float, apart: float = 0.0
) -> tuple[float, float]:
    """Share by which all slopes (K,) together disagree with the rig, and the probability that it is wrong.

    `stated`: whether the rig has pads that give; of those that it calls rigid any give is a surprise;
    `admitted`: sd of the share by [systematic]. The weighted median, so that no single grip decides. `apart`:
    what all of them may be off by together. A rig that is right leaves the share normal about 0 with these
    errors, a wrong one (MISSTATED) with the foams' spread added; both are 0 where slopes speak for the rig.
    """
    if not shares.size:
        return 0.0, 0.0
    # A slope's own error is a share of what truly gives.
    middle, error = middle_share(shares, variances, SLOPE_SD if stated else SLOPE_SD * np.abs(shares))
    alike = SLOPE_SD if stated else SLOPE_SD * abs(middle)
    right = max(error**2 + alike**2 + apart**2 + admitted**2, 1e-12)
    wrong = right + (STATED_SD if stated else UNSTATED) ** 2
    gain = (np.log(right / wrong) + middle**2 * (1 / right - 1 / wrong)) / 2
    if gain <= 0:
        return 0.0, 0.0
    return middle, float(1 / (1 + (1 / MISSTATED - 1) * np.exp(-min(gain, 500.0))))


def possible_share(shares: np.ndarray, variances: np.ndarray) -> float:
    """What slopes (K,) say of how much unstated pads may give, as a share of the give of RIGID ones."""
    if not shares.size:
        return UNSTATED
    middle, error = middle_share(shares, variances, 0.0)
    return min(max(abs(middle), error), max(UNSTATED, abs(middle)))


BEFORE = 4  # numerics: samples before the touch from which the fingers' height at it is extrapolated
LEAST_GIVE = 1e-6  # numerics: m; a push that squeezes nothing shows nothing


def landing(
    t: np.ndarray, reading: np.ndarray, give: np.ndarray, place: np.ndarray,
    touch: tuple[float, float], carry: np.ndarray, noise: float,
) -> Slope | None:  # fmt: skip
    """Weights whose sum with readings is the share e of the pads' give that the rig leaves out.

    `t`, `reading` (block_y by the rig's pads), `give` (their shear's), `place` (weights of the place's mean,
    summing to 1), `carry` (booleans): (num_timesteps,) in s and m; `touch`: mean and sd of the
    moment [s]; `noise`: sd of one reading [m]. None for too few samples.

    The height at the touch is a parabola through the last samples before it. Its error is how far a straight
    line lies from that, or how far the last samples themselves bend from one to the next, if that is more.
    """
    moment, moment_sd = touch
    usable = np.isfinite(reading) & np.isfinite(give)
    before = np.flatnonzero(carry & usable & (t <= moment))[-BEFORE:]
    if before.size < BEFORE or not np.any(place[usable] > 0):
        return None
    # Weights that make of readings a least-squares polynomial's value at the touch.
    parabola, line = (np.linalg.pinv(np.vander(t[before] - moment, n))[-1] for n in (3, 2))
    weights = np.where(usable, place, 0.0)
    weights = weights / weights.sum()
    count = 1 / float((weights**2).sum())
    weights[before] -= parabola
    y = reading[before]
    change = float(weights @ np.where(usable, give, 0.0))
    if abs(change) < LEAST_GIVE:
        return None
    bend = max(abs(float((parabola - line) @ y)), float(np.abs(np.diff(y, 2)).max()))
    speed = float(np.polyfit(t[before] - moment, y, 1)[0])
    variance = (speed * moment_sd) ** 2 + bend**2 + noise**2 * (float((parabola**2).sum()) + 1 / count)
    return Slope(weights / change, variance / change**2)


def slopes_within(
    signals: Signals, values: Mapping[str, np.ndarray], groups: Mapping[str, np.ndarray],
    scales: Mapping[str, float], rig: Rig,
) -> dict[str, Slope]:  # fmt: skip
    """Slopes of the width's and the height's readings over the pads' give, within one grip.

    `values`: readings (num_timesteps,) by name; `groups`: booleans (num_timesteps,) of the samples while the
    block is held ("distance"), before it is lifted ("pickup") and after ("place").
    """
    out = {}
    held = {name: closed(signals, group) for name, group in groups.items()}
    root2, pads = np.sqrt(2.0), unit_pads(rig)
    sd_force = np.nan_to_num(signals.sd_force)  # what is not stated is not taken out
    for name, key, place, sd, give, compliance, together in (
        ("distance", "distance", -signals.distance, root2 * signals.sd_x, squeeze_give(signals, rig),
         np.hypot(pads.normal1, pads.normal2), [held["distance"]]),
        ("rise", "place", signals.y, signals.sd_y / root2, shear_give(signals, rig),
         np.hypot(pads.shear1, pads.shear2) / 2, [held["pickup"], held["place"]]),
    ):  # fmt: skip
        known = sd[np.isfinite(sd)]
        noise = float(np.median(known)) if known.size else 0.0
        # What readings are rougher than places is noise of the forces: they ring, what they move does not.
        seen = [values[key][group & np.isfinite(values[key])] for group in together]
        rough = [white_sd(one) for one in seen if one.size >= MIN_SAMPLES]
        ringing = np.sqrt(max(max(rough, default=0.0) ** 2 - noise**2, 0.0))
        sds = (max(sd_force * compliance, ringing), noise)
        found = slope(signals.t, values[key], place, give, together, scales[key], sds)
        if found is not None:
            out[name] = found
    return out
