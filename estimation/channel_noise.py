"""The noise of what a grip's means are taken over: learned from residuals, and from what the rig states.

A mean of few samples leaves fewer residuals still, whose scale may come out as anything: the squares of two
are less than a tenth of what they should be one time in ten. What is recorded may well be noisier than its
sensors, as hands shake and pads creep, but it is quieter only by chance or where the rig is wrong. Where less
was found than the rig states, its statement counts as STATED further samples (conjugate prior of a variance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.contact.equations import pads_of
from hmmseg.hand.signals import Signals
from hmmseg.levels import TAIL
from hmmseg.segmentation.align import AlignedTrials

FARTHEST_LAG = 11  # numerics: samples; autocorrelations beyond are noise
MIN_STRETCH = 0.5  # numerics: samples; white noise has one, and a short series may seem to have less
LEAST = 1e-8  # numerics: m or N: noise of a sample is no less, which keeps rounding out of the posterior
# prior: samples that a stated noise is worth: it is off by a factor of two once in twenty
STATED = 4.0


@dataclass(frozen=True)
class Noise:
    """Variance of one effective sample and the number it was learned from.

    Of each kind of mean of a grip ("force", "distance", "pickup", "place"), and of each force in
    free motion by its name.
    """

    variance: dict[str, float]
    count: dict[str, float]


def channel_sds(signals: Sequence[Signals], aligned: AlignedTrials) -> dict[str, float]:
    """Noise that the rig states of one sample behind each mean [N, m], the median; NaN where it states none.

    Of a sensor in the wrist, whose fingers are made up, nothing is stated.
    """
    pads, out = pads_of(aligned.rig), dict[str, float]()
    if any(one.trial.inertia is not None for one in aligned.trials):
        return out
    root2 = np.sqrt(2.0)
    for s in signals:
        rise = np.hypot(s.sd_y, s.sd_force * pads.shear1) / root2
        sds = {
            "force": np.full(1, root2 * s.sd_force),
            "distance": root2 * np.hypot(s.sd_x, s.sd_force * pads.normal1),
            "pickup": rise,
            "place": rise,
        }
        for key, sd in sds.items():
            known = sd[np.isfinite(sd)]
            out[key] = max(out.get(key, 0.0), float(np.median(known)) if known.size else np.nan)
    return out


def learned(pooled: dict[str, list], scales: dict[str, float], stated: dict[str, float]) -> Noise:
    """Noise of each channel from residuals and their weights, pooled over grips.

    `stated`: standard deviations of one sample, where they are known.
    """
    variance, count = {}, {}
    for key, pairs in pooled.items():
        pairs = [(r[np.isfinite(r)], w[np.isfinite(r)]) for r, w in pairs]
        pairs = [(r, w) for r, w in pairs if r.size > 1]
        if not pairs:
            known = np.isfinite(stated.get(key, np.nan))
            variance[key], count[key] = (stated[key] ** 2, STATED) if known else (scales[key] ** 2, 1.0)
            continue
        psi = np.concatenate([w * r for r, w in pairs])
        z2 = np.concatenate([(r / scales[key]) ** 2 for r, _ in pairs])
        slope = np.mean((TAIL + 1) * (TAIL - z2) / (TAIL + z2) ** 2)
        # One location a grip was fitted: correct for the lost degrees of freedom.
        lost = psi.size / max(psi.size - len(pairs), 1)
        stretch = autocorrelation_time([w * r for r, w in pairs])
        found = float(np.mean(psi**2) / slope**2 * lost * stretch)
        variance[key] = max(found, LEAST**2)
        count[key] = float(max(psi.size - len(pairs), 1) / stretch)
        if variance[key] < stated.get(key, 0.0) ** 2:
            total = STATED + count[key]
            variance[key] = (STATED * stated[key] ** 2 + count[key] * variance[key]) / total
            count[key] = total
    return Noise(variance, count)


def autocorrelation_time(series: list[np.ndarray]) -> float:
    """Integrated autocorrelation time of residual series, pooled; at least MIN_STRETCH.

    Geyer's (1992) initial positive sequence: -1 + 2 times the sum of autocorrelations in pairs of
    lags (0, 1), (2, 3), ... up to the first pair that is not positive. Below 1 where successive
    residuals cancel, as differentiated noise does. Series about their own mean are biased by
    -1 / length, which is put back.
    """
    bias = len(series) / max(sum(r.size for r in series), 1)
    power = sum(float(r @ r) for r in series)
    size = sum(r.size for r in series)

    def rho(lag: int) -> float:
        if lag == 0:
            return 1.0
        pairs = sum(max(r.size - lag, 0) for r in series)
        if pairs < 8 or power <= 0:
            return 0.0
        products = sum(float(r[lag:] @ r[: r.size - lag]) for r in series if r.size > lag)
        return products / power * size / pairs + bias

    total, lags = -1.0, 1
    for lag in range(0, FARTHEST_LAG, 2):
        pair = rho(lag) + rho(lag + 1)
        # A pair counts only where it stands out of its own sampling noise.
        if lag > 0 and pair <= 2 / np.sqrt(size):
            break
        total += 2 * pair
        lags = lag + 1
    # Estimated from few samples, the excess over white noise is mostly noise itself: its variance is
    # about 4 / size a lag, and it is shrunk by that (positive-part James and Stein 1961).
    excess = total - 1
    if excess != 0 and size:
        total = 1 + excess * max(0.0, 1 - 4 * lags / size / excess**2)
    return max(total, MIN_STRETCH)
