"""One contact change: where it may be, what its contacts show, and the posterior of its moment.

Force and position must agree where there is contact. By how much they do not, at the contacts nearest to
the changes of one kind in all recordings at hand (a block that a first finger pushed, a table that
yields, pads that creep), is a discrepancy [m] that positions are then allowed. How often a force is silent
while positions still find the pad pressed is the share of contacts that end abruptly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from hmmseg.levels import SURE
from hmmseg.segmentation.boundaries import (
    UNIFORM,
)
from hmmseg.segmentation.motions import Kind
from hmmseg.segmentation.switching import Penetration, switch_probability

LIKELY = 1e-3  # numerics: least probability of an interval within which the crossing is looked at
SURROUNDING = 2.5  # chosen: sample intervals of the alignment within which it cannot tell one from another
DISCREPANCY, KNOWN = 1e-5, 2.0  # prior: m; usual discrepancy of foam, worth so many contacts


@dataclass(frozen=True)
class Prior:
    """What the alignment says of one boundary: probability (T - 1,) of each of its intervals, t (T,) [s].

    It knows which contact is meant, and the moment but for a few samples: within those (and `limits` [s],
    the neighbouring boundaries) all times are alike.
    """

    t: np.ndarray
    probability: np.ndarray
    limits: tuple[float, float]

    @cached_property
    def around(self) -> float:
        """Time [s] within which the alignment cannot tell one interval from another."""
        return SURROUNDING * float(np.median(np.diff(self.t)))

    def log_density(self, t: np.ndarray) -> np.ndarray:
        """Log prior density (unnormalised) of the boundary at t; -inf where it cannot be."""
        out = np.zeros_like(t)
        for n in np.flatnonzero(self.probability > LIKELY):
            low, high = self.t[n] - self.around, self.t[n + 1] + self.around
            out += self.probability[n] / (high - low) * ((t >= low) & (t <= high))
        inside = (t >= self.limits[0]) & (t <= self.limits[1])
        with np.errstate(divide="ignore"):
            return np.log(out * inside)


ROUNDS = 20  # numerics: of expectation and maximisation
SEEN = 4.0  # prior: contacts that the prior of an abrupt end is worth


@dataclass(frozen=True)
class Disagreement:
    """Model error of changes of one sort: `position` [m] that positions are allowed where there is contact;
    `abrupt`: share of contacts that end at once, by a pad that slips off or turns, before it is relaxed.
    `louder`: what forces are of their noise after a change, as they ring, or come late.
    """

    position: float = DISCREPANCY
    abrupt: float = UNIFORM
    louder: float = 1.0


@dataclass(frozen=True)
class Change:
    """Contacts made, or broken, at one boundary: of two, the last one made and the first one broken count.

    `timing` [s] is the uncertainty of the forces' own clock. `slips` [m]: at which penetration each contact
    that is broken slides. `unmoved`: the contacts, had the block stood still where it rests later.
    """

    contacts: tuple[Penetration, ...]
    prior: Prior
    making: bool
    kind: Kind
    timing: float
    slips: tuple[float, ...] = ()
    unmoved: tuple[Penetration, ...] = ()

    @property
    def sort(self) -> tuple[Kind, int]:
        """Changes of one sort share a discrepancy."""
        return self.kind, len(self.contacts)

    @cached_property
    def log_prior(self) -> np.ndarray:
        """Log prior probability (num_intervals,) of the intervals."""
        t = self.contacts[0].t
        return self.prior.log_density((t[1:] + t[:-1]) / 2) + np.log(np.diff(t))

    @cached_property
    def intervals(self) -> tuple[int, ...]:
        """The interval in which each contact most likely switched, wherever force and position disagree."""
        return tuple(int(switch_probability(c, self.log_prior, self.making).argmax()) for c in self.contacts)


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

    def near_it(contacts: Sequence[Penetration]) -> tuple[Penetration, ...]:
        return tuple(
            replace(c, t=t[index], pressed=c.pressed[index], place=c.place[index], rate=c.rate[:, index],
                    ahead=None if c.ahead is None else c.ahead[index])
            for c in contacts
        )  # fmt: skip

    return replace(change, contacts=near_it(change.contacts), unmoved=near_it(change.unmoved))


def disagreements(changes: Sequence[Change]) -> dict[tuple[Kind, int], Disagreement]:
    """What the changes of each sort show of where force and position disagree."""
    sorts = dict.fromkeys(change.sort for change in changes)
    return {
        sort: Disagreement(_discrepancy(own), _abruptness(own), _loudness(changes, sort[1]))
        for sort in sorts
        for own in [[c for c in changes if c.sort == sort]]
    }


def _discrepancy(changes: Sequence[Change]) -> float:
    """How far [m] force and position disagree at the contacts next to the changes."""
    found = []
    for change in changes:
        for c, interval in zip(change.contacts, change.intervals, strict=True):
            n = interval + change.making
            beside = slice(n, n + 2) if change.making else slice(max(n - 1, 0), n + 1)
            sure = np.flatnonzero(c.pressed[beside] > SURE * c.sd_pressed)
            if sure.size:
                i = beside.start + (sure[0] if change.making else sure[-1])
                apart = c.place[i] - (0.0 if c.hidden else c.pressed[i])
                if np.isfinite(apart):
                    found.append((float(apart), c.sd_place))
    if not found:
        return DISCREPANCY
    apart, noise = np.array(found).T
    # Of a normal distribution; half of the contacts may be anything.
    excess = max(float(np.median(apart**2 - noise**2 * 0.455)) / 0.455, 0.0)
    return float(np.sqrt((apart.size * excess + KNOWN * DISCREPANCY**2) / (apart.size + KNOWN)))


def _abruptness(changes: Sequence[Change]) -> float:
    """Share of contacts that end before the position's way is spent: by maximum likelihood, and its prior."""
    z = np.array([
        inside(c, _last_pressed(c, n)) for change in changes if not change.making
        for c, n in zip(change.contacts, change.intervals, strict=True)
    ])  # fmt: skip
    z = z[np.isfinite(z)]
    share = UNIFORM
    for _ in range(ROUNDS):
        share = (abrupt(share, z).sum() + UNIFORM * SEEN) / (z.size + SEEN)
    return float(share)


