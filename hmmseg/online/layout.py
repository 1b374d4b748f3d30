"""Where each number of one hypothesis stands: a row of floats that the kernels average and copy.

A hypothesis is one history of contact states with what follows from it, each quantity in the form in
which evidence adds up: means as (precision x mean, precision), squared scales as (weighted sum of
squares, weight). A precision of 0 is a quantity of which nothing is known.
"""

from __future__ import annotations

from dataclasses import dataclass

# Of the history: log weight, state (0 ... of the round's subtasks, then those off the task), round,
# time at which the state was entered [s] and its variance, boundaries crossed so far, the
# subtask that is not reached any more (-1: on the task) and since when [s].
WEIGHT, STATE, ROUND, ENTRY, ENTRY_VARIANCE, CROSSED, MISSED, LEFT_AT = range(8)
BIAS = 8  # numerics: of fx1, fy1, fx2, fy2, two numbers each
SCALES = BIAS + 8  # seven, two numbers each, in this order
FORCE, CARRY, NET_X, SHEAR, VELOCITY, LEVEL_SCALE, WIDTH_SCALE = range(7)
LEVEL = SCALES + 14  # height at which the block rests [m]
ORIGIN = LEVEL + 2  # mean and variance of the level at the move's pickup
RING = ORIGIN + 2  # mean and variance of the last boundaries
NUM_RING = 8  # numerics: boundaries that are remembered, the last ones; a move has four
OBJECTS = RING + 2 * NUM_RING  # weight [N] and width [m] of every block, four numbers each

# Kinds of contact states, as the kernels number them.
FREE_KIND, GROUND_KIND, SLIDING_KIND, ABOVE_KIND = range(4)

# A reading: time, forces, velocities, vertical acceleration, height, distance, noise of positions and
# velocities; height and distance of the reading before, net vertical force of the one 1 / MAX_RATE s before;
# what may be wrong with net forces, across and up (of a wrist's sensor: the tool's own share), and whether
# something else than forces tells that nothing is held (0), or that something is (2; 1: nothing does).
(T, FX1, FY1, FX2, FY2, VX, VY, AY, Y, D, SD_Y, SD_D, SD_VX, SD_VY, LAST_Y, LAST_D, LAST_FY, SD_FX, SD_FY,
 GRIPPED) = range(20)  # fmt: skip
NUM_READ = 20  # numerics: how many are named above

# Ranges of what is free to be anywhere (see hmmseg.segmentation.emissions).
SPAN_VX, SPAN_VY, SPAN_Y, SPAN_D, SPAN_FORCE, SPAN_PRESS = range(6)


@dataclass(frozen=True)
class Layout:
    """Widths that depend on the task: its blocks (one more stands for any other) and moves."""

    num_objects: int
    num_moves: int

    @property
    def rises(self) -> int:
        """Where the moves' rises [m] begin, two numbers each."""
        return OBJECTS + 4 * (self.num_objects + 1)

    @property
    def width(self) -> int:
        """Numbers of one hypothesis."""
        return self.rises + 2 * self.num_moves
