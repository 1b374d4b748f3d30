"""Evidence about the pads within each grip: slopes of readings over the give.

Pads that give as the rig says leave `block_width` and `block_y` independent of the force. If their compliance
is truly (1 + e) times the nominal, the block's width reads e times the give too small, and its height e times
the shear give too large, so the slope of either reading over the give, within one grip, is -e or e whatever
the block. Loading and unloading both contribute, so the effects of viscosity cancel; the rate is fitted as
well. A landing, in which the load passes from fingers to ground within a few samples, shows the shear give
once more.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hmmseg.contact.equations import Pads, block_width, block_y, pads_of
from hmmseg.errors_in_variables import slope_between
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.levels import TAIL
from hmmseg.robust import median_of_known, robust_sd, weighted_median, white_sd
from hmmseg.segmentation.pads import SOFT
from hmmseg.tables import Brief

UNSTATED = 0.8  # prior: sd of the give of unstated pads, as a share of that of RIGID ones
RIGID = UNSTATED / SOFT  # prior: N/m; the stiffness that shares refer to if the rig's pads are `inf`
STATED_SD = 0.3  # prior: relative error of a wrong stiffness: foams of one make differ by as much
MISSTATED = 0.1  # prior: share of rigs whose pads are off by more than they admit
CLOSED = 0.15  # chosen: share of the grip's own force below which one finger may not touch yet
MIN_SAMPLES = 6  # numerics: of a grip: fewer determine no variance of a slope
# prior: sd of one slope beyond sampling, and of all slopes together, as forces and positions are not read
# simultaneously: from a robot arm's recordings with known springs as pads (0.04 and 0.08 off)
SLOPE_SD = 0.1


@dataclass(frozen=True, repr=False)
class Slope(Brief):
    """A slope over the give as a weighted sum of readings (num_timesteps,); `alike`: common error of all."""

    weights: np.ndarray
    variance: float
    alike: float = 0.0


def unit_pads(rig: Rig) -> Pads:
    """The rig's pads, rigid ones replaced by the reference stiffness."""
    return Pads(*(c if c > 0 else 1 / RIGID for c in pads_of(rig)))


def squeeze_give(signals: Signals, rig: Rig) -> np.ndarray:
    """Give of both pads along the grip (num_timesteps,) [m]."""
    return block_width(0.0, signals.fx1, signals.fx2, unit_pads(rig))


def shear_give(signals: Signals, rig: Rig) -> np.ndarray:
    """Displacement of the fingers off the block by the pads' shear (num_timesteps,) [m]."""
    return -block_y(0.0, signals.fy1, signals.fy2, unit_pads(rig))


def closed(signals: Signals, inside: np.ndarray) -> np.ndarray:
    """Samples (num_timesteps,) of `inside` at which both fingers hold the block."""
    grip = np.where(np.isfinite(signals.grip), signals.grip, -np.inf)
    there = inside & np.isfinite(grip)
    return there & (grip > CLOSED * np.median(grip[there])) if there.any() else there


def slope(
    t: np.ndarray, reading: np.ndarray, place: np.ndarray, give: np.ndarray, groups: list[np.ndarray],
    noise: float, sds: tuple[float, float] = (0.0, 0.0),
) -> Slope | None:  # fmt: skip
    """Robust slope of readings over the give, with a separate level for each group (num_timesteps,).

    `place`: the reading from positions alone, which grows with the give; `reading`: the same with the nominal
    give. The rate of the give is fitted as well, to absorb viscosity of the pad, or delay of the force. `t`
    [s]; `noise`: least sd of one reading; `sds`: known sensor noise of a give and of a place [m]. None for
    too few samples."""
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
        # At least that of the unweighted samples: weights favour those that agree with a flat line.
        doubt = alike if doubt is None else max(doubt, alike)
        if not np.isfinite(doubt):
            return None
        weights = trust * along / float((trust * along) @ x)
        residual = np.where(every, y - float(weights @ y) * x, 0.0)
        scale = max(robust_sd(residual[every]), noise)
        trust = np.where(every, (TAIL + 1) / (TAIL + (residual / scale) ** 2), 0.0)
        # Jackknife variance (MacKinnon and White 1985) of least squares, i.e. of the flat line, as samples of
        # high leverage have no residual.
        basis, _ = np.linalg.qr((np.concatenate([x[None], others]) * np.sqrt(trust)).T)
        flat = np.where(every, y - float((trust * x) @ y) / power * x, 0.0)
        alone = trust * x / power * flat / np.maximum(1 - (basis**2).sum(axis=1), 1e-3)
        variance = max(float((alone**2).sum()), scale**2 / power) + doubt**2
        found = Slope(weights, variance, doubt)
    return found


def _between(
    give: np.ndarray, place: np.ndarray, trust: np.ndarray, sds: tuple[float, float], fitted: int
) -> tuple[np.ndarray, float]:
    """Sample weights (num_timesteps,) of the slope between those that noise allows, and its doubt. Ringing
    forces flatten the slope over their give, errors of places steepen it (`hmmseg.errors_in_variables`)."""
    count = float(trust.sum()) * max(1 - fitted / max(int(np.count_nonzero(trust)), 1), 0.0)
    both = float(trust @ (give * place))
    square_give, square_place = float(trust @ give**2), float(trust @ place**2)
    middle, apart = slope_between(square_give, both, square_place, count, sds)
    if middle <= both / square_give or square_place <= middle * both:
        return give, apart
    # Weighed by give + k place the slope is (both + k square_place) / (square_give + k both).
    k = (middle * square_give - both) / (square_place - middle * both)
    return give + k * place, apart


