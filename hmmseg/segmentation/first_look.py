"""Blocks and biases of one trial at a first look: what its grips hold, with no order in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.contact.equations import block_width
from hmmseg.levels import SURE
from hmmseg.robust import NORMAL, median_of_known
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.features import noise_sd
from hmmseg.segmentation.fit import otsu

SAME_WIDTH = 1e-3  # chosen: m; grips this alike in width ...
SAME_WEIGHT = 0.25  # chosen: ... and, relatively, in weight are grips of one block
PRESSED = 30  # chosen: noise sds of a grip force that is there all the time, and so no bias
# chosen: m from the heights at a grip's ends (medians of so many samples) to be lifted
RAISED, ENDS = 3e-3, 3


@dataclass(frozen=True)
class Block:
    """A block as one trial shows it: `width` [m] and `weight` [N] (NaN: never lifted)."""

    width: float
    weight: float

    def like(self, other: Block, slack: float = 1.0) -> bool:
        """Whether both can be the same block: like widths, and weights where both are known.

        `slack` multiplies the tolerances.
        """
        narrow = abs(self.width - other.width) <= slack * SAME_WIDTH
        apart = abs(self.weight - other.weight)  # NaN where either is unknown, which excludes nothing
        return bool(narrow and not apart > slack * SAME_WEIGHT * max(self.weight, other.weight))


def ungripped(f: Features) -> tuple[np.ndarray, float, np.ndarray]:
    """Force biases (4,), force scale and which samples are gripped: a start from the grip force.

    Otsu's split always finds two groups. They are free and gripped only where they lie far
    apart in terms of noise; where the lower one carries force as well, all is gripped.
    """
    found = np.array([noise_sd(f.force[:, c]) for c in range(4)])
    noise = max(median_of_known(found, 0.0), 1e-3 * f.span["force"])
    grip = f.grip
    there = np.isfinite(grip)
    every = np.ones(grip.size, bool)
    if there.sum() < 2:
        return np.zeros(4), noise, ~every
    split = otsu(grip)
    low, high = grip[there & (grip <= split)], grip[there & (grip > split)]
    apart = high.size > 0 and np.median(high) - np.median(low) > SURE * noise
    # Where one group alone is there, opposed forces far above the noise are a grip, others a bias.
    opposed = abs(median_of_known(f.force[:, 0] + f.force[:, 2], np.inf)) < 0.3 * np.median(grip[there])
    if np.median(low) > (0.3 * np.median(high) if apart else PRESSED * noise) and opposed:
        return np.zeros(4), noise, every
    threshold = np.median(low) + 0.25 * (np.median(high) - np.median(low)) if apart else np.inf
    held = filled(grip) > threshold
    free = f.force[~held]
    bias = np.array([median_of_known(free[:, c], 0.0) for c in range(4)])
    spread = np.array([NORMAL * median_of_known(np.abs(free[:, c] - bias[c]), np.nan) for c in range(4)])
    return bias, max(median_of_known(spread, 0.0), noise), held


def filled(values: np.ndarray) -> np.ndarray:
    """Values with what is missing interpolated; zeros where all are."""
    there = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(values.size), there, values[there]) if there.size else np.zeros(values.size)


def blocks_of(f: Features, bias: np.ndarray, held: np.ndarray, guessing: bool = False) -> tuple[Block, ...]:
    """Distinct blocks among the grips, each grip's width and weight by robust means.

    What is weighed is what surely moves. Where its load is lost in noise no weight is known; if `guessing`
    it is what that load seems to be, two standard errors at least.
    """
    fy = f.force[:, 1] + f.force[:, 3] - bias[1] - bias[3]
    fx1, fx2 = (filled(f.force[:, c] - bias[c]) for c in (0, 2))
    widths = block_width(f.d, fx1, fx2, f.pads)
    noise = noise_sd(f.force[:, 1])
    found: list[Block] = []
    for start, stop in runs(held):
        span = slice(start, stop)
        width = median_of_known(widths[span], np.nan)
        if stop - start < 2 or not np.isfinite(width):
            continue
        lifted = (fy / f.carrying)[span][_lifted(f, span, guessing)]
        lifted = lifted[np.isfinite(lifted)]
        weight = float(np.median(lifted)) if lifted.size > 2 else np.nan
        # Of the median of n sums of two forces, whose standard error is sqrt(pi / 2) sqrt(2 / n) sds of one.
        error = noise * np.sqrt(np.pi / max(lifted.size, 1))
        least = weight if guessing else 3 * error
        block = Block(width, max(weight, 2 * error) if weight >= least else np.nan)
        match = next((i for i, other in enumerate(found) if block.like(other)), None)
        if match is None:
            found.append(block)
        elif not np.isfinite(found[match].weight):
            found[match] = block
    return tuple(found)


def _lifted(f: Features, span: slice, guessing: bool) -> np.ndarray:
    """Which samples of one grip, (stop - start,), are surely of a lifted block; if `guessing`, probably.

    Whatever is lifted moves vertically; a block that is pushed or only gripped does not. Velocities
    tell it where they are known and exact; heights, which last longer, tell it of poor recordings: far
    from where the grip begins and from where it ends. A block that falls is where its grip ends, so that the
    guess is what is far from where it begins.
    """
    moving = np.abs(f.vy[span]) > 6 * f.sd_vy[span]
    height = filled(f.y)[span]
    least = np.maximum(4 * f.sd_y[span], RAISED)
    ends = np.median(height[:ENDS]), np.median(height[-ENDS:])
    return moving | np.all([np.abs(height - end) > least for end in ends[: 1 if guessing else 2]], axis=0)


def runs(found: np.ndarray) -> list[tuple[int, int]]:
    """Where each stretch of true samples starts and stops."""
    edges = np.flatnonzero(np.diff(np.r_[False, found, False].astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
