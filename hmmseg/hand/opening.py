"""Grips of a parallel gripper as its opening shows them: where the pads touch, squeeze and let go.

A gripper that closes moves freely until both pads touch; from there the block slows it down, the pads
give, and it stands until it opens again, slowly as long as the pads press and freely after. So the
block's width is the opening at which the closing slowed down and at which the opening took off, and what
the wrist felt of a hold may end there. Each says so within bounds; what they say is weighed together.
Where the pads' spring and the grip force are known, what the pads give is known instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.hand.grouping import grouped
from hmmseg.robust import white_sd

STEP = 0.02  # numerics: s; speeds are taken over this: a gripper's motor changes them no faster
SLOWED = 0.9  # chosen: share of its speed that a closing keeps until the first touch
ABRUPT = 0.5  # chosen: share of its speed that a closing loses from one step to the next at a hard touch
SOFT = 0.1  # prior: of what gives in a grip: its touch is known no better, as pads are no ideal springs
GIVE = (1e-3, 1.5e-3)  # prior: m, mean and sd: what pads and drive give in a grip, before anything is seen
WRONG = 0.2  # prior: how often one of the estimates of the touch is of something else
TAIL, NODES, GRID = (
    4.0,
    400,
    1e-4,
)  # numerics: degrees of freedom of the prior; its grid, and least extent [m]
LEAST_CLOSING = 1e-3  # chosen: m; a smaller swing of the opening is no grip
CLEAR = 6.0  # chosen: noise sds of a third difference: a kink


@dataclass(frozen=True)
class Grip:
    """One closing on something: samples [start, stop) in which the pads touch it.

    `held` [m]: the opening at which it stands; `width` [m] and `width_sd`: the opening at which both
    pads just touch.
    """

    start: int
    stop: int
    held: float
    width: float
    width_sd: float


def closings(opening: np.ndarray) -> list[tuple[int, int, int]]:
    """Closings that end in a stand, as samples (begun, least, opened), by turning points.

    A swing counts where it is a tenth of the whole way and beyond the noise.
    """
    noise = white_sd(opening)
    swing = max(0.1 * float(np.ptp(opening)), 10 * noise, LEAST_CLOSING)
    turning, last = [0], 0
    rising: bool | None = None
    for i, value in enumerate(opening):
        if rising is None:
            if abs(value - opening[0]) > swing:
                rising, last = bool(value > opening[0]), i
        elif (value > opening[last]) == rising:
            last = i
        elif abs(value - opening[last]) > swing:
            turning.append(last)
            rising, last = not rising, i
    turning += [last] * (last != turning[-1])
    turning += [len(opening) - 1] * (turning[-1] != len(opening) - 1)
    found = []
    for before, least, after in zip(turning, turning[1:], [*turning[2:], turning[-1]], strict=False):
        if opening[before] - opening[least] > swing / 2:
            found.append((before, least, after))
    return found


def grip_of(t: np.ndarray, opening: np.ndarray, active: np.ndarray, closing: tuple[int, int, int],
            give: float | None) -> Grip | None:  # fmt: skip
    """The grip that a closing ends in; None where the opening never stands.

    `active` (num_timesteps,): where the wrist feels something; `give` [m]: what the pads give while
    held, where it is known.
    """
    begun, least, opened = closing
    floor = float(opening[least])
    ceiling = min(float(opening[begun]), float(opening[opened])) if opened > least else float(opening[begun])
    inside = np.arange(begun, opened + 1)
    low = inside[opening[inside] <= floor + 0.1 * (ceiling - floor)]
    held, first, last = float(np.median(opening[low])), int(low[0]), int(low[-1])
    if give is not None:
        width, sd = held + give, 0.0
    else:
        estimates = [
            _touch(t, opening, begun, first, held),
            *_release(t, opening, active, last, opened, held),
        ]
        width, sd = _together(estimates, held, ceiling)
    start = int(inside[np.argmax(opening[inside] <= width)])
    after = np.flatnonzero(opening[last : opened + 1] > width)
    stop = int(last + after[0]) if after.size else opened + 1
    return Grip(start, stop, held, width, sd) if stop - start > 2 else None


def _coarse(t: np.ndarray, opening: np.ndarray, start: int, stop: int) -> np.ndarray:
    """The opening [m] every STEP, means of what lies within, of samples [start, stop)."""
    group = max(1, int(STEP / float(np.median(np.diff(t))) + 1e-6))
    return grouped(opening[start:stop], group)[0]


def _kink(way: np.ndarray, noise: float) -> tuple[float, float] | None:
    """Where a way (n,) that leaves a stand takes off [m], and its sd; None where noise hides it."""
    if way.size < 4:
        return None
    third = way[3:] - 3 * way[2:-1] + 3 * way[1:-2] - way[:-3]
    at = int(np.argmax(third))
    if third[at] < CLEAR * np.sqrt(20) * noise:
        return None
    return float(way[at + 2]), max(float(way[at + 3] - way[at + 1]) / 4, noise)


def _noise(opening: np.ndarray) -> float:
    """Noise sd [m] of one sample of the opening."""
    return max(white_sd(opening), 1e-6)


def _touch(t: np.ndarray, opening: np.ndarray, begun: int, first: int, held: float) -> tuple[float, float]:
    """Touch while closing [m]: between where it begins to slow down and where it has most."""
    way = _coarse(t, opening, begun, first + max(4, int(4 * STEP / np.median(np.diff(t)))))
    speed = way[:-1] - way[1:]
    fast = np.flatnonzero(speed >= SLOWED * speed.max()) if speed.size else np.zeros(0, int)
    early = float(opening[begun])
    if fast.size:
        at = int(fast[-1])
        stopped = at + 1 >= speed.size or speed[at + 1] < ABRUPT * speed[at]
        early = float(way[at] if stopped else way[at + 1])  # a step that ends in a stop may end in the touch
    kink = _kink(way[::-1], _noise(opening))
    late = held if kink is None else kink[0]
    early, late = max(early, late, held), max(min(early, late), held)
    return (early + late) / 2, max((early - late) / np.sqrt(12), _noise(opening))


def _release(t: np.ndarray, opening: np.ndarray, active: np.ndarray, last: int, opened: int, held: float
             ) -> list[tuple[float, float]]:  # fmt: skip
    """Openings [m] at which the fingers took off, and at which what the wrist felt ended, with sds."""
    found = []
    lead = max(3, int(3 * STEP / np.median(np.diff(t))))
    way = _coarse(t, opening, max(last - lead, 0), opened + 1)
    top = float(opening[opened]) if opened > last else held
    kink = _kink(way[: int(np.argmax(way > (held + top) / 2)) + 2] if (way > (held + top) / 2).any() else way,
                 _noise(opening))  # fmt: skip
    if kink is not None and kink[0] > held:
        found.append(kink)
    felt = np.flatnonzero(active[last : opened + 1])
    if felt.size and last + felt[-1] < opened and active[last : last + felt[-1] + 1].all():
        i = int(last + felt[-1])
        if opening[i] > held:
            found.append(
                (
                    float(opening[i] + opening[i + 1]) / 2,
                    abs(float(opening[i + 1] - opening[i])) / np.sqrt(12),
                )
            )
    return found


def _together(estimates: list[tuple[float, float]], held: float, top: float) -> tuple[float, float]:
    """Mean and sd [m] of the opening at the touch, between the one held and the widest, `top`.

    What pads and drive give is the prior (Student-t); each estimate is right within its sd, or is of
    something else (a finger that drags the block on, an opening in two steps) and tells nothing.
    """
    width = np.linspace(held, max(top, held + GRID), NODES)
    log_density = -(TAIL + 1) / 2 * np.log1p(((width - held - GIVE[0]) / GIVE[1]) ** 2 / TAIL)
    for value, sd in estimates:
        sd = max(sd, float(width[1] - width[0]))
        right = np.exp(-0.5 * ((width - value) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        log_density += np.log((1 - WRONG) * right + WRONG / float(width[-1] - width[0]))
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    mean = float(density @ width)
    return mean, max(float(np.sqrt(density @ (width - mean) ** 2)), SOFT * (mean - held))
