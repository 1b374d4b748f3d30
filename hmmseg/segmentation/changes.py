"""One contact change: in which sample interval it may be, what its contacts show, and when it was.

A contact is a penetration p(t) [m]: how far a finger is in a pad, or how far a block's weight is short of
hanging on the pads alone. Where there is contact (p > 0) the force measures it, far more finely than
positions do; where there is none the force is silent and the position measures how far apart things are:

    contact: pressed ~ N(p, .), place ~ N(p, .), p > 0      apart: pressed ~ N(0, .), place ~ N(p, .), p < 0

with p unknown, uniform over the range seen. Every sample so weighs contact against none, with p integrated
out; a switch at interval n has the likelihood of all samples up to n before it and all later ones after it.
The chain of contact states does not know that motion is continuous (a block that has just lifted is still
near the ground); these samples do. The alignment says which contact is meant.

Force and position must agree where there is contact. By how much they do not, at the contacts nearest to
the changes of one kind in all recordings (a block that a first finger pushed, a table that yields,
pads that creep), is a discrepancy [m] that positions are then allowed. A change that may be one of several
things (a grip that ends, the later of two touches) is a mixture of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from hmmseg.levels import SURE, TAIL
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

# prior: share of samples at which one sensor contradicts the model (ringing, a block
# pushed)
STRAY = 0.02
SELDOM = 0.002  # prior: ... where that is the less likely of the two stories
DEEP = 0.9  # numerics: quantile of the penetrations around a change that stands for the deepest
ROOT_2PI = float(np.sqrt(2 * np.pi))  # numerics: width of a normal density that is as high as an even one


@dataclass(frozen=True)
class Penetration:
    """One contact as sensed, arrays (num_samples,), NaN where missing.

    `pressed` [m]: by the force; `place` [m]: by the position; `rate` (2, num_samples) [m/s] of `place`, just
    before and just after each sample. `sd_pressed` is
    the noise of the force, `form` the share by which a pad's force may be off its compression;
    `sd_apart` [m]: what the force may be of itself where there is no contact. `hidden`: a rigid pad, whose
    force shows that there is contact, but not how deep.
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


def log_contact(c: Penetration, making: bool) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihoods (num_samples,) of contact and of none, p integrated out; a missing sensor adds nothing.

    What is more likely amiss differs: before a touch (`making`) the face may lie elsewhere, as a finger
    that came first pushes the block; after a release the force may ring.
    """
    force, position = np.isfinite(c.pressed), np.isfinite(c.place)
    pressed, place = np.where(force, c.pressed, 0.0), np.where(position, c.place, 0.0)
    log_force = np.log(2 * max(np.ptp(pressed), 10 * c.sd_pressed)) * force
    log_place = np.log(2 * max(np.ptp(place), 10 * c.sd_place)) * position
    pushes = np.where(force, log_ndtr(pressed / c.sd_pressed), 0.0) - log_force
    silent = np.where(force, _log_student(pressed / c.sd_apart) - np.log(c.sd_apart), 0.0)
    within = np.where(position, log_ndtr(place / c.sd_place), 0.0) - log_place
    beyond = np.where(position, log_ndtr(-place / c.sd_place), 0.0) - log_place
    sd_force = np.hypot(c.sd_pressed, c.form * np.abs(pressed))
    both = np.hypot(sd_force, c.sd_place)
    depth = (c.sd_place**2 * pressed + sd_force**2 * place) / both**2
    agree = _log_student((pressed - place) / both) - np.log(both) - log_place
    # Both stories have a density of places alike. Where a place is so noisy that all that a contact moves by
    # is lost in it, that would count against contact, which force alone shows.
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


def _log_student(z: np.ndarray) -> np.ndarray:
    """Log density of a standard Student-t variable (its constant is that of TAIL degrees of freedom)."""
    return -0.98082925 - (TAIL + 1) / 2 * np.log1p(z**2 / TAIL)


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


@dataclass(frozen=True)
class Change:
    """Contacts made, or broken, at one boundary: of two, the last one made and the first one broken count.

    `timing` [s] is the uncertainty of the forces' own clock. `slips` [m]: at which penetration each contact
    that is broken slides.
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
    contacts = tuple(
        replace(c, t=t[index], pressed=c.pressed[index], place=c.place[index], rate=c.rate[:, index])
        for c in change.contacts
    )
    return replace(change, contacts=contacts)


def discrepancies(changes: Sequence[Change]) -> dict[tuple[Kind, int], float]:
    """How far [m] positions may be off where there is contact, as the changes of each sort show."""
    by_sort: dict[tuple[Kind, int], list[Change]] = {}
    for change in changes:
        by_sort.setdefault(change.sort, []).append(change)
    return {sort: _discrepancy(own) for sort, own in by_sort.items()}


