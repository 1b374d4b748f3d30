"""A contact change: the likely sample intervals, the evidence of its contacts, and its time.

A contact is a penetration p(t) [m]: of a finger into a pad, or of the fingers below the height at which the
pads alone carry a block. In contact (p > 0) the force measures p, far more precisely than positions do;
without contact the force is silent and the position measures the gap:

    contact: pressed ~ N(p, .), place ~ N(p, .), p > 0      apart: pressed ~ N(0, .), place ~ N(p, .), p < 0

with p unknown, uniform over the range seen. Every sample thus weighs contact against no contact, with p
integrated out; the likelihood of a switch in interval n combines all samples up to n before it with all later
ones after it. The chain of contact states ignores that motion is continuous (a block that has just lifted is
still near the ground); these samples do not. The alignment tells which contact is meant.

In contact, force and position must agree. Their disagreement at the contacts nearest to the changes of one
sort in all recordings (a block pushed by the first finger, a table that yields, pads that creep) is a
discrepancy [m] that positions are then allowed. A change with several possible mechanisms (the end of a grip,
the later of two touches) is a mixture of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from hmmseg.densities import log_student
from hmmseg.levels import SURE
from hmmseg.segmentation.boundaries import (
    NODES,
    ONSET,
    BoundaryPosterior,
    Crossing,
    Kind,
    blurred,
    crossing_density,
)

STRAY = 0.02  # prior: share of samples at which one sensor contradicts the model (ringing, a pushed block)
SELDOM = 0.002  # prior: the same, for the less likely of the two causes
DEEP = 0.9  # numerics: quantile of the penetrations around a change that represents the deepest
ROOT_2PI = float(np.sqrt(2 * np.pi))  # numerics: width of a normal density that is as high as an even one


@dataclass(frozen=True)
class Penetration:
    """One contact as sensed, arrays (num_samples,), NaN where missing.

    `pressed` [m]: from the force; `place` [m]: from the position; `rate` (2, num_samples) [m/s] of `place`,
    just before and just after each sample. `sd_pressed`: noise of the force; `form`: relative deviation of a
    pad's force from its law; `sd_apart` [m]: force readings without contact. `hidden`: a rigid pad, whose
    force shows that there is contact, but not how deep it is.
    """

    t: np.ndarray
    pressed: np.ndarray
    place: np.ndarray
    rate: np.ndarray
    sd_pressed: float
    sd_apart: float
    sd_place: float
    sd_rate: float
    form: float
    hidden: bool = False

    def restless(self, n: int) -> float:
        """Variance a second [m^2/s^3] by which the rate wandered up to sample n; NaN if that is not seen."""
        change, step = np.diff(self.rate[0, : n + 1]), np.diff(self.t[: n + 1])
        there = np.isfinite(change)
        wandered = float(np.sum(change[there] ** 2)) - 2 * self.sd_rate**2 * there.sum()
        return max(wandered, 0.0) / float(step[there].sum()) if there.any() else np.nan


def log_contact(c: Penetration, making: bool) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihoods (num_samples,) of contact and of no contact, p integrated out; 0 for a missing sensor.

    Outliers differ: before a touch (`making`) the face may lie elsewhere, as the first finger pushes the
    block; after a release the force may ring.
    """
    force, position = np.isfinite(c.pressed), np.isfinite(c.place)
    pressed, place = np.where(force, c.pressed, 0.0), np.where(position, c.place, 0.0)
    log_force = np.log(2 * max(np.ptp(pressed), 10 * c.sd_pressed)) * force
    log_place = np.log(2 * max(np.ptp(place), 10 * c.sd_place)) * position
    pushes = np.where(force, log_ndtr(pressed / c.sd_pressed), 0.0) - log_force
    silent = np.where(force, log_student(pressed, c.sd_apart), 0.0)
    within = np.where(position, log_ndtr(place / c.sd_place), 0.0) - log_place
    beyond = np.where(position, log_ndtr(-place / c.sd_place), 0.0) - log_place
    sd_force = np.hypot(c.sd_pressed, c.form * np.abs(pressed))
    both = np.hypot(sd_force, c.sd_place)
    depth = (c.sd_place**2 * pressed + sd_force**2 * place) / both**2
    agree = log_student(pressed - place, both) - log_place
    # Both hypotheses share a density of places. A place whose noise hides the whole motion of a contact must
    # not count against a contact that the force shows.
    deep = max(float(np.quantile(pressed, DEEP)), ROOT_2PI * c.sd_pressed)
    agree = agree + np.log(max(ROOT_2PI * c.sd_place / deep, 1.0))
    held = agree + log_ndtr(depth * both / (sd_force * c.sd_place))
    held = np.where(force & position & (not c.hidden), held, pushes + within)
    moved, rung = (STRAY, SELDOM) if making else (SELDOM, STRAY)
    neither = np.log(STRAY * SELDOM) - log_force - log_place
    contact = np.logaddexp.reduce([held, np.log(moved) + pushes - log_place, neither])
    none = np.logaddexp.reduce([
        silent + beyond, np.log(moved) + silent - log_place, np.log(rung) + beyond - log_force, neither,
    ])  # fmt: skip
    return contact, none


