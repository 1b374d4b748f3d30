"""A hand that turns a little about the grip while it carries, both fingers and the block together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.contact.equations import rolled_offset
from simgap.effects.base import KINEMATICS, Effect, Parameter, Performance
from simgap.gap.trial_arrays import CHANNELS
from simgap.phases import Phase

SLOW = 2.0  # prior: Hz; a hand with a block in it turns no faster (an arm's own modes lie above)
VARIED = 0.5  # prior: log sd of a carry's roll about that of all: a second of it is one swing or two
ROLLS = np.geomspace(2e-4, 0.1, 40)  # prior: rad


def _scatter(given, residual: np.ndarray):
    """Roll shows in the fingers' height difference alone: its width times the angle, slowly.

    Its power lies in the first cosines of every carry, evenly up to SLOW. A hand rolls in every carry alike:
    what turns in some of them only is no roll of the hand.
    """
    from scipy.fft import dct

    from simgap.gap.assemble import rows_of
    from simgap.gap.scatter import on_grid

    rows, arrays, there = rows_of(given), given.frame.arrays, given.whitening.weight > 0
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    lever = rolled_offset(width * arrays.phase[..., Phase.CARRY], 1.0)[..., None] * given.whitening.weight
    lever[..., [c for c, name in enumerate(CHANNELS) if name != "offset"]] = 0.0
    lever = lever[there]
    unit, square = np.zeros(lever.size), np.zeros(lever.size)
    mine = np.flatnonzero(lever > 0)
    for cell in np.unique(rows.cell[mine]):
        at = mine[rows.cell[mine] == cell]
        if at.size < 4:
            continue
        step = float(np.median(np.diff(rows.time[at])))
        slow = np.arange(at.size) / (2 * at.size * step) < SLOW
        unit[at] = slow * np.mean(lever[at] ** 2) * at.size / slow.sum()
        square[at] = np.asarray(dct(residual[at], norm="ortho")) ** 2
    if not (unit > 0).any():
        return None
    found = on_grid("hand_roll", square, unit, ROLLS, rows.cell, VARIED)
    # How much of it there is in which carry and how fast nobody knows: what lies there has its own variance.
    return replace(found, variance=np.zeros_like(unit), known=0.0, frees=np.square(ROLLS[-1] * lever))


def _apply(performance: Performance, values, rng) -> Performance:
    """A smooth random turn of the given root mean square, while something is carried."""
    t = performance.t
    angle = np.zeros(t.size)
    for frequency in np.arange(0.2, 1.6, 0.2):
        angle += rng.normal() * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 2 * np.pi))
    held = performance.carried > 0
    scale = np.sqrt(np.mean(angle[held] ** 2)) if held.any() else 1.0
    angle = values["amplitude"] * angle / scale * held
    position = performance.position.copy()
    for finger, sign in ((0, -0.5), (1, 0.5)):
        position[:, finger, 1] += sign * rolled_offset(performance.width, angle * held)
    return performance._replace(position=position)


EFFECT = Effect(
    name="hand_roll",
    acts_on="motion",
    says="both fingers and the block turn about the grip by `amplitude` (rms) while carried",
    shows="height difference of the fingers while carried",
    mistaken_for=("offcentre_mass", "fingertip_compliance"),
    called="a hand that rolls while it carries",
    check=(
        "Watch both fingertips' heights while carrying: the wrist or the arm turns; measure it, or "
        "stiffen it."
    ),
    parameters=(Parameter("amplitude", "rad", 1.0, neutral=0.005, log=True, low=1e-4, high=0.2),),
    stage=KINEMATICS,
    scatter=_scatter,
    apply=_apply,
)
