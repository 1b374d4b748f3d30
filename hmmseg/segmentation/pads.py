"""Pads and timing as the recording shows them: compliance, and delay of force against position.

Before a block is lifted and after it is set down it rests, so that the fingers' distance and height follow
the pads alone (`hmmseg.contact.equations`). Within one such stretch

    value(t - delay) = rest - compliance x load(t)

with the distance and the summed grip forces, or the height and the net vertical force. Stated stiffnesses
are a prior; the delay is common to all forces (a clock offset, a filter; foam's viscosity makes it lead by
its damping over its stiffness). Each stretch gives a compliance of its own; how far these differ is the
form error of a linear pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, pads_of
from hmmseg.errors_in_variables import slope_between
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.levels import CONTRADICTS, TAIL
from hmmseg.robust import NORMAL, weighted_median
from hmmseg.segmentation.emissions import Parameters
from hmmseg.segmentation.lateness import Squeeze, lateness, squeeze
from hmmseg.segmentation.stretches import Stretch, evidence, fitted, reading, ringing, steepest, stretches
from hmmseg.segmentation.toe import NONE, Toe, find

# prior: of a stated stiffness, where the rig does not say: foams of one make differ by as much
STIFFNESS_SD = 0.3
RIGID = 2e-5  # chosen: m/N; a stiffer pad hides its compression from any force sensor
SOFT = 2e-4  # prior: m/N; how far pads that are said to be rigid may give after all
FORM, FORM_STRETCHES = 0.05, 4.0  # prior: usual form error of foam, worth so many stretches
BETWEEN = 0.15  # prior: of a sample interval: forces read at other moments than their own samples'
REACH = 0.4  # numerics: s; free motion beside a hold that is looked at: the longest delay, and a touch
FINE = np.arange(-0.01, 0.0101, 0.001)  # numerics: s; delays below what counts as one
LEAD_SD = 0.003  # prior: s; prior of a delay below what counts as one: foams lead by a few ms at most
LATE = 0.01  # chosen: s; a longer delay is the sensor's
DECISIVE = 15.0  # chosen: nats for a longer delay against none; its prior probability is about exp(-5)
LEAST = 0.05  # chosen: information of a stretch, as a share of the best one's, to be asked
IMPLAUSIBLE = 3.0  # chosen: how much stiffer than stated no pad is
LATE_SHARE = 0.1  # prior: of a delay: a filter of another order, a shift that is partly a filter
SLIDING = 0.9  # chosen: quantile of the steepest ratios of forces of all contacts that is friction's
LOUD = 0.9  # chosen: quantile of what forces show after releases that is how loud they ring
ENOUGH = 24  # chosen: stretches that tell a delay


@dataclass(frozen=True)
class Compliance:
    """Compliance [m/N], its standard deviation, and the share by which one contact may differ from it.

    `toe` is what contacts give beside it when they are hardly pressed.
    """

    value: float
    sd: float
    form: float
    toe: Toe = NONE

    @property
    def doubt(self) -> float:
        """Standard deviation as a share of it, at most all."""
        return min(self.sd / self.value, 1.0) if self.value > 0 else 0.0


@dataclass(frozen=True)
class Sensing:
    """What one hand's recordings show of its pads and of the delay of its forces.

    `delay` [s] is of the forces (negative: they lead), `delay_sd` its standard deviation. Where it is the
    sensor's (`late`), forces are to be read `delay` later, or, of a `filter`, undone. `friction` is the
    largest ratio of shear to grip force that one finger's pad is seen to bear as it lets go.
    """

    normal: Compliance
    shear: Compliance
    delay: float
    delay_sd: float
    late: bool = False
    filter: bool = False
    friction: float = np.inf

    @property
    def pads(self) -> Pads:
        """Both fingers alike."""
        return Pads(self.normal.value, self.normal.value, self.shear.value, self.shear.value)

    def remarks(self, rig: Rig) -> tuple[str, ...]:
        """What the recording contradicts the rig in, for people."""
        out = []
        if self.late:
            how = "are filtered with a time constant of" if self.filter else "come late by"
            out.append(f"forces {how} {1e3 * self.delay:.0f} ms against positions; boundaries allow for it")
        nominal, found = pads_of(rig).normal1, self.normal
        if abs(found.value - nominal) > max(CONTRADICTS * found.sd, STIFFNESS_SD * nominal):
            stated = f"rig.toml says {1e6 * nominal:.0f}" if nominal > 0 else "rig.toml says they are rigid"
            out.append(f"the pads give {1e6 * found.value:.0f} um/N along the grip, where {stated}; "
                       "boundaries allow for it")  # fmt: skip
        return tuple(out)


def read_again(s: Signals, sensing: Sensing) -> Signals:
    """The signals with forces brought forward by the delay, or with their filter undone."""
    if not sensing.late:
        return s
    forces, louder = {}, 1.0
    for name in ("fx1", "fy1", "fx2", "fy2"):
        force = getattr(s, name)
        there = np.isfinite(force)
        if sensing.filter:
            forces[name] = np.full_like(force, np.nan)
            forces[name][there], louder = _unfiltered(s.t[there], force[there], sensing.delay)
        else:
            forces[name] = limited(s.t + sensing.delay, s.t[there], force[there])
    return replace(s, **forces, sd_force=s.sd_force * louder)


def _unfiltered(t: np.ndarray, force: np.ndarray, constant: float) -> tuple[np.ndarray, float]:
    """Forces [N] without their first-order filter of this time `constant` [s], and how much louder they are.

    (F_n - k F_(n-1)) / (1 - k), k the share that a sample interval h keeps, is a steady input, or one that
    changes evenly as it was constant - h k / (1 - k) before: h / 2 where it is slow.
    """
    step = np.diff(t)
    kept = np.exp(-step / constant)
    read = np.r_[force[:1], (force[1:] - kept * force[:-1]) / (1 - kept)]
    ago = np.r_[0.0, constant - step * kept / (1 - kept)]
    louder = float(np.median(np.sqrt(1 + kept**2) / (1 - kept)))
    return limited(t, t - ago, read), louder


def limited(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Readings (num_samples,) at t [s] as they are `at` other times, NaN where the last is no neighbour.

    Each is read from its nearest neighbour, with the lesser of the slopes on either side of that, if they
    agree: a force that jumps is not smeared over the samples before (the minmod limiter; van Leer 1979).
    """
    slopes = np.diff(values) / np.diff(t)
    before, after = np.r_[slopes[:1], slopes], np.r_[slopes, slopes[-1:]]
    slope = np.where(before * after > 0, np.where(np.abs(before) < np.abs(after), before, after), 0.0)
    right = np.clip(np.searchsorted(t, at), 1, t.size - 1)
    nearest = np.where(at - t[right - 1] <= t[right] - at, right - 1, right)
    out = values[nearest] + slope[nearest] * (at - t[nearest])
    return np.where(at > t[-1] + (t[-1] - t[-2]) / 2, np.nan, out)


