"""When a gripper closes on something, and the opening at which its pads touch it.

An opening moves between turning points. A closing that ends in a stand grips, at the opening held there;
pads and drive yield in a grip, so that the touch is further open. The grip force and the pads' stiffness
tell by how much. Otherwise the motion itself does: a closing gripper has not touched yet while it is at its
fastest, and an opening one leaves its stand where the pads let go. `Closings` works sample by sample, for
whole recordings as for streams.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.hand.sensing import MIN_ALIVE, ROUNDING
from hmmseg.hand.signals import grouped
from hmmseg.levels import SURE
from hmmseg.robust import coarse_step, median_of_known, white_sd

STEP = 0.02  # numerics: s over which speeds are taken: a gripper's motor changes them no faster
SOFT = 0.1  # prior: relative error of the yield in a grip, as pads are no ideal springs
GIVE = (1e-3, 1.5e-3)  # prior: m, mean and sd: yield of pads and drive in a grip, before anything is seen
REST = 0.1  # chosen: share of an opening's range, or of its top speed, below which the gripper stands
LEAST_CLOSING = 1e-3  # limit: m; a smaller swing of the opening is no grip


@dataclass(frozen=True)
class Grip:
    """One closing on something: samples [start, stop) in which the pads touch it.

    `held` [m]: the opening at which it stands; `width` [m] and its sd: the opening at which both pads just
    touch.
    """

    start: int
    stop: int
    held: float
    width: float
    width_sd: float


class Closings:
    """Turning points of an opening, between swings of at least `swing` [m].

    `closing`: whether the opening has last turned downwards; `extreme`: time and opening of the least value
    since then, or of the greatest since it last turned upwards.
    """

    def __init__(self, swing: float) -> None:
        self.swing, self.closing, self.extreme = swing, False, (0.0, -np.inf)

    def take(self, at: float, opening: float) -> bool:
        """Take the opening [m] at the next time or sample; returns whether it has turned."""
        extreme = self.extreme[1]
        away = extreme - opening if not self.closing else opening - extreme
        if away <= 0:
            self.extreme = at, opening
        if away <= self.swing:
            return False
        self.closing, self.extreme = not self.closing, (at, opening)
        return True


# Samples: where it begins, where it is least, and where it is open again (None if it stays closed).
Closing = tuple[int, int, int | None]


def closings(opening: np.ndarray) -> list[Closing]:
    """Closings of a whole opening (num_timesteps,) [m].

    A swing counts if it exceeds a tenth of the range, and noise.
    """
    each = Closings(least_swing(float(np.ptp(opening)), white_sd(opening)))
    turning = []
    for i, value in enumerate(opening.tolist()):
        before = int(each.extreme[0])
        turning += [before] * each.take(i, value)
    turning.append(int(each.extreme[0]))
    ends = [*turning[2::2], None]
    return list(zip(turning[::2], turning[1::2], ends, strict=False))


def free_samples(opening: np.ndarray, found: list[Closing]) -> np.ndarray:
    """Samples (num_timesteps,) outside any grip: more open than halfway to the least of their closing."""
    free = np.ones(opening.size, bool)
    for begun, least, opened in found:
        inside, top = slice(begun, None if opened is None else opened + 1), _ceiling(opening, begun, opened)
        free[inside] &= opening[inside] >= (opening[least] + top) / 2
    return free


def _ceiling(opening: np.ndarray, begun: int, opened: int | None) -> float:
    """Opening [m] that is reached both before and after a closing."""
    return float(min(opening[begun], np.inf if opened is None else opening[opened]))


def least_swing(extent: float, noise: float) -> float:
    """The least swing that counts [m] for an opening with this range and noise sd [m]."""
    return max(REST * extent, 2 * SURE * noise, LEAST_CLOSING)


def grip_of(t: np.ndarray, opening: np.ndarray, closing: Closing,
            pressing: np.ndarray | float | None, stiffness: float) -> Grip | None:  # fmt: skip
    """The grip that a closing ends in; None if the opening never stands.

    `pressing` (num_timesteps,) [N]: force of each pad, None if unknown; `stiffness` [N/m] of one pad.
    """
    begun, least, opened = closing
    floor, end = float(opening[least]), t.size - 1 if opened is None else opened
    inside = np.arange(begun, end + 1)
    low = inside[opening[inside] <= floor + REST * (_ceiling(opening, begun, opened) - floor)]
    held, first, last = float(np.median(opening[low])), int(low[0]), int(low[-1])
    force = np.nan if pressing is None else median_of_known(np.broadcast_to(pressing, t.shape)[low])
    if np.isfinite(force) and np.isfinite(stiffness):  # pads of unstated stiffness give, nobody knows how far
        width, sd = held + 2 * force / stiffness, 0.0
    else:
        widest = _fastest(t, opening, begun, first, held)
        seen = _release(t, opening[: end + 1], last, held)
        if seen is None or not held < seen[0] <= widest:  # it opens in steps, or has not opened yet
            seen = (widest + held) / 2, max((widest - held) / np.sqrt(12), _noise(opening))
        width, sd = _with_prior(seen, held)
    start = int(inside[np.argmax(opening[inside] <= width)])
    # An opening hand may pass the width well before it counts as moving.
    stop = int(inside[np.flatnonzero(opening[inside] <= width)[-1]]) + 1
    return Grip(start, stop, held, width, sd) if stop - start > 2 else None


def _fastest(t: np.ndarray, opening: np.ndarray, begun: int, first: int, held: float) -> float:
    """Opening [m] at which a closing is fastest, an upper bound of the width."""
    way = _coarse(t, opening, begun, first + 1)
    if way.size < 2:
        return max(float(opening[begun]), held)
    at = int(np.argmin(np.diff(way)))
    return max(float(way[at] + way[at + 1]) / 2, held)


def _release(t: np.ndarray, opening: np.ndarray, last: int, held: float) -> tuple[float, float] | None:
    """Opening [m] at which the fingers leave their stand after sample `last`, and its sd; None in noise."""
    lead = max(3, int(3 * STEP / np.median(np.diff(t))))
    way, noise = _coarse(t, opening, max(last - lead, 0), opening.size), _noise(opening)
    wide = np.flatnonzero(way > (held + opening[-1]) / 2)
    way = way[: wide[0] + 2] if wide.size and opening.size > last + 1 else way
    if way.size < 4:
        return None
    third = np.diff(way, 3)
    at = int(np.argmax(third))
    if third[at] < SURE * np.sqrt(20) * noise:
        return None
    return float(way[at + 2]), max(float(way[at + 3] - way[at + 1]) / 4, noise)


def _coarse(t: np.ndarray, opening: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Means of the opening [m] over each STEP, of samples [start, stop)."""
    group = max(1, int(STEP / float(np.median(np.diff(t))) + 1e-6))
    return grouped(opening[start:stop], group)[0]


def _noise(opening: np.ndarray) -> float:
    """Noise sd [m] of one sample of the opening, that of its rounding to coarse steps included.

    Between the messages of a slower stream it follows lines, which have none: only every so many samples tell
    how messages scatter.
    """
    bends = int(np.sum(np.abs(np.diff(opening, 2)) > ROUNDING * np.ptp(opening)))  # two a message
    every = round(2 * opening.size / bends) if MIN_ALIVE < bends / 2 < opening.size / 2 else 1
    return max(white_sd(opening[::every]), coarse_step(opening) / np.sqrt(12), 1e-6)


def _with_prior(seen: tuple[float, float], held: float) -> tuple[float, float]:
    """Mean and sd [m] of the opening at the touch: what was `seen` of it and the prior on the yield."""
    precision = np.array([seen[1], GIVE[1]]) ** -2.0
    mean = max(float(precision @ [seen[0], held + GIVE[0]] / precision.sum()), held)
    return mean, max(float(precision.sum() ** -0.5), SOFT * (mean - held))
