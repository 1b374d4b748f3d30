"""A structure that rings after an event, found in recorded trials without a model of it.

Once contacts have settled, y(t) = parabola + exp(-damping w t) (A sin w t + B cos w t) with w = 2 pi f. A, B
and the parabola differ from trial to trial, f and damping are common. For given f and damping the fit is
linear (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973); these two are searched on a grid
and refined. Intervals come from the scatter between trials (jackknife), which needs no noise model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

from hmmseg.levels import SETTLING
from simgap.generic.trials import Layout, resampled, windowed

LEAST = 4  # numerics: fewest coefficients in a mean power
DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.2)  # numerics: grid of the search
LIGHTEST, HEAVIEST = 1e-3, 0.25  # chosen: range of damping ratios that count as ringing
FREQUENCIES = 80  # numerics: points of the search's grid
SHORTEST = 12  # numerics: samples; an oscillation is searched for in no shorter window
SIMPLEX: dict[str, Any] = {  # numerics: of the search
    "method": "Nelder-Mead", "options": {"xatol": 1e-4, "fatol": 1e-7, "maxiter": 150},
}  # fmt: skip
RINGS = 0.2  # chosen: share of the variance after an event that an oscillation must explain


@dataclass(frozen=True)
class Ring:
    """`frequency` [Hz] and `damping` (ratio to critical), with standard errors and 90 % intervals."""

    frequency: float
    damping: float
    frequency_sd: float
    damping_sd: float
    frequency_90: tuple[float, float]
    damping_90: tuple[float, float]

    def waves(self, t: np.ndarray) -> np.ndarray:
        """Damped sine and cosine (2, n) at times t (n,) [s] since the event; 0 before it."""
        omega, since = 2 * np.pi * self.frequency, np.maximum(t, 0.0)
        decay = np.where(t >= 0, np.exp(-self.damping * omega * since), 0.0)
        return decay * np.array([np.sin(omega * since), np.cos(omega * since)])


def find_ring(lay: Layout) -> Ring | None:
    """The strongest oscillation after an event, where real trials have more power than simulated ones.

    After the last event all that was recorded is searched, as what is compared may end sooner. Nothing is
    searched within SETTLING of an event: what changes there with the contact would pass for damping.
    """
    kinds, best, found = (lay.ensembles.real, lay.ensembles.sim), 0.0, None
    last = len(lay.ensembles.subtasks) - 1
    compared = float(np.mean([c.edges[-1] - c.edges[-2] for c in kinds[0]]))
    longest = min(c.trial.t[-1] - c.edges[-2] for c in kinds[0])
    since = np.arange(0.0, longest, 1 / lay.rate) if longest > compared + 0.5 / lay.rate else np.zeros(0)
    for k in range(1, last + 1):
        for c, name in enumerate(lay.ensembles.channels):
            real, sim = (np.array([windowed(lay, cut, c, k) for cut in kind]) for kind in kinds)
            if real.shape[1] < 4 * LEAST or real.var(1).mean() < sim.var(1).mean():
                continue
            rest = real - sim.mean(0)  # what is simulated too is no ringing
            windows = rest if rest.var(1).mean() < real.var(1).mean() else real
            if k == last and since.size:
                ends = ((cut.trial.t, cut.trial.channels[name], cut.edges[-2] + since) for cut in kinds[0])
                windows = np.array([resampled(*end, lay.rate) for end in ends])
            settled = windows[:, round(SETTLING * lay.rate) :]
            share = 1 - _screened(settled, lay.rate)[2]
            strength = share * np.square(_detrended(settled)).sum() / (len(settled) * lay.scale[c] ** 2)
            if share > RINGS and strength > best:
                best, found = strength, settled
    return None if found is None else fit_ring(found, lay.rate)


def fit_ring(windows: np.ndarray, rate: float) -> Ring | None:
    """Fit the oscillation common to several windows.

    Args:
        windows: Samples (trials, n).
        rate: Sampling rate [Hz].

    Returns:
        The ring; None where windows are too short, or the best frequency or damping lies at an end of its
        range.
    """
    ends = np.log([_range(windows, rate), (LIGHTEST, HEAVIEST)])

    def refined(windows: np.ndarray, start: np.ndarray) -> np.ndarray:
        def cost(u: np.ndarray) -> float:
            return float(np.log(_left(windows, rate, *np.exp(u))))

        return minimize(cost, start, **{**SIMPLEX, "bounds": ends}).x

    *start, left = _screened(windows, rate)
    if left == 1.0:
        return None
    best, n = refined(windows, np.log(start)), len(windows)
    if (np.abs(best[:, None] - ends) < 0.01).any():
        return None
    sd, reach = np.full(2, np.nan), np.nan
    if n > 1:
        each = np.array([refined(np.delete(windows, i, 0), best) for i in range(n)])
        sd = np.sqrt((n - 1) / n * ((each - each.mean(0)) ** 2).sum(0))
        reach = -float(stdtrit(n - 1, 0.05))
    (frequency, damping), low, high = np.exp(best), np.exp(best - reach * sd), np.exp(best + reach * sd)
    return Ring(float(frequency), float(damping), float(frequency * sd[0]), float(damping * sd[1]),
                (float(low[0]), float(high[0])), (float(low[1]), float(high[1])))  # fmt: skip


def _range(windows: np.ndarray, rate: float) -> tuple[float, float]:
    """Frequencies [Hz] of one period in windows (trials, n), and of two samples a period (Nyquist's)."""
    return rate / max(windows.shape[1], 1), rate / 2


def _screened(windows: np.ndarray, rate: float) -> tuple[float, float, float]:
    """Best frequency [Hz] and damping on a grid, and the share of variance left; 1 of too short windows."""
    low, high = _range(windows, rate)
    if windows.shape[1] < SHORTEST or low >= high:
        return np.nan, np.nan, 1.0
    grid = [(f, z) for f in np.geomspace(low, high, FREQUENCIES) for z in DAMPINGS]
    left, place = min((_left(windows, rate, *g), g) for g in grid)
    return *place, left


def _left(windows: np.ndarray, rate: float, frequency: float, damping: float) -> float:
    """Share of the variance about each window's parabola that a ring leaves, mean over trials."""
    angle = 2 * np.pi * frequency * np.arange(windows.shape[1]) / rate
    waves = np.exp(-damping * angle) * np.array([np.sin(angle), np.cos(angle)])
    basis, rest = np.linalg.qr(_detrended(waves).T)[0], _detrended(windows)
    size = np.maximum(np.square(rest).sum(1), 1e-300)  # every trial has the same weight
    return max(1 - float((np.square(rest @ basis).sum(1) / size).mean()), 1e-300)


def _detrended(windows: np.ndarray) -> np.ndarray:
    """Windows (trials, n) minus the parabola that fits each best."""
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, windows.shape[1]), 3))[0]
    return windows - windows @ basis @ basis.T
