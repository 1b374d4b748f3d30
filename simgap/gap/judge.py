"""Which effect: tempered evidence of every candidate, held-out trials, probabilities.

Evidence is Laplace's approximation on whitened residuals. Models are exact only up to a few per cent
of an effect, so evidence is tempered by what the best candidate leaves unexplained (a quasi-likelihood:
McCullagh & Nelder, Generalized Linear Models, 1989, chapter 9). A free-form discrepancy competes for
the verdict "unknown" only.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit, logsumexp

from simgap.effects import decoys
from simgap.effects import fitted as known_effects
from simgap.gap.fit import Fitted, Problem, limits, slots

DEFAULT_MISFIT = 0.03  # of an effect that the bank never had
SCALES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # of an effect's amplitudes, in sds of their priors
EDGE = 1e-6
ALIKE = " alike"  # end of the name of a candidate whose independent parts err alike
TIED = 0.05  # of the amplitudes' scale: how exactly they follow the pattern then
STAYS = 0.8  # of the decades by which a gap exceeds noise: what still does was not explained
USUAL = 10.0  # decades by which what a wrong cause leaves usually exceeds noise


@dataclass(frozen=True)
class Calibration:
    """Constants learned on the simulated bank: see docs/gap.md.

    `temperature`: floor of the evidence's temperature; `prior`: log prior of a candidate against none;
    `floor`: healthy mean square of whitened residuals; `unknown_at`, `unknown_width`: share of the gap
    left by the best candidate at which "unknown" is as likely, and its logistic width in log share;
    `unknown_slope`: weight of how surely what is left is no noise; `unknown_coarse`: factor on
    `unknown_at` where the best candidate is a coarse effect;
    `misfit`: by effect, how far its parameters were off on the bank beyond their own sd, as a share.
    """

    temperature: float = 1.5
    prior: float = -4.0
    floor: float = 0.95
    unknown_at: float = 0.3
    unknown_width: float = 0.25
    unknown_slope: float = 0.0
    unknown_coarse: float = 1.0
    misfit: dict[str, float] = field(default_factory=dict)

    def inflated(self, effect: str, sd: float, value: float) -> float:
        """Standard deviation of a parameter with what the effect's form is off by."""
        known = known_effects()[effect]
        share = np.hypot(self.misfit.get(effect, DEFAULT_MISFIT), known.form)
        return float(np.sqrt(sd**2 + (share * value) ** 2 + known.blur**2))


def log_evidence(given: Problem, found: Fitted, healthy: Fitted, temperature: float = 1.0) -> float:
    """Log evidence [nats] of a candidate over none, Laplace's approximation about its fit.

    Coordinates are standard normal beforehand, but how large an effect is as a whole is unknown: its
    amplitudes share a scale, uniform over SCALES (automatic relevance determination: MacKay, Neural
    Computation 4, 1992). Many small parameters then cost no more than they should.
    """
    return _log_integral(given, found, temperature) - _log_integral(given, healthy, temperature)


def coincidence(given: Problem, found: Fitted, temperature: float = 1.0) -> float:
    """Log Bayes factor [nats] of parts that err alike over parts that err each by itself.

    What is offered as independent (channels, joints) falls into a pattern of both fingers (`Effect.ties`) by
    chance alone: if it does, one cause is behind it, and that is another effect. The largest factor over the
    candidate's effects; minus infinity where none of them has ties.
    """
    plain, best = _log_integral(given, found, temperature), -np.inf
    for name in found.effects:
        each = []
        for rows in known_effects()[name].ties:
            basis = np.linalg.qr(np.array(rows).T)[0]
            inside = basis @ basis.T
            tie = inside + (np.eye(len(basis)) - inside) / TIED**2
            each.append(_log_integral(given, found, temperature, (name, tie)))
        if each:
            best = max(best, float(logsumexp(each) - np.log(len(each))) - plain)
    return best


def _log_integral(
    given: Problem, found: Fitted, temperature: float, tied: tuple[str, np.ndarray] | None = None
) -> float:
    """Log of likelihood times prior, integrated over a candidate's parameters and its effects' scales.

    `tied`: an effect and the precision of its amplitudes at scale 1, instead of the identity.
    """
    u = found.u[found.columns]
    bend = found.hessian.sum((0, 1)) / temperature
    slope = found.gradient.sum((0, 1)) / temperature
    groups = _amplitudes(given, found)
    bounds = _bounds(given, found)
    each = []
    for scales in itertools.product(SCALES, repeat=len(groups)):
        sure = np.eye(u.size)  # precision of the prior
        for (name, group), scale in zip(groups.items(), scales, strict=True):
            own = tied[1] if tied is not None and name == tied[0] else np.eye(group.size)
            sure[np.ix_(group, group)] = own * scale**-2.0
        total = bend + sure
        pull = slope + sure @ u
        step = newton(total, pull, u, *bounds)
        gain = -pull @ step - 0.5 * (step @ total @ step + u @ sure @ u)
        each.append(gain + 0.5 * (np.linalg.slogdet(sure)[1] - np.linalg.slogdet(total)[1]))
    fitted_part = (found.cost - 0.5 * u @ u) / temperature
    return float(logsumexp(each) - np.log(len(each)) - fitted_part)


def _bounds(given: Problem, found: Fitted) -> tuple[np.ndarray, np.ndarray]:
    low, high = limits(given)
    return low[found.columns], high[found.columns]


