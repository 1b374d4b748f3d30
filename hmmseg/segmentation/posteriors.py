"""Boundary posteriors of an aligned trial, from the contacts that change at each boundary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, block_y, hanging
from hmmseg.hand.signals import Signals, central_differences, one_sided
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.levels import DRIFTS, SURE
from hmmseg.robust import median_of_known
from hmmseg.segmentation.boundaries import BoundaryPosterior, Kind, evenly, normal
from hmmseg.segmentation.changes import DISCREPANCY, Change, Penetration, Prior, moment, restricted
from hmmseg.segmentation.emissions import WINDOW, Features, Parameters, channel_sd
from hmmseg.segmentation.pads import RIGID, Sensing
from hmmseg.segmentation.spans import Span, spans_between

STIFFEST = 1e-7  # numerics: m/N


@dataclass(frozen=True)
class Contacts:
    """Fingertip signals of one trial, with the fitted biases, weights, pads and noise.

    `compression` (2, T): compression of each finger's pad, from its force [m]; `inward` (2, T): position
    along the finger's closing direction [m]; `inward_rate` (2, 2, T): its rate just before and just after
    each sample, by finger; `sinking` (2, T): that of the mean height, downwards [m/s]; `deflection` (T,):
    mean shear deflection of the pads, from the net vertical force [m]; `tangential` (2, T): vertical forces
    [N].
    """

    signals: Signals
    sensing: Sensing
    compression: np.ndarray
    inward: np.ndarray
    inward_rate: np.ndarray
    sinking: np.ndarray
    deflection: np.ndarray
    tangential: np.ndarray
    weight: dict[str, float]
    sd: dict[str, float]

    def change(
        self, before: Subtask, after: Subtask, prior: Prior, held: tuple[float, float]
    ) -> Change | None:
        """Evidence about one boundary; None if these signals have none.

        `held` [s]: a stretch on the held side of the boundary in which the block rests or is held.
        """
        stretch = (self.signals.t >= held[0]) & (self.signals.t <= held[1])
        if not stretch.any():
            return None
        timing = self.sensing.delay_sd
        if FREE in (before.state, after.state):
            making = before.state == FREE
            fingers = tuple(self._finger(i, stretch, making) for i in (0, 1))
            slips = () if making else tuple(self._slip(i, stretch) for i in (0, 1))
            return restricted(Change(fingers, prior, making, "impact" if making else "smooth", timing, slips))
        if {before.state, after.state} == {ON_GROUND, ABOVE_GROUND}:
            making = after.state == ON_GROUND
            load = self._load(before, stretch, making)
            if self.signals.timing is not None:
                nearest = self.signals.timing[stretch][:: 1 if making else -1][:2]
                timing = float(np.hypot(timing, np.median(nearest)))
            return restricted(Change((load,), prior, making, "landing" if making else "launch", timing))
        return None

    def _finger(self, i: int, held: np.ndarray, making: bool) -> Penetration:
        """Penetration of finger i past the face of the block, which is midway between both estimates."""
        inward, rate = self.inward.mean(axis=0), self.inward_rate.mean(axis=1)
        face = median_of_known(inward[held] - self.compression[i, held])
        # An error of the pad's stiffness shifts the face.
        pressed = np.nan_to_num(median_of_known(self.compression[i, held]))
        sd_inward = float(np.hypot(self.sd["inward"], self.sensing.normal.doubt * pressed))
        sd = self.sd["compression"]
        return self._timely(Penetration(
            self.signals.t, self.compression[i], inward - face, rate, sd, sd,
            sd_inward, self.sd["inward_rate"], self.sensing.normal.form,
            self.sensing.normal.value + self.sensing.normal.toe.slope < RIGID,
        ), making)  # fmt: skip

    def _slip(self, i: int, held: np.ndarray) -> float:
        """Compression [m] at which finger i slides off a block that it has `held`, as friction is spent."""
        if self.sensing.friction <= 0:
            return 0.0
        needed = np.abs(median_of_known(self.tangential[i, held])) / self.sensing.friction
        return float(np.nan_to_num(_compression(np.array([needed]), self.sensing)[0]))

    def _load(self, before: Subtask, held: np.ndarray, making: bool) -> Penetration:
        """The fingers below the height at which the pads' shear just carries the weight."""
        y = self.signals.y
        level = median_of_known(y[held] - self.deflection[held])
        carrying = hanging(self.weight[str(before.object)], visible(self.sensing.pads))
        sd_y = float(np.hypot(self.sd["y"], self.sensing.shear.doubt * carrying))
        return self._timely(Penetration(
            self.signals.t, carrying - self.deflection, level + carrying - y, self.sinking,
            self.sd["deflection"], self.sd["carried"], sd_y, self.sd["vy"],
            self.sensing.shear.form, self.sensing.shear.value < RIGID,
        ), making)  # fmt: skip

    def _timely(self, c: Penetration, making: bool) -> Penetration:
        """Correct a penetration for a small delay, or lead, of the forces.

        A touch begins with the compression, and with a late sensor so does a release. Foam that leads by its
        viscosity releases where its force is spent, as it recovers more slowly. A stiff pad moves with its
        finger, so only its force shows how fast it is pressed.
        """
        rate = central_differences(c.t, c.pressed)[0] if c.hidden else c.rate.mean(axis=0)
        moved = self.sensing.delay * np.nan_to_num(rate)
        if not making and self.sensing.delay < 0:
            return replace(c, place=c.place - moved)
        # Where the gap exceeds the motion within a reading there is no compression: the force is ringing.
        meanwhile = np.abs(c.rate.mean(axis=0)) * (WINDOW + abs(self.sensing.delay))
        sure = (c.pressed > SURE * c.sd_apart) & ~(c.place < -SURE * c.sd_place - meanwhile)
        return replace(c, pressed=np.where(sure, np.maximum(c.pressed + moved, 0.0), c.pressed))