def _discrepancy(changes: Sequence[Change]) -> float:
    """How far [m] force and position disagree at the contacts next to the changes."""
    found = []
    for change in changes:
        for c, interval in zip(change.contacts, change.intervals, strict=True):
            n = interval + change.making
            near = slice(n, n + 2) if change.making else slice(max(n - 1, 0), n + 1)
            sure = np.flatnonzero(c.pressed[near] > SURE * c.sd_pressed)
            if sure.size:
                i = near.start + (sure[0] if change.making else sure[-1])
                apart = c.place[i] - (0.0 if c.hidden else c.pressed[i])
                if np.isfinite(apart):
                    found.append((float(apart), c.sd_place))
    if not found:
        return DISCREPANCY
    apart, noise = np.array(found).T
    # Of a normal distribution; half of the contacts may be anything.
    excess = max(float(np.median(apart**2 - noise**2 * 0.455)) / 0.455, 0.0)
    return float(np.sqrt((apart.size * excess + KNOWN * DISCREPANCY**2) / (apart.size + KNOWN)))


# prior: that a grip ends when its force is silent, when it slides, when it has opened
VIEWS = (0.6, 0.2, 0.2)
FRICTION = 0.1  # prior: share by which friction differs from one contact to another


def moment(change: Change, discrepancy: float = DISCREPANCY) -> BoundaryPosterior:
    """Posterior of the moment of a change, with the `discrepancy` [m] of its sort.

    A grip may be said to end when a pad's friction is spent and it begins to slide, when its force is first
    silent, or when fingers have opened as far as the pads were pressed: a pad that slides comes off and
    meets the block again for some ms. Where these differ, each is as it may be (VIEWS).

    Of two touches the later comes when both fingers are the block's width apart: the first pushes the block.
    """
    contacts = [replace(c, sd_place=float(np.hypot(c.sd_place, discrepancy))) for c in change.contacts]
    views, weight = [contacts], (1.0,)
    if change.slips:
        sliding = [  # as far as they are deeper than where they slide
            replace(c, pressed=np.maximum(c.pressed - slip, 0.0), place=c.place - slip,
                    sd_place=float(np.hypot(c.sd_place, FRICTION * slip)))
            for c, slip in zip(contacts, change.slips, strict=True)
        ]  # fmt: skip
        opened = [replace(c, pressed=np.full_like(c.pressed, np.nan), hidden=True) for c in contacts]
        views, weight = [contacts, sliding, opened], VIEWS
    found, t = [_seen(view, change) for view in views], contacts[0].t
    sd = float(np.hypot(ONSET, change.timing))
    times = np.concatenate([times for times, _ in found])
    masses = np.concatenate([w * mass / mass.sum() for w, (_, mass) in zip(weight, found, strict=True)])
    return blurred(times, masses, float(t[0]), float(t[-1]), sd)


def _seen(contacts: Sequence[Penetration], change: Change) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and masses of the moment at which contacts are made, or the first is broken."""
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
            deciding = [_crossing(contacts[i], n, change) for i in chosen]
            density = combined(deciding if all(x.known for x in deciding) else [], width)
            if not np.isfinite(density).all():
                density = combined([], width)
            times.append(t[n] + inner * width)
            masses.append(mass * density)
    return np.concatenate(times), np.concatenate(masses)


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


def _crossing(c: Penetration, n: int, change: Change) -> Crossing:
    """The crossing of interval n: by position where apart, by force where there is contact."""
    making, kind = change.making, change.kind
    touching, apart = (n + 1, n) if making else (n, n + 1)
    pressed, gap = c.pressed[touching], c.place[apart]
    sd_pressed = float(np.hypot(c.sd_pressed, c.form * abs(pressed)))
    if c.hidden:  # a rigid pad hides its compression
        pressed = max(c.place[touching], 0.0)
        sd_pressed = c.sd_place + 0.5 * abs(gap)
    before, after = float(c.rate[0, n]), float(c.rate[1, n + 1])
    if making:
        found = Crossing(gap, pressed, before, after, c.sd_place, sd_pressed, c.sd_rate, kind)
        if n == 0 or len(change.contacts) == 1:  # a block is set down in several motions
            return found
        then = (float(c.t[n] - c.t[n - 1]), float(c.place[n - 1]), float(c.rate[0, n - 1]))
        return replace(found, earlier=then) if np.isfinite(then).all() else found
    return Crossing(-pressed, -gap, -before, -after, sd_pressed, c.sd_place, c.sd_rate, kind)