def middle_share(shares: np.ndarray, variances: np.ndarray, error: np.ndarray | float) -> tuple[float, float]:
    """Weighted median of slopes (K,) and its standard error; `error` adds to the sd of each."""
    weights = 1 / (variances + error**2)
    # The median of normal draws has pi / 2 times the variance of their mean.
    return weighted_median(shares, weights), float(np.sqrt(np.pi / 2 / weights.sum()))


def shared_error(alike: np.ndarray, variances: np.ndarray) -> float:
    """Common error of the mean of slopes (K,), weighted by their variances."""
    return float((alike / variances).sum() / (1 / variances).sum()) if alike.size else 0.0


def misstated(
    shares: np.ndarray, variances: np.ndarray, stated: bool, admitted: float, apart: float = 0.0
) -> tuple[float, float]:
    """Share by which all slopes (K,) together disagree with the rig, and the probability that it is wrong.

    `stated`: whether the rig has pads that give (for nominally rigid ones any give is a surprise);
    `admitted`: sd of the share by [systematic]; `apart`: error common to all slopes. The share is the
    weighted median, so that no single grip decides. If the rig is right it is normal about 0 with these
    errors, if wrong (MISSTATED) with the foams' spread in addition; both are 0 if the slopes favour the rig.
    """
    if not shares.size:
        return 0.0, 0.0
    # The error of a slope scales with the true give.
    middle, error = middle_share(shares, variances, SLOPE_SD if stated else SLOPE_SD * np.abs(shares))
    alike = SLOPE_SD if stated else SLOPE_SD * abs(middle)
    right = max(error**2 + alike**2 + apart**2 + admitted**2, 1e-12)
    wrong = right + (STATED_SD if stated else UNSTATED) ** 2
    gain = (np.log(right / wrong) + middle**2 * (1 / right - 1 / wrong)) / 2
    if gain <= 0:
        return 0.0, 0.0
    return middle, float(1 / (1 + (1 / MISSTATED - 1) * np.exp(-min(gain, 500.0))))


def possible_share(shares: np.ndarray, variances: np.ndarray) -> float:
    """Possible give of unstated pads given slopes (K,), as a share of the give of RIGID ones."""
    if not shares.size:
        return UNSTATED
    middle, error = middle_share(shares, variances, 0.0)
    return min(max(abs(middle), error), max(UNSTATED, abs(middle)))


BEFORE = 4  # numerics: samples before the touch from which the fingers' height at it is extrapolated
LEAST_GIVE = 1e-6  # numerics: m; least change of the give to determine a slope


def landing(
    t: np.ndarray, reading: np.ndarray, give: np.ndarray, place: np.ndarray,
    touch: tuple[float, float], carry: np.ndarray, noise: float,
) -> Slope | None:  # fmt: skip
    """Weights with which readings sum to the share e of the pads' give that the rig omits, from a landing.

    `t`, `reading` (block_y with the rig's pads), `give` (in shear), `place` (weights of the place's mean,
    summing to 1), `carry` (booleans): (num_timesteps,) in s and m; `touch`: mean and sd of its time [s];
    `noise`: sd of one reading [m]. None for too few samples.

    The height at the touch is extrapolated by a parabola through the last samples before it. Its error is the
    distance to a straight-line extrapolation, or the curvature between the last samples if that is larger."""
    moment, moment_sd = touch
    usable = np.isfinite(reading) & np.isfinite(give)
    before = np.flatnonzero(carry & usable & (t <= moment))[-BEFORE:]
    if before.size < BEFORE or not np.any(place[usable] > 0):
        return None
    # Weights with which readings sum to the value of a least-squares polynomial at the touch.
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
    """Slopes of the readings of width and height over the pads' give, within one grip. `values`: readings
    (num_timesteps,) by name; `groups`: booleans (num_timesteps,) of the samples while the block is held
    ("distance"), before it is lifted ("pickup") and after it is set down ("place")."""
    out = {}
    held = {name: closed(signals, group) for name, group in groups.items()}
    root2, pads = np.sqrt(2.0), unit_pads(rig)
    sd_force = np.nan_to_num(signals.sd_force)  # unstated noise is not subtracted
    for name, key, place, sd, give, compliance, together in (
        ("distance", "distance", -signals.distance, root2 * signals.sd_x, squeeze_give(signals, rig),
         np.hypot(pads.normal1, pads.normal2), [held["distance"]]),
        ("rise", "place", signals.y, signals.sd_y / root2, shear_give(signals, rig),
         np.hypot(pads.shear1, pads.shear2) / 2, [held["pickup"], held["place"]]),
    ):  # fmt: skip
        noise = median_of_known(sd, 0.0)
        # Excess noise of readings over places comes from ringing forces, as the block does not ring.
        recorded = [values[key][group & np.isfinite(values[key])] for group in together]
        rough = [white_sd(one) for one in recorded if one.size >= MIN_SAMPLES]
        ringing = np.sqrt(max(max(rough, default=0.0) ** 2 - noise**2, 0.0))
        sds = (max(sd_force * compliance, ringing), noise)
        fitted = slope(signals.t, values[key], place, give, together, scales[key], sds)
        if fitted is not None:
            out[name] = fitted
    return out
