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

from hmmseg.contact.decompose import ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, pads_of
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.emissions import TAIL, Parameters
from hmmseg.segmentation.stretches import Stretch, evidence, fitted, reading, steepest, stretches
from hmmseg.segmentation.toe import NONE, Toe, find

# prior: of a stated stiffness, where the rig does not say: foams of one make differ by as much
STIFFNESS_SD = 0.3
RIGID = 2e-5  # chosen: m/N; a stiffer pad hides its compression from any force sensor
SOFT = 2e-4  # prior: m/N; how far pads that are said to be rigid may give after all
FORM, FORM_STRETCHES = 0.05, 4.0  # prior: usual form error of foam, worth so many stretches
SLOWEST = 0.1  # prior: s; time constant of a force sensor's filter
# chosen: s; delays up to it are tried in steps of half a sample, then around the best of them ...
LONGEST = 0.3
FINE = np.arange(-0.01, 0.0101, 0.001)  # numerics
LEAD_SD = 0.003  # prior: s; prior of a delay below what counts as one: foams lead by a few ms at most
LATE = 0.01  # chosen: s; a longer delay is the sensor's
DECISIVE = 15.0  # chosen: nats for a longer delay against none; its prior probability is about exp(-5)
APART = 4.0  # chosen: sds beyond which a compliance contradicts the rig
LEAST = 0.05  # chosen: information of a stretch, as a share of the best one's, to be asked
IMPLAUSIBLE = 3.0  # chosen: how much stiffer than stated no pad is
LATE_SHARE = 0.1  # prior: of a delay: a filter of another order, a shift that is partly a filter
SLIDING = 0.9  # chosen: quantile of the steepest ratios of forces of all contacts that is friction's
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
        told, found = pads_of(rig).normal1, self.normal
        if abs(found.value - told) > max(APART * found.sd, STIFFNESS_SD * told):
            stated = f"rig.toml says {1e6 * told:.0f}" if told > 0 else "rig.toml says they are rigid"
            out.append(f"the pads give {1e6 * found.value:.0f} um/N along the grip, where {stated}; "
                       "boundaries allow for it")  # fmt: skip
        return tuple(out)


def read_again(s: Signals, sensing: Sensing) -> Signals:
    """The signals with forces brought forward by the delay, or with their filter undone."""
    if not sensing.late:
        return s
    forces = {}
    for name in ("fx1", "fy1", "fx2", "fy2"):
        force = getattr(s, name)
        there = np.isfinite(force)
        t, known = s.t[there], force[there]
        if sensing.filter:
            step = np.diff(t)
            kept = np.exp(-step / sensing.delay)
            known = (known[1:] - kept * known[:-1]) / (1 - kept)
            forces[name] = np.interp(s.t, t[1:] - step / 2, known)
        else:
            forces[name] = np.interp(s.t + sensing.delay, t, known, right=np.nan)
    return replace(s, **forces)


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
    ratios: list[float] = []
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
    nominal = pads_of(rig)
    priors = [_prior(nominal.normal1, max(rig.systematic.pad_stiffness)),
              _prior(nominal.shear1, max(rig.systematic.pad_stiffness))]  # fmt: skip
    delay, sd, late, filtered = _delay((grips, loads), priors, again)
    toe = NONE
    if not (late or again):  # forces that were late, or a wrist's, show no law so finely
        toe = find([(*_read(s, delay, filtered), s.sd) for s in grips])
        if toe is not NONE:  # what bends looks like what is late
            grips = [replace(s, toe=toe) for s in grips]
            delay, sd, late, filtered = _delay((grips, loads), priors, again=True)

    def found() -> list[Compliance]:
        return [_compliance([(*_read(s, delay, filtered), s.sd) for s in own], prior)
                for own, prior in zip((grips, loads), priors, strict=True)]  # fmt: skip

    normal, shear = found()
    if late and normal.value < priors[0][0] / IMPLAUSIBLE:  # noise that a delay happens to smooth away
        delay, sd, late, filtered = _delay((grips, loads), priors, again=True)
        normal, shear = found()
    normal = replace(normal, toe=toe)
    doubt = float(np.hypot(sd, LATE_SHARE * delay * late))
    friction = float(np.quantile(ratios, SLIDING)) if ratios else np.inf
    return Sensing(normal, shear, delay, doubt, late, filtered, friction)


