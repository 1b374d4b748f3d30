"""Whether forces are on the scale that the rig has them on: against the pads, the noise, and each other.

A force that is read g times too large squeezes pads that seem 1 / g times as soft, and its noise is g times
the stated one; pads that truly differ leave the noise alone. Where [fingertip] states the pads, four
explanations of what grips show are weighed against each other: the rig is right, its pads are wrong, both
axes of force are scaled by g, or the vertical alone. A weight is then drawn from all of them, so that its
interval holds the truth whichever it is. And two fingers press what they carry alike, but for its inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.compliance import MISSTATED, SLOPE_SD
from estimation.nuisance import PadDoubt
from estimation.observations import MIN_FREE, WeighedTrial
from hmmseg.hand.force_units import WHITE
from hmmseg.io.rig import Rig
from hmmseg.robust import robust_sd

MISREAD = 0.5  # prior: share of forces among what is to blame where pads and forces contradict each other
GAIN_LOG_SD = 1.0  # prior: of log g: another range or unit of the amplifier
PADS_LOG_SD = 0.8  # prior: of a wrong stiffness: foams of another kind are a third or three times as stiff
NOISE_LOG_SD, AXIS_LOG_SD = 0.35, 0.3  # prior: noise is off its statement by a factor of two once in twenty
GRID = np.linspace(np.log(1e-3), np.log(1e3), 2001)  # numerics: log g; twice a third of a percent a step
RAISED = 2.0  # chosen: times its prior that the probability of a wrong scale must be, to be taken up
TELLING = 1.0  # limit: sd of the pads' share along the grip, from which grips show nothing of it
UNEVEN = 1.3  # limit: of two fingers' mean forces on what they carry: drifts and drags make up to 1.16


@dataclass(frozen=True)
class ForceScale:
    """The posterior of g (GRID,), by which vertical forces are read too large, and that of any g but 1.

    `probability` that forces are misread; `density` (len(GRID),) of log g if they are.
    """

    probability: float
    density: np.ndarray

    def corrected(self, chain: np.ndarray, weights: list[int], rng: np.random.Generator) -> np.ndarray:
        """Draws (walkers, steps, Q), those of `weights` [N] with g drawn from its posterior."""
        out, size = chain.copy(), chain.shape[:2]
        log_g = np.where(
            rng.uniform(size=size) < self.probability, rng.choice(GRID, size, p=self.density), 0.0
        )
        out[..., weights] *= np.exp(-log_g)[..., None]
        return out

    def remark(self) -> str:
        """What contradicts what, for people."""
        g = float(np.exp(self.density @ GRID))
        size = f"{g:.2g} times too large" if g > 1 else f"{1 / g:.2g} times too small"
        return (
            f"forces and [fingertip] contradict each other: forces are read {size} with a probability of "
            f"{self.probability:.0%}, or the pads are not as stated; weights allow for both, and a weighed "
            "block would tell"
        )


def force_scale(doubt: PadDoubt, weighed: Sequence[WeighedTrial], rig: Rig) -> ForceScale | None:
    """The scale of forces where pads and noise say anything against 1; None where nothing does.

    Not to be used where forces come late, which makes slopes of readings over them flat.
    """
    tip = rig.fingertip
    if not np.isfinite([tip.normal_stiffness, tip.shear_stiffness]).all():
        return None
    (normal, normal_sd), (shear, shear_sd) = doubt.seen
    if normal_sd > TELLING:
        return None
    share = np.expm1(-GRID)  # of compliance beyond the stated one, where forces are g times too large

    def pads(of_normal: np.ndarray | float, of_shear: np.ndarray | float) -> np.ndarray:
        """Log likelihood (len(GRID),) of both shares where truly these."""
        out = np.zeros(GRID.size)
        for seen, sd, true in ((normal, normal_sd, of_normal), (shear, shear_sd, of_shear)):
            if np.isfinite(sd):
                error = np.hypot(sd, SLOPE_SD * (1 + np.asarray(true)))
                out = out - 0.5 * ((seen - true) / error) ** 2 - np.log(error)
        return out

    def noise(of_x: np.ndarray | float, of_y: np.ndarray | float) -> np.ndarray:
        """Log likelihood of the noise of both axes, read `of` (logarithms) times too large."""
        excess = _noise_excess(weighed, rig)
        if excess is None:
            return np.zeros(GRID.size)
        covariance = np.full((2, 2), NOISE_LOG_SD**2) + AXIS_LOG_SD**2 * np.eye(2)
        off = np.stack(np.broadcast_arrays(excess[0] - of_x, excess[1] - of_y, GRID)[:2])
        return -0.5 * (off * np.linalg.solve(covariance, off)).sum(axis=0)

    def normal_prior(sd: float) -> np.ndarray:
        density = np.exp(-0.5 * (GRID / sd) ** 2)
        return np.log(density / density.sum())

    def evidence(log_likelihood: np.ndarray, sd: float) -> float:
        return float(np.logaddexp.reduce(normal_prior(sd) + log_likelihood))

    foam = max(evidence(pads(share, share), PADS_LOG_SD), evidence(pads(share, 0.0), PADS_LOG_SD),
               evidence(pads(0.0, share), PADS_LOG_SD))  # fmt: skip
    both, vertical = pads(share, share) + noise(GRID, GRID), pads(0.0, share) + noise(0.0, GRID)
    right = float((pads(0.0, 0.0) + noise(0.0, 0.0))[0])
    log_odds = np.array([
        np.log(1 - MISSTATED) + right,
        np.log(MISSTATED * (1 - MISREAD)) + foam + float(noise(0.0, 0.0)[0]),
        np.log(MISSTATED * MISREAD / 2) + evidence(both, GAIN_LOG_SD),
        np.log(MISSTATED * MISREAD / 2) + evidence(vertical, GAIN_LOG_SD),
    ])  # fmt: skip
    odds = np.exp(log_odds - np.logaddexp.reduce(log_odds))
    wrong = float(odds[2] + odds[3])
    if wrong < RAISED * MISSTATED * MISREAD:
        return None
    prior = normal_prior(GAIN_LOG_SD)
    of_g = [np.exp(prior + each - np.logaddexp.reduce(prior + each)) for each in (both, vertical)]
    density = (odds[2] * of_g[0] + odds[3] * of_g[1]) / wrong
    return ForceScale(wrong, density / density.sum())


def _noise_excess(weighed: Sequence[WeighedTrial], rig: Rig) -> tuple[float, float] | None:
    """Logarithm of the noise of fx and of fy over the stated one; None where it is filtered or unstated."""
    if rig.noise.force is None:
        return None
    out = []
    for axis in "xy":
        bends, followed = [], []
        for a in weighed:
            free = a.weights.free > 0
            for finger in (1, 2):
                force = getattr(a.signals, f"f{axis}{finger}")
                bend = np.diff(np.where(free, force, np.nan), 2)
                bends.append(bend[np.isfinite(bend)] / a.signals.sd_force)
                both = bend[1:] * bend[:-1]
                followed.append(both[np.isfinite(both)] / a.signals.sd_force**2)
        every, neighbours = np.concatenate(bends), np.concatenate(followed)
        if neighbours.size < MIN_FREE or not every.any():
            return None
        if float(neighbours.mean() / np.mean(every**2)) > WHITE:
            return None
        shown = robust_sd(every) / np.sqrt(6)
        if shown == 0:  # coarser than its noise
            return None
        out.append(float(np.log(shown)))
    return out[0], out[1]


def uneven(weighed: Sequence[WeighedTrial]) -> str | None:
    """What says that two fingers press unequally on what they carry, though nothing else holds it."""
    pressed = []
    for a in weighed:
        left, right = a.signals.fx1, -a.signals.fx2
        known = np.isfinite(left) & np.isfinite(right)
        for grip in a.weights.grips.values():
            weight = grip["force"].mean(axis=0) * known
            if weight.sum() > 0:
                pressed.append([weight @ np.where(known, f, 0.0) / weight.sum() for f in (left, right)])
    if not pressed:
        return None
    left, right = np.median(pressed, axis=0)
    if min(left, right) <= 0 or max(left, right) < UNEVEN * min(left, right):
        return None
    return (
        f"fx1 and -fx2 press what is carried with {left:.3g} and {right:.3g} N, which should be alike: "
        "one of the fingers is read on another scale"
    )