def _compression(force: np.ndarray, sensing: Sensing) -> np.ndarray:
    """Compression [m] of one pad at each normal force [N]."""
    return force * float(visible(sensing.pads).normal1) + sensing.normal.toe.give(2 * force) / 2


def visible(pads: Pads) -> Pads:
    """Compliances of at least STIFFEST, so that the force of a rigid pad still shows as a compression."""
    return Pads(*(max(float(c), STIFFEST) for c in pads))


def contacts(signals: Signals, sensing: Sensing, parameters: Parameters) -> Contacts:
    """Contacts of one trial; noise that the rig does not state is estimated from the recording."""
    s, bias, root2 = signals, parameters.bias, np.sqrt(2.0)
    normal = np.stack([s.fx1 - bias[0], -(s.fx2 - bias[2])])
    inward = np.stack([s.x1, -s.x2])
    sd_x, sd_y = channel_sd(s.sd_x, s.x1), channel_sd(s.sd_y, s.y1)
    rates, sinking, sd_vx, sd_vy = _rates(s, inward, sd_x, sd_y)
    force = parameters.force_sd(s)
    pads, toe = visible(sensing.pads), sensing.normal.toe
    fy1, fy2 = s.fy1 - bias[1], s.fy2 - bias[3]
    level = parameters.scale["level"]
    return Contacts(
        signals=s, sensing=sensing,
        compression=_compression(normal, sensing),
        inward=inward, inward_rate=rates, sinking=sinking, deflection=-block_y(0.0, fy1, fy2, pads),
        tangential=np.stack([fy1, fy2]),
        weight=parameters.weight,
        sd={
            "compression": force * (float(pads.normal1) + toe.slope),
            "inward": sd_x,
            "inward_rate": sd_vx,
            "y": float(np.sqrt(sd_y**2 / 2 + level**2)),
            "vy": sd_vy / root2,
            "deflection": root2 * hanging(force, pads),
            "carried": hanging(max(parameters.scale["carry"], root2 * force), pads),
        },
    )  # fmt: skip


