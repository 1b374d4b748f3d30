"""The moment of a contact change: the posterior that its contacts, and what is known of their sort, give.

Where it may be said to be one of several things (a grip that ends, the later of two touches), it is of all of
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.segmentation.boundaries import ONSET, BoundaryPosterior, blurred, crossing_density, first_of
from hmmseg.segmentation.changes import LIKELY, Change, Disagreement, abrupt, inside
from hmmseg.segmentation.motions import POINTS, Crossing
from hmmseg.segmentation.switching import Penetration, switch_probability

# prior: that a grip ends when its force is silent, when it slides, when it has opened
VIEWS = (0.6, 0.2, 0.2)
STOOD = 0.5  # prior: that a block stood still until the later finger touched it
FRICTION = 0.1  # prior: share by which friction differs from one contact to another


def moment(change: Change, known: Disagreement) -> BoundaryPosterior:
    """Posterior of the moment of a change, with what is `known` of its sort.

    A grip may be said to end when a pad's friction is spent and it begins to slide, when its force is first
    silent, or when fingers have opened as far as the pads were pressed: a pad that slides comes off and
    meets the block again for some ms. Where these differ, each is as it may be (VIEWS).

    Of two touches the later comes when both fingers are the block's width apart, as the first pushes the
    block; or, of a heavy block in soft pads and touches some ms apart, before it has moved (STOOD).
    """
    contacts, unmoved = (
        [replace(c, sd_place=float(np.hypot(c.sd_place, known.position))) for c in each]
        for each in (change.contacts, change.unmoved)
    )
    views, weight = [contacts], (1.0,)
    if unmoved:
        views, weight = [contacts, unmoved], (1 - STOOD, STOOD)
    if change.slips:
        sliding = [_beyond(c, slip) for c, slip in zip(contacts, change.slips, strict=True)]
        opened = [replace(c, pressed=np.full_like(c.pressed, np.nan), hidden=True) for c in contacts]
        views, weight = [contacts, sliding, opened], VIEWS
    found, t = [_seen(view, change, known) for view in views], contacts[0].t
    sd = float(np.hypot(ONSET, change.timing))
    times = np.concatenate([times for times, _ in found])
    masses = np.concatenate([w * mass / mass.sum() for w, (_, mass) in zip(weight, found, strict=True)])
    return blurred(times, masses, float(t[0]), float(t[-1]), sd)


def _beyond(c: Penetration, slip: float) -> Penetration:
    """The contact as far as it is deeper than where it slides [m]."""
    sd = float(np.hypot(c.sd_place, FRICTION * slip))
    return replace(c, pressed=np.maximum(c.pressed - slip, 0.0), place=c.place - slip, sd_place=sd)


def _seen(
    contacts: Sequence[Penetration], change: Change, known: Disagreement
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and masses of the moment at which contacts are made, or the first is broken."""
    t, making = contacts[0].t, change.making
    found = np.array([switch_probability(c, change.log_prior, making, known.louder) for c in contacts])
    combined = crossing_density if making else first_of
    inner = (np.arange(POINTS) + 0.5) / POINTS
    times, masses = [], []
    for n in range(t.size - 1):
        width = float(t[n + 1] - t[n])
        for chosen, mass in _shares(found, n, making):
            if mass < LIKELY:
                continue
            deciding = [_crossing(contacts[i], n, change, known) for i in chosen]
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


def _crossing(c: Penetration, n: int, change: Change, known: Disagreement) -> Crossing:
    """The crossing of interval n: by position where apart, by force where there is contact."""
    making, kind = change.making, change.kind
    touching, apart = (n + 1, n) if making else (n, n + 1)
    pressed, gap = c.pressed[touching], c.free_place[apart]
    noise = c.sd_pressed * (known.louder if making else 1.0)
    sd_pressed = float(np.hypot(noise, c.form * abs(pressed)))
    if c.hidden:  # a rigid pad hides its compression
        pressed = max(c.place[touching], 0.0)
        sd_pressed = c.sd_place + 0.5 * abs(gap)
    before, after = float(c.rate[0, n]), float(c.rate[1, n + 1])
    if making:
        found = Crossing(gap, pressed, before, after, c.sd_place, sd_pressed, c.sd_rate, kind)
        if len(change.contacts) == 1:  # a block is set down in several motions
            return replace(found, restless=c.restless(n))
        if n == 0:
            return found
        then = (float(c.t[n] - c.t[n - 1]), float(c.place[n - 1]), float(c.rate[0, n - 1]))
        return replace(found, earlier=then) if np.isfinite(then).all() else found
    share = abrupt(known.abrupt, inside(c, n)) if kind == "smooth" else 0.0
    return Crossing(-pressed, -gap, -before, -after, sd_pressed, c.sd_place, c.sd_rate, kind, float(share))
