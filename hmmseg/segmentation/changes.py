"""One contact change: where it may be, what its contacts show, and the posterior of its moment.

Force and position must agree where there is contact. By how much they do not, at the contacts nearest to
the changes of one kind in all recordings at hand (a block that a first finger pushed, a table that
yields, pads that creep), is a discrepancy [m] that positions are then allowed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.segmentation.boundaries import (
    ONSET,
    POINTS,
    BoundaryPosterior,
    Crossing,
    Kind,
    blurred,
    crossing_density,
    first_of,
)
from hmmseg.segmentation.switching import SURE, Penetration, switch_probability

LIKELY = 1e-3  # chosen: least probability of an interval within which the crossing is looked at
SURROUNDING = 2.5  # chosen: sample intervals of the alignment within which it cannot tell one from another
DISCREPANCY, KNOWN = 1e-5, 2.0  # chosen: m; usual discrepancy of foam, worth so many contacts


@dataclass(frozen=True)
class Prior:
    """What the alignment says of one boundary: probability (T - 1,) of each of its intervals, t (T,) [s].

    It knows which contact is meant, and the moment but for a few samples: within those (and `limits` [s],
    the neighbouring boundaries) all times are alike.
    """

    t: np.ndarray
    probability: np.ndarray
    limits: tuple[float, float]

    def log_density(self, t: np.ndarray) -> np.ndarray:
        """Log prior density (unnormalised) of the boundary at t; -inf where it cannot be."""
        out = np.zeros_like(t)
        around = SURROUNDING * float(np.median(np.diff(self.t)))
        for n in np.flatnonzero(self.probability > LIKELY):
            low, high = self.t[n] - around, self.t[n + 1] + around
            out += self.probability[n] / (high - low) * ((t >= low) & (t <= high))
        inside = (t >= self.limits[0]) & (t <= self.limits[1])
        with np.errstate(divide="ignore"):
            return np.log(out * inside)


@dataclass(frozen=True)
class Change:
    """Contacts made, or broken, at one boundary: of two, the last one made and the first one broken count.

    `timing` [s] is the uncertainty of the forces' own clock.
    """

    contacts: tuple[Penetration, ...]
    prior: Prior
    making: bool
    kind: Kind
    timing: float

    @property
    def sort(self) -> tuple[Kind, int]:
        """Changes of one sort share a discrepancy."""
        return self.kind, len(self.contacts)

    @property
    def log_prior(self) -> np.ndarray:
        """Log prior probability (num_intervals,) of the intervals."""
        t = self.contacts[0].t
        return self.prior.log_density((t[1:] + t[:-1]) / 2) + np.log(np.diff(t))


def cut(change: Change) -> Change | None:
    """The samples among which the change lies; None where there are none."""
    t = change.contacts[0].t
    known = np.any([np.isfinite(c.pressed) | np.isfinite(c.place) for c in change.contacts], axis=0)
    index = np.flatnonzero(known)
    if index.size < 2:
        return None
    near = np.flatnonzero(np.isfinite(change.prior.log_density((t[index][1:] + t[index][:-1]) / 2)))
    if not near.size:
        return None
    index = index[near[0] : near[-1] + 2]
    return replace(change, contacts=tuple(
        replace(c, t=t[index], pressed=c.pressed[index], place=c.place[index], rate=c.rate[index])
        for c in change.contacts
    ))  # fmt: skip


def discrepancies(changes: Sequence[Change]) -> dict[tuple[Kind, int], float]:
    """How far [m] force and position disagree at the contacts next to changes of each sort."""
    found: dict[tuple[Kind, int], list[tuple[float, float]]] = {}
    for change in changes:
        for c in change.contacts:
            probability = switch_probability(c, change.log_prior, change.making)
            n = int(probability.argmax()) + change.making
            beside = slice(n, n + 2) if change.making else slice(max(n - 1, 0), n + 1)
            sure = np.flatnonzero(c.pressed[beside] > SURE * c.sd_pressed)
            if sure.size:
                i = beside.start + (sure[0] if change.making else sure[-1])
                apart = c.place[i] - (0.0 if c.hidden else c.pressed[i])
                if np.isfinite(apart):
                    found.setdefault(change.sort, []).append((float(apart), c.sd_place))
    out = {}
    for sort, pairs in found.items():
        apart, noise = np.array(pairs).T
        # Of a normal distribution; half of the contacts may be anything.
        excess = max(float(np.median(apart**2 - noise**2 * 0.455)) / 0.455, 0.0)
        out[sort] = float(np.sqrt((apart.size * excess + KNOWN * DISCREPANCY**2) / (apart.size + KNOWN)))
    return out


def moment(change: Change, discrepancy: float) -> BoundaryPosterior:
    """Posterior of the moment of a change."""
    contacts = [replace(c, sd_place=float(np.hypot(c.sd_place, discrepancy))) for c in change.contacts]
    t, making = contacts[0].t, change.making
    found = np.array([switch_probability(c, change.log_prior, making) for c in contacts])
    combined = crossing_density if making else first_of
    inner = (np.arange(POINTS) + 0.5) / POINTS
    times, masses = [], []
    for n in range(t.size - 1):
        width = float(t[n + 1] - t[n])
        for chosen, mass in _shares(found, n, making):
            if mass < LIKELY:
                continue
            deciding = [_crossing(contacts[i], n, making, change.kind) for i in chosen]
            density = combined(deciding if all(x.known for x in deciding) else [], width)
            if not np.isfinite(density).all():
                density = combined([], width)
            times.append(t[n] + inner * width)
            masses.append(mass * density)
    sd = float(np.hypot(ONSET, change.timing))
    return blurred(np.concatenate(times), np.concatenate(masses), float(t[0]), float(t[-1]), sd)


def _shares(found: np.ndarray, n: int, making: bool) -> list[tuple[tuple[int, ...], float]]:
    """Which contacts decide the boundary in interval n, and with what probability.

    `found` (num_contacts, num_intervals): independent switch probabilities. Two contacts made in one
    interval decide together, else the later one; of contacts broken, the earlier.
    """
    if len(found) == 1:
        return [((0,), float(found[0, n]))]
    done = found[:, :n].sum(axis=1) if making else found[:, n + 1 :].sum(axis=1)
    a, b = found[:, n]
    return [((0, 1), float(a * b)), ((0,), float(a * done[1])), ((1,), float(b * done[0]))]


def _crossing(c: Penetration, n: int, making: bool, kind: Kind) -> Crossing:
    """The crossing of interval n: by position where apart, by force where there is contact."""
    touching, apart = (n + 1, n) if making else (n, n + 1)
    pressed, gap = c.pressed[touching], c.place[apart]
    sd_pressed = float(np.hypot(c.sd_pressed, c.form * abs(pressed)))
    if c.hidden:  # a rigid pad hides its compression
        pressed = max(c.place[touching], 0.0)
        sd_pressed = c.sd_place + 0.5 * abs(gap)
    if making:
        return Crossing(gap, pressed, c.rate[n], c.rate[n + 1], c.sd_place, sd_pressed, c.sd_rate, kind)
    return Crossing(-pressed, -gap, -c.rate[n], -c.rate[n + 1], sd_pressed, c.sd_place, c.sd_rate, kind)