def _loudness(changes: Sequence[Change], num_contacts: int) -> float:
    """What forces are of their noise where positions say for sure that there is no contact any more.

    Those of contacts that were broken, of so many at once; a contact that is made rings alike.
    """
    z = [np.zeros(0)]
    for change in changes:
        if not change.making and len(change.contacts) == num_contacts:
            z += [c.pressed[c.free_place < -SURE * c.sd_place] / c.sd_apart for c in change.contacts]
    z2 = np.concatenate(z) ** 2
    z2 = z2[np.isfinite(z2)]
    if not z2.size:
        return 1.0
    # Of a normal distribution; half of the samples may be anything.
    excess = max(float(np.median(z2)) / 0.455 - 1.0, 0.0)
    return float(np.sqrt(1.0 + z2.size * excess / (z2.size + SEEN)))


def abrupt(share: float, z: np.ndarray | float) -> np.ndarray:
    """Probability that a contact ended abruptly whose place is z sds inside when its force is silent.

    A relaxed pad is then anywhere outside, of an abrupt end the place is as likely inside.
    """
    return np.asarray(share / (share + (1 - share) * 2 * ndtr(-np.asarray(z))))


def inside(c: Penetration, n: int) -> float:
    """How far inside, in sds of noise, a contact's place still is at the end of interval n."""
    return float(c.place[n + 1] / c.sd_place)


def _last_pressed(c: Penetration, n: int) -> int:
    """The interval up to n at whose start the force last shows contact, whatever positions say."""
    sure = np.flatnonzero(c.pressed[: n + 1] > SURE * c.sd_pressed)
    return int(sure[-1]) if sure.size else n
