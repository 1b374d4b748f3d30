"""Features of recordings that are no fault, as columns fitted together with every effect.

They are what rig.toml admits under [systematic], inertia of pads, velocities that a drive computes as
differences, and how lifted blocks settle. Each column is in units of its prior standard deviation, so that
its prior is N(0, 1).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgap.effects import catalogue
from simgap.effects.base import gradient, middle, tips, with_load
from simgap.gap.frame import CHANNELS
from simgap.gap.problem import Nuisances, Problem, fit, free_of, neutral, residual_of, slots
from simgap.phases import Phase

SWING = 2e-3  # prior: rad; sd of the angle of a lifted block relative to how it stood
LANDING = 4e-5  # prior: m; sd of a pad's slip in the shock of landing
BEYOND = 5e-3  # prior: kg; sd of a pad's mass in front of its sensor, whose weight was tared


def with_nuisances(given: Problem) -> Problem:
    """Add the nuisances, linearised without effects, with properties at the centre of their prior.

    Their number depends only on trials, grips and rig. A column of zeros is kept, as with additional noise on
    the recordings it may not be zero (`simgap.gap.assemble`).
    """
    columns = [*_admitted(given), *_inertial(given), *_late_rates(given), *_settling(given)]
    return replace(given, nuisances=Nuisances(np.concatenate(columns, 1)))


def _admitted(given: Problem) -> list[np.ndarray]:
    """Columns (n, .) of what rig.toml admits under [systematic]."""
    out, k = [], given.num_common
    for admitted in (catalogue()[name].admitted for name in slots(k)[0]):
        key, sds = ("", {}) if admitted is None else admitted(given.frame.rig)
        if any(sds.values()):
            jacobian = fit(given, (key,), neutral(given), steps=0).jacobian[:, k:]
            for j, p in enumerate(free_of(key)):
                if sds.get(p.name, 0.0) > 0:
                    out.append(-jacobian[:, [j]] * sds[p.name] / p.sd)
    return out


def _inertial(given: Problem) -> list[np.ndarray]:
    """The column (n, 1) of pads' inertia.

    A sensor tared with its pad on does not show the pad's weight but the force that accelerates it. No effect
    of the catalogue is that, and it is no fault.
    """
    world = given.frame.world
    force = BEYOND * gradient(world.t, tips(world)[1])
    change = residual_of(given, with_load(world, force)) - residual_of(given, world)
    return [-change[:, None]]


def _late_rates(given: Problem) -> list[np.ndarray]:
    """Columns (n, 1) of velocities that are differences of positions, late by half a sample, or smoothed.

    rig.toml does not say how a drive obtains velocities: differences are as usual as a tachometer.
    """
    world, weight = given.frame.world, given.weight
    step = float(np.median(np.diff(world.t[0])))
    place, mean = map(middle, tips(world))
    # From the quieter of the two: a column with the residual's own noise would be fitted to smooth it.
    calm = _quieter(mean, gradient(world.t, place))
    rate = gradient(world.t, calm)
    bend = gradient(world.t, rate)
    # The velocity of a drive that differentiates its own readings from sample to sample.
    before = np.concatenate([world.joints[:, :1], world.joints[:, :-1]], 1)
    own = middle(tips(world._replace(rates=(world.joints - before) / step))[1])
    own[:, 1:-1] = (own[:, :-2] + 4 * own[:, 1:-1] + own[:, 2:]) / 6
    own = own - gradient(world.t, place)
    out = []
    for change, usual in ((own, 1.0), (rate, step / 2), (bend, step**2 / 2)):
        column = np.zeros_like(weight)
        for k, channel in enumerate(("vx", "vy")):
            c = CHANNELS.index(channel)
            column[..., c] = usual * change[..., k] * weight[..., c]
        out.append(column[given.there][:, None])
    return out


def _quieter(speed: np.ndarray, difference: np.ndarray) -> np.ndarray:
    """Velocities (T, N, 2) as read or as differences of positions, whichever are less rough.

    Differences of positions show noise of angles and errors of the clock, velocities their own noise.
    """
    rough = [np.square(np.diff(values, n=3, axis=1)).mean((0, 1)) for values in (speed, difference)]
    return np.where(rough[1] < rough[0], difference, speed)


def _settling(given: Problem) -> list[np.ndarray]:
    """Columns (n, 1) for each grip: the angle of the lifted block relative to how it stood, and the slip of
    pads in the shock of setting it down.
    """
    arrays, out = given.frame.arrays, []
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    for t in range(given.frame.num_trials):
        for m in range(arrays.onehot.shape[2]):
            mine = np.zeros_like(width)
            mine[t] = arrays.onehot[t, :, m]
            out.append(shifted_by(given, {"offset": width * SWING * mine * arrays.phase[..., Phase.CARRY]}))
            for name, share in (("y", 0.5**0.5), ("offset", 2**0.5)):
                out.append(shifted_by(given, {name: share * LANDING * mine * arrays.phase[..., Phase.PLACE]}))
    return out


def shifted_by(given: Problem, shifts: dict[str, np.ndarray]) -> np.ndarray:
    """Whitened column (n, 1) of shifts (T, N) of x, y, distance or offset."""
    world, off = given.frame.world, np.zeros((*given.frame.world.t.shape, 4))
    for name, shift in shifts.items():
        off[..., CHANNELS.index(name)] = shift
    return -(residual_of(given, world._replace(off=off)) - residual_of(given, world))[:, None]