def sense(
    signals: Sequence[Signals], paths: Sequence[tuple[np.ndarray, np.ndarray]], steps: Sequence[Subtask],
    parameters: Parameters, rig: Rig, again: bool = False,
) -> Sensing:  # fmt: skip
    """Pads and delay from aligned recordings.

    `again`: forces have been read again, so that no long delay is left. `paths`: per recording the times
    [s] and subtasks (num_timesteps,) of its alignment.
    """
    grips: list[Stretch] = []
    loads: list[Stretch] = []
    squeezes: list[Squeeze | None] = []
    ratios: list[float] = []
    rings: list[tuple[float, float, float]] = []
    for s, (t, path) in zip(signals, paths, strict=True):
        for step in steps:
            if step.state == ON_GROUND and (path == step.index).sum() > 1:
                own = np.flatnonzero(path == step.index)
                start, end = float(t[max(own[0] - 1, 0)]), float(t[min(own[-1] + 1, t.size - 1)])
                pair = stretches(s, start, end, parameters.weight[str(step.object)], parameters)
                for out, stretch in zip((grips, loads), pair, strict=True):
                    if stretch is not None:
                        out.append(stretch)
                ratios += steepest(s, start, end, parameters)
                rings += ringing(s, start, end, parameters)
                if not again:
                    squeezes.append(squeeze(s, *_beside(t, path, steps, step.index), parameters))
    rung = np.quantile(rings, LOUD, axis=0) if rings else np.zeros(3)
    squeezes = [q and replace(q, sd_load=float(np.hypot(q.sd_load, rung[2]))) for q in squeezes]
    nominal = pads_of(rig)
    priors = [_prior(nominal.normal1, max(rig.systematic.pad_stiffness)),
              _prior(nominal.shear1, max(rig.systematic.pad_stiffness))]  # fmt: skip
    delay, sd, late, filtered = _delay((grips, loads), priors, squeezes)
    toe = NONE
    if not (late or again):  # forces that were late, or a wrist's, show no law so finely
        toe = find([(*_read(s, delay, filtered), s.sd) for s in grips])
        if toe is not NONE:  # what bends looks like what is late
            grips = [replace(s, toe=toe) for s in grips]
            delay, sd, late, filtered = _delay((grips, loads), priors)

    def found() -> list[Compliance]:
        return [_compliance([(*_read(s, delay, filtered), s.sd) for s in own], prior, float(r))
                for own, prior, r in zip((grips, loads), priors, rung[:2], strict=True)]  # fmt: skip

    normal, shear = found()
    if late and normal.value < priors[0][0] / IMPLAUSIBLE:  # noise that a delay happens to smooth away
        delay, sd, late, filtered = _delay((grips, loads), priors)
        normal, shear = found()
    normal = replace(normal, toe=toe)
    between = BETWEEN * float(np.median([np.median(np.diff(s.t)) for s in signals])) if late else 0.0
    doubt = float(np.sqrt(sd**2 + (LATE_SHARE * delay * late) ** 2 + between**2))
    friction = float(np.quantile(ratios, SLIDING)) if ratios else np.inf
    return Sensing(normal, shear, delay, doubt, late, filtered, friction)


