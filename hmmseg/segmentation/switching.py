"""In which sample interval a contact switched, from force and position together.

A contact is a penetration p(t) [m]: how far a finger is in a pad, or how far a block's weight is short
of hanging on the pads alone. Where there is contact (p > 0) the force measures it, far more finely than
positions do; where there is none the force is silent and the position measures how far apart things are:

    contact: pressed ~ N(p, .), place ~ N(p, .), p > 0      apart: pressed ~ N(0, .), place ~ N(p, .), p < 0

with p unknown, uniform over the range seen. Every sample so weighs contact against none, with p
integrated out; a switch at interval n has the likelihood of all samples up to n before it and all later
ones after it. The chain of contact states does not know that motion is continuous (a block that has
just lifted is still near the ground); these samples do. The alignment says which contact is meant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from hmmseg.levels import TAIL

# prior: share of samples at which one sensor tells another story than the model (ringing, a block
# pushed)
STRAY = 0.02
SELDOM = 0.002  # prior: ... where that is the less likely of the two stories
LOOKED_BACK = 3  # chosen: sample intervals whose changes of speed tell how restless a hand is
DEEP = 0.9  # numerics: quantile of the penetrations around a change that stands for the deepest
ROOT_2PI = float(np.sqrt(2 * np.pi))  # numerics: width of a normal density that is as high as an even one


@dataclass(frozen=True)
class Penetration:
    """One contact as sensed, arrays (num_samples,), NaN where missing.

    `pressed` [m]: by the force; `place` [m]: by the position; `rate` (2, num_samples) [m/s] of `place`, just
    before and just after each sample. `sd_pressed` is
    the noise of the force, `form` the share by which a pad's force may be off its compression;
    `sd_apart` [m]: what the force may be of itself where there is no contact. `hidden`: a rigid pad, whose
    force tells that there is contact, but not how deep.
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
    ahead: np.ndarray | None = None

    @property
    def free_place(self) -> np.ndarray:
        """Place (num_samples,) [m] of a thing that is apart."""
        return self.place if self.ahead is None else self.place + self.ahead

    def restless(self, n: int) -> float:
        """How much the speed of what comes down wanders up to sample n: its variance a second [m^2/s^3]."""
        last = slice(max(n - LOOKED_BACK, 0), n + 1)
        change, step = np.diff(self.rate[0, last]), np.diff(self.t[last])
        there = np.isfinite(change)
        wandered = float(np.sum(change[there] ** 2)) - 2 * self.sd_rate**2 * there.sum()
        return max(wandered, 0.0) / float(step[there].sum()) if there.any() else 0.0


def log_contact(c: Penetration, making: bool, louder: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihoods (num_samples,) of contact and of none, p integrated out; a missing sensor adds nothing.

    After the change forces are `louder` than their noise: in contact if it is made, apart if it is broken.

    What is more likely amiss differs: before a touch (`making`) the face may lie elsewhere, as a finger
    that came first pushes the block; after a release the force may ring.
    """
    sd_pressed, sd_apart = (
        c.sd_pressed * (louder if making else 1.0),
        c.sd_apart * (1.0 if making else louder),
    )
    force, position = np.isfinite(c.pressed), np.isfinite(c.place)
    pressed, place = np.where(force, c.pressed, 0.0), np.where(position, c.place, 0.0)
    log_force = np.log(2 * max(np.ptp(pressed), 10 * c.sd_pressed)) * force
    log_place = np.log(2 * max(np.ptp(place), 10 * c.sd_place)) * position
    pushes = np.where(force, log_ndtr(pressed / sd_pressed), 0.0) - log_force
    silent = np.where(force, _log_student(pressed / sd_apart) - np.log(sd_apart), 0.0)
    # What stands on its corner comes to lie flat: its place is anywhere between.
    ahead = np.zeros(c.t.size) if c.ahead is None else c.ahead
    place, sd_place = place + ahead / 2, np.sqrt(c.sd_place**2 + ahead**2 / 12)
    within = np.where(position, log_ndtr(place / sd_place), 0.0) - log_place
    apart = np.where(position, c.free_place, 0.0)
    beyond = np.where(position, log_ndtr(-apart / c.sd_place), 0.0) - log_place
    sd_force = np.hypot(sd_pressed, c.form * np.abs(pressed))
    both = np.hypot(sd_force, sd_place)
    depth = (sd_place**2 * pressed + sd_force**2 * place) / both**2
    agree = _log_student((pressed - place) / both) - np.log(both) - log_place
    # Both stories have a density of places alike. Where a place is so noisy that all that a contact moves by
    # is lost in it, that would count against contact, of which force alone tells.
    deep = max(float(np.quantile(pressed, DEEP)), ROOT_2PI * sd_pressed)
    agree = agree + np.log(np.maximum(ROOT_2PI * sd_place / deep, 1.0))
    held = agree + log_ndtr(depth * both / (sd_force * sd_place))
    held = np.where(force & position & (not c.hidden), held, pushes + within)
    moved, rung = (STRAY, SELDOM) if making else (SELDOM, STRAY)
    neither = np.log(STRAY * SELDOM) - log_force - log_place
    contact = np.logaddexp.reduce([held, np.log(moved) + pushes - log_place, neither])
    none = np.logaddexp.reduce([
        silent + beyond, np.log(moved) + silent - log_place, np.log(rung) + beyond - log_force, neither,
    ])  # fmt: skip
    return contact, none


def switch_probability(
    c: Penetration, log_prior: np.ndarray, making: bool, louder: float = 1.0
) -> np.ndarray:
    """Probability (num_samples - 1,) that the contact is made, or broken, in each interval."""
    contact, none = log_contact(c, making, louder)
    before, after = (none, contact) if making else (contact, none)
    log_weight = np.cumsum(before)[:-1] + np.cumsum(after[::-1])[::-1][1:] + log_prior
    weight = np.exp(log_weight - log_weight.max())
    return weight / weight.sum()


def _log_student(z: np.ndarray) -> np.ndarray:
    """Log density of a standard Student-t variable (its constant is that of TAIL degrees of freedom)."""
    return -0.98082925 - (TAIL + 1) / 2 * np.log1p(z**2 / TAIL)
