"""What one grip itself says of the pads: how its readings change with the force that squeezes or shears.

A pad that gives as the rig says leaves `block_width` and `block_y` alone, whatever the force. Where its
compliance is truly (1 + e) times the nominal, the block's width reads e times the give too small, and its
height e times the shear give too large; so the slope of either reading over the give, within one grip,
shows -e or e whatever the block. Loading and unloading take part, so what viscosity adds to the one it
takes from the other, and the rate is fitted beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.contact.equations import Pads, block_width, block_y, pads_of
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.levels import CONTRADICTS, TAIL
from hmmseg.robust import robust_sd

RIGID = 4000.0  # chosen: N/m; a rig whose pads are `inf` has no give to take shares of: that of such a pad
UNSTATED = 0.8  # prior: sd of their give, in these shares: 2e-4 m/N, as in hmmseg.segmentation.pads
CLOSED = 0.15  # chosen: of the grip's own force: below it, one finger may not touch yet
MIN_SAMPLES = 6  # numerics: of a grip: fewer give a slope no interval of its own
# prior: standard deviation of one slope beyond its sampling, and of all alike, as forces and positions are
# read apart in time: measured on a robot arm's recordings whose pads are known springs (0.04 and 0.08 off).
SLOPE_SD = 0.1


@dataclass(frozen=True)
class Slope:
    """Weights (num_timesteps,) whose sum with readings is their slope over the give, and its variance.

    `change` [m]: what a landing's give changed by; 0 of a slope within a grip.
    """

    weights: np.ndarray
    variance: float
    change: float = 0.0


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
    t: np.ndarray, reading: np.ndarray, give: np.ndarray, groups: list[np.ndarray], noise: float
) -> Slope | None:
    """Robust slope of readings over the give, each group (num_timesteps,) with a level of its own.

    The rate of the give is fitted beside it: it takes what a pad's viscosity, or a force that is late,
    adds while the give changes. `t` [s]; `noise`: sd of one reading at least [m]. None where too few
    samples tell.
    """
    rate = np.gradient(give, t)
    groups = [g & np.isfinite(reading) & np.isfinite(give) & np.isfinite(rate) for g in groups]
    groups = [g for g in groups if g.sum() >= MIN_SAMPLES]
    if not groups:
        return None
    every = np.logical_or.reduce(groups)
    trust, found = every.astype(float), None
    for _ in range(10):
        levels = np.stack([np.where(g, 1.0, 0.0) for g in groups])
        others = np.concatenate([levels, np.where(every, np.nan_to_num(rate), 0.0)[None]])
        x, y = (np.where(every, np.nan_to_num(v), 0.0) for v in (give, reading))
        x, y = (_less(v, others, trust) for v in (x, y))
        power = float((trust * x**2).sum())
        if power <= 1e-12 * float((np.nan_to_num(give)[every] ** 2).sum()):
            return None
        weights = trust * x / power
        residual = np.where(every, y - float(weights @ y) * x, 0.0)
        scale = max(robust_sd(residual[every]), noise)
        trust = np.where(every, (TAIL + 1) / (TAIL + (residual / scale) ** 2), 0.0)
        # A sample that bears the fit alone shows no residual: the jackknife's (MacKinnon and White 1985).
        basis, _ = np.linalg.qr((np.concatenate([x[None], others]) * np.sqrt(trust)).T)
        alone = residual / np.maximum(1 - (basis**2).sum(axis=1), 1e-3)
        variance = max(float((weights**2 * alone**2).sum()), scale**2 / power)
        found = Slope(weights, variance)
    return found


def _less(values: np.ndarray, others: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Values (num_timesteps,) less their weighted least-squares fit by others (num_others, num_timesteps)."""
    root = np.sqrt(trust)
    fitted, *_ = np.linalg.lstsq((others * root).T, values * root, rcond=None)
    return values - fitted @ others


def middle_share(shares: np.ndarray, variances: np.ndarray, error: np.ndarray | float) -> tuple[float, float]:
    """Weighted median of slopes (K,) and its standard error, each off by `error` beside its variance."""
    order = np.argsort(shares)
    cumulative = np.cumsum((1 / (variances + error**2))[order])
    middle = float(shares[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
    # A median of normal draws has pi / 2 times the variance of their mean.
    return middle, float(np.sqrt(np.pi / 2 / cumulative[-1]))


def unexpected_share(shares: np.ndarray, variances: np.ndarray, stated: bool, admitted: float) -> float:
    """Share by which all slopes (K,) together disagree with the rig, 0 where it admits as much.

    `stated`: whether the rig has pads that give; of those that it calls rigid any give is a surprise. The
    weighted median, so that no single grip decides.
    """
    if not shares.size:
        return 0.0
    # A slope's own error is a share of what truly gives.
    middle, error = middle_share(shares, variances, SLOPE_SD if stated else SLOPE_SD * np.abs(shares))
    alike = SLOPE_SD if stated else SLOPE_SD * abs(middle)
    return middle if abs(middle) > CONTRADICTS * np.hypot(np.hypot(error, alike), admitted) else 0.0


def possible_share(shares: np.ndarray, variances: np.ndarray) -> float:
    """What slopes (K,) say of how much unstated pads may give, as a share of the give of RIGID ones."""
    if not shares.size:
        return UNSTATED
    middle, error = middle_share(shares, variances, 0.0)
    return min(max(abs(middle), error), max(UNSTATED, abs(middle)))