def _read(s: Stretch, delay: float, filtered: bool) -> tuple[np.ndarray, np.ndarray]:
    """Loads and values at a delay; of its two ends, which say most, less than a sample leaves neither out."""
    reach = abs(delay) if abs(delay) < LATE else 0.0
    return reading(s, **{"constant" if filtered else "shift": delay}, reach=reach)


def _prior(compliance: float, stated: float) -> tuple[float, float]:
    return compliance, (stated or STIFFNESS_SD) * compliance if compliance > 0 else SOFT


def _beside(t: np.ndarray, path: np.ndarray, steps: Sequence[Subtask], index: int) -> tuple[float, float]:
    """Ends [s] of a hold with the free motion beside it: a touch may be earlier than its forces."""
    ends = []
    for beside, end, way in ((index - 1, 0, -1), (index + 1, -1, 1)):
        near = float(t[np.flatnonzero(path == index)[end]])
        free = t[path == beside] if 0 <= beside < len(steps) and steps[beside].state == FREE else t[:0]
        far = near + way * REACH
        ends.append(float(np.clip(far, free[0], free[-1])) if free.size else near)
    return ends[0], ends[1]


def _delay(
    kinds: Sequence[Sequence[Stretch]], priors: Sequence[tuple[float, float]],
    squeezes: Sequence[Squeeze | None] = (),
) -> tuple[float, float, bool, bool]:  # fmt: skip
    """Delay [s], its sd, whether it is the sensor's, and whether a filter explains it better.

    Without `squeezes` it is below what counts as the sensor's.
    """
    kinds = [own[:: max(1, len(own) // ENOUGH)] for own in kinds]
    if not any(kinds):
        return 0.0, LEAD_SD, False, False
    there = [s for s in squeezes if s is not None]
    found = lateness(there[:: max(1, len(there) // ENOUGH)], priors[0], LATE)
    if found is not None and found.delay > LATE and found.gain > DECISIVE:
        # A delay is common to all forces; what the grip alone favours is a fault of its pads.
        delays = np.array([0.0, found.delay])
        none, late = evidence(kinds[1:], priors[1:], delays, found.filter)[0]
        if late >= none:
            return found.delay, found.sd, True, found.filter
    log_posterior = evidence(kinds, priors, FINE, False, inner=True).sum(axis=0) - (FINE / LEAD_SD) ** 2 / 2
    if not np.isfinite(log_posterior).any():
        return 0.0, LEAD_SD, False, False
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    mean = float(weight @ FINE)
    return mean, float(np.sqrt(weight @ (FINE - mean) ** 2)), False, False


def _compliance(
    readings: Sequence[tuple[np.ndarray, np.ndarray, float]], prior: tuple[float, float],
    ringing: float = 0.0,
) -> Compliance:  # fmt: skip
    """Common compliance of all stretches, each with a rest of its own; `prior`: mean and sd [m/N].

    `ringing` [N]: noise that loads are known to have.
    """
    found = np.array([_slope(*one, ringing) for one in readings]).reshape(-1, 3)
    c, w, apart = found[found[:, 1] > 0].T
    if not c.size:
        return Compliance(prior[0], prior[1], FORM)
    telling = w > LEAST * w.max()
    c, w, apart = c[telling], w[telling], apart[telling]
    middle = weighted_median(c, w)
    # Scatter of stretches beyond what noise explains, by a robust method of moments.
    spread = NORMAL * weighted_median(np.abs(c - middle), w)
    between = max(spread**2 - 1 / float(np.median(w)), 0.0) if c.size > 1 else 0.0
    usual = FORM * max(abs(middle), prior[0])
    between = (c.size * between + FORM_STRETCHES * usual**2) / (c.size + FORM_STRETCHES)
    trusted = (TAIL + 1) / (TAIL + (c - middle) ** 2 / (1 / w + between)) / (1 / w + between)
    # Where forces ring all stretches are off for one reason, which their number does not mend.
    seen = float(trusted @ c / trusted.sum())
    information = 1 / (1 / trusted.sum() + float(trusted @ apart / trusted.sum()) ** 2)
    total = information + prior[1] ** -2
    value = float(max((information * seen + prior[0] * prior[1] ** -2) / total, 0.0))
    return Compliance(value, float(total**-0.5), float(np.sqrt(between)) / max(value, RIGID))


def _slope(load: np.ndarray, place: np.ndarray, sd: float, ringing: float) -> tuple[float, float, float]:
    """Compliance [m/N] of one stretch, its information, and what it is off by as others are.

    Loads that ring, by `ringing` [N] and maybe more, while nothing moves flatten the line of places over
    loads, to none at the worst (`slope_between`).
    """
    slope, weight, _ = fitted(load, place, sd)
    if weight == 0:
        return float(slope), 0.0, 0.0
    x, y = load - load.mean(), place.mean() - place
    square, free = float(x @ x), load.size - 2.0
    middle, apart = slope_between(square, float(x @ y), float(y @ y), free, (ringing, sd))
    if not np.isfinite(apart):
        return middle, 0.0, 0.0
    value = middle if apart else float(slope)
    sampling = float(((y - value * x) ** 2).sum()) / free * square / (square - free * ringing**2) ** 2
    return value, float(1.0 / (max(1.0 / weight, sampling) + apart**2)), apart