def _rates(
    s: Signals, inward: np.ndarray, sd_x: float, sd_y: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Rates (2, 2, T) of closing and (2, T) of sinking, before and after each sample, and their noise [m/s].

    Velocities that are differences of positions have separate rates before and after.
    """
    if not s.derived:
        closing, noise = np.stack([s.vx1, -s.vx2]), (channel_sd(s.sd_vx, s.vx1), channel_sd(s.sd_vy, s.vy1))
        return np.stack([closing, closing]), np.stack([-s.vy, -s.vy]), *noise
    (left, noise), (right, _), (rising, _) = (one_sided(s.t, x) for x in (*inward, s.y))
    return np.stack([left, right], axis=1), -rising, noise * sd_x, noise * sd_y


INTERVAL = (0.05, 0.95)  # physics: a definition: the central 90 %
Touches = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Reading:
    """One recording, or one round of it: `fine` signals to locate contacts, `thinned` ones to align.

    `features` are those of `thinned`; `ends` [s]: first and last time of the recording.
    """

    fine: Signals
    thinned: Signals
    features: Features
    ends: tuple[float, float]


def contact_changes(
    reading: Reading, sensing: Sensing, steps: tuple[Subtask, ...], parameters: Parameters,
    posterior: AlignmentPosterior,
) -> list[Change | None]:  # fmt: skip
    """Evidence of one trial about each of its boundaries; None where its signals have none."""
    t = reading.thinned.t
    path = posterior.smoothed.argmax(axis=1)
    last = np.searchsorted(path, np.arange(len(steps) - 1), side="right") - 1
    edges = [float(t[0]), *t[last], float(t[-1])]
    table = contacts(reading.fine, sensing, parameters)
    out = []
    for k in range(len(steps) - 1):
        probability = posterior.moves[0][:, k]
        prior = Prior(t, probability, (edges[k], edges[k + 2]))
        n = int(probability.argmax())
        held = _held_side(reading.features, path, steps, k, n)
        out.append(table.change(steps[k], steps[k + 1], prior, held))
    return out


def boundary_posteriors(
    reading: Reading, changes: Sequence[Change | None], discrepancy: Mapping[tuple[Kind, int], float],
    posterior: AlignmentPosterior,
) -> tuple[BoundaryPosterior, ...]:  # fmt: skip
    """Posterior of each boundary of one aligned trial, given its contact `changes`."""
    out = []
    for k, change in enumerate(changes):
        if change is None:
            out.append(evenly(reading.thinned.t, posterior.moves[0][:, k]))
        else:
            boundary = moment(change, discrepancy.get(change.sort, DISCREPANCY))
            touched = len(change.contacts) > 1
            out.append(nearest_touch(reading.fine.touches, boundary) if touched else boundary)
    return tuple(out)


def nearest_touch(touches: Touches, boundary: BoundaryPosterior) -> BoundaryPosterior:
    """Replace a boundary by the nearest of `touches`, (time, sd) [s], unless the hand may have drifted."""
    middle = boundary.quantile(0.5)
    for time, sd in sorted(touches, key=lambda touch: abs(touch[0] - middle))[:1]:
        if abs(time - middle) < max(DRIFTS, 3 * sd, 3 * boundary.sd):
            return normal(time, sd)
    return boundary


def _held_side(
    f: Features, path: np.ndarray, steps: tuple[Subtask, ...], k: int, n: int
) -> tuple[float, float]:
    """Nearest stretch [s] to interval n, with forces if there are any, of the subtask that rests on the
    ground, before or after it."""
    t = f.t
    after = steps[k].state == FREE or steps[k + 1].name == "place"
    own = np.flatnonzero(path == (k + 1 if after else k))
    read = own[np.isfinite(f.force[own]).all(axis=1)]
    if after:
        first = float(t[read[read > n].min() if (read > n).any() else n + 1])
        return first, min(first + DRIFTS, max(float(t[own[-1]]) if own.size else 0.0, first))
    last = float(t[read[read <= n].max() if (read <= n).any() else n])
    return max(last - DRIFTS, min(float(t[own[0]]) if own.size else np.inf, last)), last


def to_spans(
    steps: tuple[Subtask, ...], boundaries: tuple[BoundaryPosterior, ...], first: float, last: float
) -> tuple[Span, ...]:
    """Spans between boundary medians, kept in order."""
    medians = np.maximum.accumulate([first, *(b.quantile(0.5) for b in boundaries), last]).tolist()
    sds = [0.0, *(b.sd for b in boundaries), 0.0]
    intervals = [(first, first), *(tuple(b.quantile(q) for q in INTERVAL) for b in boundaries), (last, last)]
    return spans_between(steps, medians, sds, intervals)
