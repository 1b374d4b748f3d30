"""Three simple rivals of the diagnosis, on its own residuals and alignment, so that only the rule differs.

BIC over single effects; one fit of all effects at once, the largest by its t statistic named; the effect
whose signature has the largest cosine with the residual. Each may also say "none"; none of them can say
"unknown", name a pair or give a set.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from simgap.effects import catalogue
from simgap.gap import judge
from simgap.gap.candidates import best_fits, deterministic, starts
from simgap.gap.diagnose import Diagnosis
from simgap.gap.fit import Fitted, Problem, slots, whitened
from simgap.gap.spread import spreads

LEVEL = 0.01  # chance of a healthy recording to be called otherwise, by each rival's own white-noise theory


def rival_verdicts(found: Diagnosis, excluded: Sequence[str]) -> tuple[dict[str, str], dict[str, float]]:
    """What each rival names ("none" where it sees no gap), and every single effect's held-out gain [nats].

    Gains are those of the whole catalogue, effects taken out of it included: they tell no rival anything,
    and the scorer needs them to say which effects lie above the detection floor.
    """
    given = found.problem
    known = [n for n, e in catalogue().items() if e.chosen]
    if not given.frame.rig.jointed:
        known = [n for n in known if catalogue()[n].acts_on != "kinematics"]
    fits = {f.effects[0]: f for f in best_fits(given, [(n,) for n in deterministic(known)], found.healthy)}
    names = [n for n in fits if n not in excluded]
    verdicts = {
        "bic": _bic(found, [fits[n] for n in names]),
        "all_at_once": _together(found, names),
        "cosine": _cosine(found, names),
    }
    return verdicts, _gains(found, list(fits.values()))


def _gains(found: Diagnosis, fits: Sequence[Fitted]) -> dict[str, float]:
    """Gain of held-out log-likelihood over the healthy model, trials left out one at a time.

    A spread's gain is that of its variance at the best value, which is not held out: one number for
    hundreds of samples costs half a nat.
    """
    given = found.problem
    n = given.frame.num_trials
    moves = np.array([s.move if s.move is not None else 0 for s in given.frame.steps])

    def left(f: Fitted) -> float:
        return float(judge.heldout(given, f, judge.folds(f, n, moves), n).sum())

    before = left(found.healthy)
    gains = {f.effects[0]: 0.5 * (before - left(f)) for f in fits}
    return gains | {s.effect: s.evidence for s in spreads(given, found.healthy)}


def _bic(found: Diagnosis, fits: Sequence[Fitted]) -> str:
    """Least sum of squares + parameters x log(number of residuals)."""
    given = found.problem
    n = int((given.whitening.weight > 0).sum())
    score = {"none": float(found.healthy.square.sum())}
    for f in fits:
        more = len(f.columns) - given.num_properties
        score[f.effects[0]] = float(f.square.sum()) + more * np.log(n)
    return min(score, key=lambda k: score[k])


@jax.jit
def _derivatives(world, arrays, w, centre, spread, u, on):
    """Whitened residuals (T, N, C) and their derivatives by all coordinates (K, T, N, C)."""
    z, push = jax.linearize(lambda v: whitened(world, arrays, w, centre, spread, v, on)[0], u)
    return z, jax.vmap(push)(jnp.eye(u.size))


def _linearised(given: Problem, u: np.ndarray, on: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) and derivatives (n, K) at coordinates u with the effects in `on` switched on."""
    tree = jax.tree.map(
        jnp.asarray, (given.frame.world, given.frame.arrays, given.whitening, given.centre, given.spread)
    )
    switches = np.array([float(s.effect.name in on) for s in slots(given.num_properties)[0]])
    z, push = _derivatives(*tree, jnp.asarray(np.append(u, 0.0)), jnp.asarray(switches))
    there = given.whitening.weight > 0
    return np.asarray(z)[there], np.asarray(push)[:-1, there].T


def _together(found: Diagnosis, names: list[str]) -> str:
    """One linear fit of all effects from the healthy optimum; the largest joint t statistic."""
    given = found.problem
    smooth = [n for n in names if not catalogue()[n].switched]
    z, push = _linearised(given, found.healthy.u, smooth)
    places = [s for s in slots(given.num_properties)[0] if s.effect.name in smooth]
    columns = np.concatenate([np.arange(given.num_properties), *[np.arange(s.start, s.stop) for s in places]])
    j = push[:, columns]
    inverse = np.linalg.inv(j.T @ j + np.eye(columns.size))
    value = -inverse @ (j.T @ z)
    best, least = "none", LEVEL / len(smooth)
    at = given.num_properties
    for s in places:
        mine = np.arange(at, at + s.stop - s.start)
        at = int(mine[-1]) + 1
        square = float(value[mine] @ np.linalg.solve(inverse[np.ix_(mine, mine)], value[mine]))
        p = chi2.sf(square, mine.size)
        if p < least or (p == least == 0.0):
            best, least = s.effect.name, p
    return best


def _cosine(found: Diagnosis, names: list[str]) -> str:
    """The largest share of the residual's length that lies in an effect's signature, properties aside."""
    given = found.problem
    z, push = _linearised(given, found.healthy.u, [])
    own, _ = np.linalg.qr(push[:, : given.num_properties])
    rest = z - own @ (own.T @ z)
    if chi2.sf(float(rest @ rest), rest.size - given.num_properties) > LEVEL:
        return "none"
    score = {}
    places = {s.effect.name: s for s in slots(given.num_properties)[0]}
    for name in names:
        start = starts(given, (name,), found.healthy.u)[0]
        moved, signature = _linearised(given, start.u, [name])
        slot = places[name]
        basis = signature[:, slot.start : slot.stop]
        if not np.allclose(moved, z):
            basis = np.column_stack([basis, moved - z])
        basis = basis - own @ (own.T @ basis)
        left, size, _ = np.linalg.svd(basis, full_matrices=False)
        left = left[:, size > 1e-8 * max(size.max(), 1e-30)]
        score[name] = float(np.linalg.norm(left.T @ rest) / np.linalg.norm(rest))
    return max(score, key=lambda k: score[k])