def _read(s: Stretch, delay: float, filtered: bool) -> tuple[np.ndarray, np.ndarray]:
    """Loads and values at a delay; of its two ends, which say most, less than a sample leaves neither out."""
    reach = abs(delay) if abs(delay) < LATE else 0.0
    return reading(s, **{"constant" if filtered else "shift": delay}, reach=reach)


def _prior(compliance: float, stated: float) -> tuple[float, float]:
    return compliance, (stated or STIFFNESS_SD) * compliance if compliance > 0 else SOFT


def _delay(
    kinds: Sequence[Sequence[Stretch]], priors: Sequence[tuple[float, float]], again: bool
) -> tuple[float, float, bool, bool]:
    """Delay [s], its sd, whether it is the sensor's, and whether a filter explains it better."""
    kinds = [own[:: max(1, len(own) // ENOUGH)] for own in kinds]
    if not any(kinds):
        return 0.0, LEAD_SD, False, False
    best, late, filtered = 0.0, False, False
    if not again:
        interval = float(np.median(np.concatenate([s.step for own in kinds for s in own])))
        coarse = np.arange(0.0, LONGEST, max(interval / 2, 0.005))
        grids = {False: coarse, True: coarse[coarse <= SLOWEST]}
        none = evidence(kinds, priors, np.zeros(1), False)[:, 0]
        each = {filtered: evidence(kinds, priors, grid, filtered) for filtered, grid in grids.items()}
        together = {filtered: found.sum(axis=0) for filtered, found in each.items()}
        filtered = float(together[True].max()) > float(together[False].max())
        i = int(together[filtered].argmax())
        best = float(grids[filtered][i])
        late = best > LATE and float(together[filtered][i] - none.sum()) > DECISIVE
        # A delay is common to all forces; what one kind alone favours is a fault of the linear pad.
        late = late and bool((each[filtered][:, i] >= none).all())
    fine = FINE + (best if late else 0.0)
    log_posterior = evidence(kinds, priors, fine, filtered and late, inner=not late).sum(axis=0)
    if not late:
        log_posterior = log_posterior - (fine / LEAD_SD) ** 2 / 2
    if not np.isfinite(log_posterior).any():
        return 0.0, LEAD_SD, False, False
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    mean = float(weight @ fine)
    return mean, float(np.sqrt(weight @ (fine - mean) ** 2)), late, filtered and late


def _compliance(
    readings: Sequence[tuple[np.ndarray, np.ndarray, float]], prior: tuple[float, float]
) -> Compliance:
    """Common compliance of all stretches, each with a rest of its own; `prior`: mean and sd [m/N]."""
    found = [fitted(load, place, sd)[:2] for load, place, sd in readings]
    c, w = (np.array([f[i] for f in found if f[1] > 0]) for i in (0, 1))
    if not c.size:
        return Compliance(prior[0], prior[1], FORM)
    telling = w > LEAST * w.max()
    c, w = c[telling], w[telling]
    middle = _weighted_median(c, w)
    # Scatter of stretches beyond what noise explains, by a robust method of moments.
    spread = 1.4826 * _weighted_median(np.abs(c - middle), w)
    between = max(spread**2 - 1 / float(np.median(w)), 0.0) if c.size > 1 else 0.0
    usual = FORM * max(abs(middle), prior[0])
    between = (c.size * between + FORM_STRETCHES * usual**2) / (c.size + FORM_STRETCHES)
    trusted = (TAIL + 1) / (TAIL + (c - middle) ** 2 / (1 / w + between)) / (1 / w + between)
    total = trusted.sum() + prior[1] ** -2
    value = max(float((trusted @ c + prior[0] * prior[1] ** -2) / total), 0.0)
    return Compliance(value, float(total**-0.5), float(np.sqrt(between)) / max(value, RIGID))


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