def switch_probability(c: Penetration, log_prior: np.ndarray, making: bool) -> np.ndarray:
    """Probability (num_samples - 1,) that the contact is made, or broken, in each interval."""
    contact, none = log_contact(c, making)
    before, after = (none, contact) if making else (contact, none)
    log_weight = np.cumsum(before)[:-1] + np.cumsum(after[::-1])[::-1][1:] + log_prior
    weight = np.exp(log_weight - log_weight.max())
    return weight / weight.sum()


LIKELY = 1e-3  # numerics: least probability of an interval within which the crossing is resolved
SURROUNDING = 2.5  # chosen: resolution of the alignment, in its sample intervals
DISCREPANCY, KNOWN = 1e-5, 2.0  # prior: m; usual discrepancy of foam, worth this many contacts


@dataclass(frozen=True)
class Prior:
    """The alignment's posterior of one boundary: probability (T - 1,) of each interval of t (T,) [s].

    It identifies the contact, and its time but for a few samples: within those (and `limits` [s], the
    neighbouring boundaries) the prior is flat.
    """

    t: np.ndarray
    probability: np.ndarray
    limits: tuple[float, float]

    @cached_property
    def around(self) -> float:
        """Time [s] within which the alignment cannot tell intervals apart."""
        return SURROUNDING * float(np.median(np.diff(self.t)))

    def log_density(self, t: np.ndarray) -> np.ndarray:
        """Unnormalised log prior density of the boundary at t; -inf where impossible."""
        out = np.zeros_like(t)
        for n in np.flatnonzero(self.probability > LIKELY):
            low, high = self.t[n] - self.around, self.t[n + 1] + self.around
            out += self.probability[n] / (high - low) * ((t >= low) & (t <= high))
        inside = (t >= self.limits[0]) & (t <= self.limits[1])
        with np.errstate(divide="ignore"):
            return np.log(out * inside)


@dataclass(frozen=True)
class Change:
    """Contacts made or broken at one boundary: the last of two made, or the first of two broken, decides.

    `timing` [s]: uncertainty of the forces' clock. `slips` [m]: deepest penetration at which each broken
    contact may slide.
    """

    contacts: tuple[Penetration, ...]
    prior: Prior
    making: bool
    kind: Kind
    timing: float
    slips: tuple[float, ...] = ()

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
        """Most likely interval of each contact's switch, allowing no discrepancy."""
        return tuple(int(switch_probability(c, self.log_prior, self.making).argmax()) for c in self.contacts)


def restricted(change: Change) -> Change | None:
    """Restrict a change to the samples among which it lies; None if there are none."""
    t = change.contacts[0].t
    recorded = np.any([np.isfinite(c.pressed) | np.isfinite(c.place) for c in change.contacts], axis=0)
    index = np.flatnonzero(recorded)
    near = np.flatnonzero(np.isfinite(change.prior.log_density((t[index][1:] + t[index][:-1]) / 2)))
    if not near.size:
        return None
    index = index[near[0] : near[-1] + 2]
    contacts = tuple(
        replace(c, t=t[index], pressed=c.pressed[index], place=c.place[index], rate=c.rate[:, index])
        for c in change.contacts
    )
    return replace(change, contacts=contacts)


def discrepancies(changes: Sequence[Change]) -> dict[tuple[Kind, int], float]:
    """Discrepancy [m] allowed to positions in contact, learned from the changes of each sort."""
    by_sort: dict[tuple[Kind, int], list[Change]] = {}
    for change in changes:
        by_sort.setdefault(change.sort, []).append(change)
    return {sort: _discrepancy(own) for sort, own in by_sort.items()}


def _discrepancy(changes: Sequence[Change]) -> float:
    """Discrepancy [m] of force and position at the contacts next to the changes."""
    pairs = []  # of a difference [m] and the position's noise [m]
    for change in changes:
        for c, interval in zip(change.contacts, change.intervals, strict=True):
            n = interval + change.making
            near = slice(n, n + 2) if change.making else slice(max(n - 1, 0), n + 1)
            sure = np.flatnonzero(c.pressed[near] > SURE * c.sd_pressed)
            if sure.size:
                i = near.start + (sure[0] if change.making else sure[-1])
                apart = c.place[i] - (0.0 if c.hidden else c.pressed[i])
                if np.isfinite(apart):
                    pairs.append((float(apart), c.sd_place))
    if not pairs:
        return DISCREPANCY
    apart, noise = np.array(pairs).T
    # Median of chi-squared: a normal distribution of which half of the contacts may be outliers.
    excess = max(float(np.median(apart**2 - noise**2 * 0.455)) / 0.455, 0.0)
    return float(np.sqrt((apart.size * excess + KNOWN * DISCREPANCY**2) / (apart.size + KNOWN)))


SLIDES = 0.2  # prior: share of grips that end as a pad slides, which comes off and meets the block again
ENDS = (np.arange(5) + 0.5) / 5  # numerics: nodes of where these end