def newton(
    hessian: np.ndarray, slope: np.ndarray, u: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Step (K,) from `u` to the least of a quadratic form inside its bounds.

    What a step would take past its bound stays there, and the others make up for it: beyond a bound nothing
    can be gained, however steep the slope.
    """
    step = np.zeros_like(u)
    held = np.where(slope < 0, u >= high - EDGE, u <= low + EDGE)
    while True:
        free = ~held
        rest = slope + hessian @ np.where(held, step, 0.0)
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], rest[free])
        past = free & ((u + step < low) | (u + step > high))
        if not past.any():
            return step
        step[past] = (np.clip(u + step, low, high) - u)[past]
        held |= past


def _amplitudes(given: Problem, found: Fitted) -> dict[str, np.ndarray]:
    """For every effect of a candidate that has some: which of its columns are amplitudes."""
    out = {}
    for slot in slots(given.num_properties)[0]:
        if slot.effect.name in found.effects:
            at = [slot.start + j for j, p in enumerate(slot.effect.parameters) if p.amplitude]
            if at:
                out[slot.effect.name] = np.flatnonzero(np.isin(found.columns, at))
    return out


def folds(found: Fitted, num_trials: int, moves: np.ndarray) -> np.ndarray:
    """Labels (T, S) of the blocks left out together: trials, or moves where there is one trial."""
    shape = found.square.shape
    if num_trials > 1:
        return np.broadcast_to(np.arange(shape[0])[:, None], shape)
    return np.broadcast_to(moves[None, :], shape)


def heldout_gain(given: Problem, f: Fitted, healthy: Fitted, labels: np.ndarray) -> float:
    """Nats that a fit gains over the healthy one on blocks that neither was fitted to, in sum."""
    n = given.frame.num_trials
    return 0.5 * float((heldout(given, healthy, labels, n) - heldout(given, f, labels, n)).sum())


def heldout(given: Problem, found: Fitted, labels: np.ndarray, num_trials: int) -> np.ndarray:
    """Squared whitened residual (T, S) of every block, predicted by a fit to the others.

    The fit is the linearised one about the optimum, inside its bounds: exact for linear effects.
    """
    real = np.arange(labels.shape[0]) < num_trials
    hessian, gradient = found.hessian[real], found.gradient[real]
    out = found.square.copy()
    prior, bounds = found.u[found.columns], _bounds(given, found)
    for label in np.unique(labels[real]):
        left = labels[real] == label
        h = hessian[~left].sum(0) + np.eye(prior.size)
        step = newton(h, gradient[~left].sum(0) + prior, prior, *bounds)
        rows = np.flatnonzero(real)[np.nonzero(left)[0]], np.nonzero(left)[1]
        out[rows] = (
            found.square[rows]
            + 2 * found.gradient[rows] @ step
            + np.einsum("i,rij,j->r", step, found.hessian[rows], step)
        )
    return np.maximum(out[real], 0.0)


def alien(best: str, left: float, p_left: float, c: Calibration, p: float = 0.0) -> float:
    """Probability that no candidate of the catalogue is the cause.

    `left`: share of the gap that the `best` candidate leaves; `p_left`: chance of noise to look like what it
    leaves, `p`: like what there was. Logistic in both logarithms, and nothing where the remainder may well be
    noise; near 1 where what raised the alarm is still there.
    """
    surprise, alarm = (-np.log10(max(chance, 1e-300)) for chance in (p_left, p))
    coarse = any(known_effects()[name].coarse for name in best.split("+") if name in known_effects())
    usual = c.unknown_at * (c.unknown_coarse if coarse else 1.0)
    odds = np.log(max(left, 1e-6) / usual) / c.unknown_width
    odds += c.unknown_slope * np.log(max(surprise, 1.0) / USUAL)
    stays = expit((surprise / max(alarm, 1.0) - STAYS) / 0.1)
    return float(max(expit(odds), stays) * expit(2 * (surprise - 2)))


def probabilities(
    evidence: Mapping[str, float], left: float, p_left: float, c: Calibration, p: float = 0.0
) -> dict[str, float]:
    """Probabilities of none, unknown and every candidate; sums to 1. What is `nameless` goes to unknown.

    `evidence` [nats, tempered] over none; `left`, `p_left` and `p` as `alien` takes them.
    """
    names = ["none", *evidence]
    score = np.array([0.0, *(value + c.prior for value in evidence.values())])
    share = np.exp(score - logsumexp(score))
    unknown = alien(max(evidence, key=lambda n: evidence[n]), left, p_left, c, p) if evidence else 0.0
    out = {n: float(part * (1 - unknown)) for n, part in zip(names, share, strict=True)}
    unknown += sum(out.pop(n) for n in evidence if nameless(n))
    return {"none": out.pop("none"), "unknown": unknown, **out}


def nameless(name: str) -> bool:
    """Whether a candidate can only win the verdict "unknown": a decoy, or parts that err alike."""
    return name in decoys() or name.endswith(ALIKE)


def ranked(evidence: dict[str, float]) -> list[str]:
    """Candidates by evidence, best first."""
    return sorted(evidence, key=lambda name: -evidence[name])


def joined(effects: Sequence[str]) -> str:
    """A candidate's name: its effects in alphabetical order joined by +."""
    return "+".join(sorted(effects))
