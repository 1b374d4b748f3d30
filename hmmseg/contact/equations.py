"""The contact equations of a two-finger grip.

Quasistatic balance of the block and linear pads, per sample (x right, y up, finger 1 left; F: force exerted
by a fingertip; paper, Sections 2 and 3.3, extended by the block's inertia and the pads' compliance):

| contact state | equations |
|---|---|
| free motion | F1 = F2 = 0 |
| every grip | `block_width` = w, `block_offset` constant; `block_x`, `block_y`: position of the block |
| hold on ground | `block_x`, `block_y` constant; 0 <= `support_load` |
| sliding on ground | `block_y` constant; |net fx - m ax| <= mu `support_load` |
| hold above ground | net fx = m ax; net fy = `carried_force` |

A hand that rolls rotates its fingers together with the held block. These equations hold along and across the
hand, so differences between the fingers are rotated back first (`turned`); sums and means remain as they are,
as weight points down however the hand is rotated. A roll shows as a height difference of the fingers
(`rolled_offset`).

Emissions (hmmseg.segmentation), observations of properties (estimation) and residuals of the gap (simgap) are
built from these functions; the dynamics of the virtual model (simgap.world) is tested against them. The
inertia of a carried block alone is written again, where it is compiled: in `simgap.gap.residuals`. All
functions accept NumPy and JAX arrays of any broadcastable shapes, in SI units, and raise nothing.
"""

from typing import Any, NamedTuple

import numpy as np

from hmmseg.io.rig import Rig

Values = Any  # a NumPy or JAX array, or a number


class Pads(NamedTuple):
    """Compliances of both fingers' pads [m/N], along the grip and in shear; 0 for a rigid pad."""

    normal1: Values
    normal2: Values
    shear1: Values
    shear2: Values


def pads_of(rig: Rig) -> Pads:
    """The nominal pads of a rig, the same on both fingers."""
    normal, shear = 1 / rig.fingertip.normal_stiffness, 1 / rig.fingertip.shear_stiffness
    return Pads(normal, normal, shear, shear)


def block_width(distance: Values, fx1: Values, fx2: Values, pads: Pads) -> Values:
    """Width of the held block [m]: the fingers' distance plus the give of both pads under the grip."""
    return distance + fx1 * pads.normal1 - fx2 * pads.normal2


def block_x(x: Values, fx1: Values, fx2: Values, pads: Pads) -> Values:
    """Horizontal position of the held block [m], from the fingers' mean position."""
    return x - (fx1 * pads.normal1 + fx2 * pads.normal2) / 2


def block_y(y: Values, fy1: Values, fy2: Values, pads: Pads) -> Values:
    """Height of the held block [m], up to where it is gripped, from the fingers' mean height."""
    return y - (fy1 * pads.shear1 + fy2 * pads.shear2) / 2


def block_offset(offset: Values, fy1: Values, fy2: Values, pads: Pads) -> Values:
    """Height difference [m] of the places at which the pads hold the block: constant in one grip."""
    return offset - (fy2 * pads.shear2 - fy1 * pads.shear1)


def turned(across: Values, up: Values, angle: Values) -> tuple[Values, Values]:
    """A vector with these horizontal and vertical components, rotated counterclockwise by `angle` [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return across * cos - up * sin, across * sin + up * cos


def rolled_offset(distance: Values, roll: Values) -> Values:
    """Height difference [m] of fingers at this distance [m] due to a small roll [rad]."""
    return distance * roll


def hanging(weight: Values, pads: Pads) -> Values:
    """Distance by which a block of this weight hangs below the fingers, by the pads' shear [m]."""
    return weight * (pads.shear1 + pads.shear2) / 4


def inertia_factor(acceleration: Values, gravity: float) -> Values:
    """1 + a / g: vertical force on a lifted block in units of its weight."""
    return 1 + acceleration / gravity


def carried_force(weight: Values, ay: Values, gravity: float) -> Values:
    """Net vertical force that carries a block above the ground [N]."""
    return weight * inertia_factor(ay, gravity)


def support_load(weight: Values, fy: Values) -> Values:
    """Load of a resting block on its support [N], which can only push."""
    return weight - fy