def moment(change: Change, discrepancy: float = DISCREPANCY) -> BoundaryPosterior:
    """Posterior of the time of a change, given the `discrepancy` [m] of its sort.

    A grip ends when its force vanishes, or (SLIDES) as a pad whose friction is spent slides and comes off for
    some ms. The friction seen in a recording is a lower bound, so that this is anywhere between the
    penetration at which it would be spent and none.

    The later of two touches comes when the fingers are the block's width apart: the first pushes the block.
    """
    contacts = [replace(c, sd_place=float(np.hypot(c.sd_place, discrepancy))) for c in change.contacts]
    views, weight, seen = [contacts], [1.0], _made if change.making else _broken
    if any(change.slips):
        views += [
            [replace(c, pressed=np.maximum(c.pressed - end * slip, 0.0), place=c.place - end * slip)
             for c, slip in zip(contacts, change.slips, strict=True)]
            for end in ENDS
        ]  # fmt: skip
        weight = [1 - SLIDES, *[SLIDES / ENDS.size] * ENDS.size]
    found, t = [seen(view, change) for view in views], contacts[0].t
    sd = float(np.hypot(ONSET, change.timing))
    times = np.concatenate([times for times, _ in found])
    masses = np.concatenate([w * mass / mass.sum() for w, (_, mass) in zip(weight, found, strict=True)])
    return blurred(times, masses, float(t[0]), float(t[-1]), sd)


def _broken(contacts: Sequence[Penetration], change: Change) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and masses of the moment when the first contact is broken.

    One hand opens both: what is unknown of its motion, its places and its pads delays or advances both, so
    the first is the one that tends to be earlier. If independent, it would come out early by half a standard
    deviation.
    """
    t = contacts[0].t
    switches = np.array([switch_probability(c, change.log_prior, False) for c in contacts])
    likely = np.flatnonzero(switches.max(axis=0) >= LIKELY)
    pairs = zip(contacts, switches, strict=True)
    masses = [[switched[n] * _density([c], int(n), change) for n in likely] for c, switched in pairs]
    broken = np.cumsum(np.reshape(masses, (len(contacts), -1)), axis=1)
    first = (broken / broken[:, -1:]).max(axis=0)
    return (t[likely, None] + NODES * np.diff(t)[likely, None]).ravel(), np.diff(first, prepend=0.0)


def _made(contacts: Sequence[Penetration], change: Change) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and masses of the moment when all contacts are made."""
    t = contacts[0].t
    switches = np.array([switch_probability(c, change.log_prior, True) for c in contacts])
    times, masses = [], []
    for n in range(t.size - 1):
        for chosen, mass in _shares(switches, n):
            if mass >= LIKELY:
                times.append(t[n] + NODES * (t[n + 1] - t[n]))
                masses.append(mass * _density([contacts[i] for i in chosen], n, change))
    return np.concatenate(times), np.concatenate(masses)


def _density(contacts: Sequence[Penetration], n: int, change: Change) -> np.ndarray:
    """Density over the nodes of interval n, in which these contacts are made or one is broken."""
    crossings, width = [_crossing(c, n, change) for c in contacts], float(np.diff(contacts[0].t)[n])
    density = crossing_density(crossings if all(x.known for x in crossings) else [], width)
    return density if np.isfinite(density).all() else crossing_density([], width)


def _shares(switches: np.ndarray, n: int) -> list[tuple[tuple[int, ...], float]]:
    """Which touches decide the boundary in interval n, and with what probability.

    `switches` (num_contacts, num_intervals): independent switch probabilities. Two touches in one interval
    decide jointly, otherwise the later one.
    """
    if len(switches) == 1:
        return [((0,), float(switches[0, n]))]
    (a, b), done = switches[:, n], switches[:, :n].sum(axis=1)
    return [((0, 1), float(a * b)), ((0,), float(a * done[1])), ((1,), float(b * done[0]))]


def _crossing(c: Penetration, n: int, change: Change) -> Crossing:
    """The crossing in interval n, from the position where apart and from the force in contact."""
    making, kind = change.making, change.kind
    touching, apart = (n + 1, n) if making else (n, n + 1)
    pressed, gap = c.pressed[touching], c.place[apart]
    sd_pressed = float(np.hypot(c.sd_pressed, c.form * abs(pressed)))
    if c.hidden:
        pressed = max(c.place[touching], 0.0)
        sd_pressed = c.sd_place + 0.5 * abs(gap)
    before, after = float(c.rate[0, n]), float(c.rate[1, n + 1])
    if making:
        crossing = Crossing(gap, pressed, before, after, c.sd_place, sd_pressed, c.sd_rate, kind)
        if kind == "landing":
            return replace(crossing, restless=c.restless(n))
        if n == 0:
            return crossing
        earlier = (float(c.t[n] - c.t[n - 1]), float(c.place[n - 1]), float(c.rate[0, n - 1]))
        return replace(crossing, earlier=earlier) if np.isfinite(earlier).all() else crossing
    return Crossing(-pressed, -gap, -before, -after, sd_pressed, c.sd_place, c.sd_rate, kind)
