"""A candidate fitted to the mean difference of real and simulated features; its evidence.

The difference has the covariance of both kinds' scatter over their numbers. Features of one channel are
correlated: a trial that starts off stays off. So their covariance has a part along the few ways in which
whole trials differ (offset, slope, size, time) and an autocorrelated rest: a mixed model (Laird & Ware,
Biometrics 38, 1982) by moments. Channels are taken one by one. Parameters have normal priors; evidence is
Laplace's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.generic.effects import (
    EFFECTS,
    Kind,
    Scene,
    channel_features,
    duration_features,
    predicted,
)
from simgap.generic.features import FAST, SLOW
from simgap.generic.locate import both_variances

STEP = 1e-3  # numerics: prior standard deviations, for derivatives by differences
EVALUATIONS = 30  # numerics: of the residual, in one descent
FURTHER = 4.0  # prior: nats, as one effect is less likely than none
FAR = 8.0  # numerics: prior standard deviations that no parameter leaves
AT_END = 0.02  # numerics: share of a range within which a descent that stays inside has run to its end
NEUTRAL = 1e-9  # numerics: a coordinate that has not moved


@dataclass(frozen=True)
class Block:
    """Features fitted together: their indices (n,) and covariances between trials (n, n) of each kind."""

    channel: int
    index: np.ndarray
    real: np.ndarray
    sim: np.ndarray

    def covariance(self, num_real: float, num_sim: float) -> np.ndarray:
        """Covariance (n, n) of a difference of means of so many trials."""
        return self.real / num_real + self.sim / num_sim


@dataclass(frozen=True)
class Slot:
    """One parameter: its effect, kind, event or subtask (-1: none) and scale to its channel's unit."""

    effect: str
    kind: Kind
    place: int
    scale: float

    @property
    def sd(self) -> float:
        """Prior standard deviation in units."""
        return self.kind.sd * self.scale


@dataclass(frozen=True)
class EnsembleFit:
    """A candidate fitted in every block to a `difference` (F,): coordinates `u`, `jacobian` (n, p) of the
    whitened residual and `raw` (n, p) of the prediction, `shift` of all features (F,), chi-squares after and
    before."""

    effects: tuple[str, ...]
    slots: tuple[tuple[Slot, ...], ...]
    u: tuple[np.ndarray, ...]
    jacobian: tuple[np.ndarray, ...]
    raw: tuple[np.ndarray, ...]
    difference: np.ndarray
    shift: np.ndarray
    square: float
    before: float

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(len(s) for s in self.slots)

    def evidence(self, temperature: float) -> float:
        """Log evidence [nats] over none, tempered; every further effect is FURTHER less likely beforehand."""
        out = 0.5 * (self.before - self.square) / temperature - FURTHER * (len(self.effects) - 1)
        for u, j in zip(self.u, self.jacobian, strict=True):
            h = j.T @ j / temperature + np.eye(u.size)
            out -= 0.5 * float(u @ u) + 0.5 * float(np.linalg.slogdet(h)[1])
        return out


def blocks(given: Scene, real: np.ndarray, sim: np.ndarray) -> list[Block]:
    """A block for every channel and one for durations."""
    layout = given.layout
    variances, out = both_variances(layout, real, sim), []
    for c in (*range(len(layout.ensembles.channels)), -1):
        index = channel_features(layout, c) if c >= 0 else duration_features(layout)
        if c < 0:
            out.append(Block(c, index, *(np.diag(v[index]) for v in variances)))
            continue
        basis = _common(given, c)
        kinds = [
            _covariance(v[:, index] - v[:, index].mean(0), basis, s[index], layout.kind[index])
            for v, s in zip((real, sim), variances, strict=True)
            if len(v) > 1
        ]
        out.append(Block(c, index, kinds[0], kinds[-1]))  # a single trial borrows the other kind's
    return out


def _common(given: Scene, channel: int) -> np.ndarray:
    """Orthonormal ways (n, q) in which whole trials differ: offset, slope, size and time of the course,
    an offset of each subtask, loudness."""
    layout, zero = given.layout, np.zeros((len(given.layout.ensembles.subtasks), 2))
    base = predicted(given, channel, {}, zero)
    where = layout.kind[channel_features(layout, channel)]
    subtask = layout.subtask[channel_features(layout, channel)]
    slowly = (where == SLOW).astype(float)
    columns = [predicted(given, channel, {k: v}, zero) - base
               for k, v in (("slope", 1.0), ("gain", 0.1), ("delay", 0.02))]  # fmt: skip
    columns = [slowly * c for c in columns]
    columns += [slowly * (subtask == k) for k in range(len(zero))] + [(where == FAST).astype(float)]
    left, size, _ = np.linalg.svd(
        np.stack([c / max(np.linalg.norm(c), 1e-12) for c in columns], 1), full_matrices=False
    )
    return left[:, size > 1e-6]


def _covariance(
    deviations: np.ndarray, basis: np.ndarray, variance: np.ndarray, kind: np.ndarray
) -> np.ndarray:
    """Covariance (n, n) between trials: along the common ways as seen, elsewhere autocorrelated.

    The covariance along the common ways is drawn to its diagonal by as many degrees of freedom as it
    has rows. What remains has the features' variances, never above `variance`, and an AR(1)
    correlation of neighbours in the slow course.
    """
    dof, q = len(deviations) - 1, basis.shape[1]
    along = deviations @ basis
    seen = along.T @ along / dof
    seen = (dof * seen + (q + 1) * np.diag(np.diag(seen))) / (dof + q + 1)
    rest = deviations - along @ basis.T
    own = np.clip((rest**2).sum(0) / dof, 0.02 * variance, variance)
    own = 0.5 * own + 0.5 * own.mean() * variance / variance.mean()
    z = rest / np.sqrt(own)
    neighbours = (kind[1:] == SLOW) & (kind[:-1] == SLOW)
    rho = float(
        (z[:, 1:] * z[:, :-1])[:, neighbours].sum() / max((z[:, :-1] ** 2)[:, neighbours].sum(), 1e-12)
    )
    rho = float(np.clip(rho, 0.0, 0.95))
    apart = np.abs(np.subtract.outer(np.arange(kind.size), np.arange(kind.size)))
    both = (kind[:, None] == SLOW) & (kind[None, :] == SLOW)
    correlation = np.where(both, rho**apart, np.eye(kind.size))
    return basis @ seen @ basis.T + correlation * np.sqrt(np.outer(own, own))


def slots(given: Scene, effects: Sequence[str], channel: int) -> tuple[Slot, ...]:
    """Parameters that the effects have in a channel, or of durations (-1)."""
    out, count = [], len(given.layout.ensembles.subtasks)
    for name in effects:
        candidate = EFFECTS[name]
        if (candidate.each == "subtask") != (channel < 0):
            continue
        places = {"channel": [-1], "event": range(1, count), "subtask": range(count)}[candidate.each]
        for kind in candidate.kinds:
            scale = 1.0
            if kind.scaled != "1":
                scale = float(given.layout.scale[channel])
            if kind.scaled == "rate":
                scale /= float(given.edges[-1])
            out += [Slot(name, kind, int(k), scale) for k in places]
    return tuple(out)


def at(given: Scene, block: Block, mine: Sequence[Slot], u: np.ndarray) -> np.ndarray:
    """Predicted features (n,) of a block at coordinates u."""
    if block.channel < 0:
        out = np.zeros(block.index.size)
        for slot, value in zip(mine, u, strict=True):
            out[slot.place] += slot.sd * value
        return out
    values, ring = {}, np.zeros((len(given.layout.ensembles.subtasks), 2))
    for slot, value in zip(mine, u, strict=True):
        if EFFECTS[slot.effect].each == "event":
            ring[slot.place, int(slot.kind.name == "cos")] = slot.sd * value
        else:
            values[slot.kind.name] = slot.sd * value
    return predicted(given, block.channel, values, ring)


def fit(
    given: Scene, parts: Sequence[Block], difference: np.ndarray, numbers: tuple[int, int],
    effects: Sequence[str], base: EnsembleFit | None = None,
) -> EnsembleFit:  # fmt: skip
    """Effects together fitted to the mean difference (F,) of `numbers` real and simulated trials.

    `base`: a fit of some of them, to start from.
    """
    effects = tuple(sorted(effects))
    found, shift, square, before = [], np.zeros(difference.size), 0.0, 0.0
    for k, block in enumerate(parts):
        mine = slots(given, effects, block.channel)
        root = np.linalg.cholesky(block.covariance(*numbers))
        known = {}
        if base is not None:
            known = {
                (s.effect, s.kind.name, s.place): v for s, v in zip(base.slots[k], base.u[k], strict=True)
            }
        u, jacobian, moved, rest = _block(given, block, root, difference[block.index], mine, known)
        found.append((mine, u, jacobian, -root @ jacobian))
        shift[block.index] = moved
        square += rest
        z = np.linalg.solve(root, difference[block.index])
        before += float(z @ z)
    mine, u, jacobian, raw = (tuple(f[j] for f in found) for j in range(4))
    return EnsembleFit(effects, mine, u, jacobian, raw, difference, shift, square, before)


def _block(given: Scene, block: Block, root: np.ndarray, difference: np.ndarray, mine: Sequence[Slot], known):
    """Least squares from every start of the effects that are not known yet; the best."""
    if not mine:
        z = np.linalg.solve(root, difference)
        return np.zeros(0), np.zeros((difference.size, 0)), np.zeros(difference.size), float(z @ z)
    zero = at(given, block, mine, np.zeros(len(mine)))
    low = np.array([max(s.kind.low, -FAR) for s in mine])
    high = np.array([min(s.kind.high, FAR) for s in mine])
    fresh = [s for s in mine if (s.effect, s.kind.name, s.place) not in known]
    count = max((len(s.kind.starts) for s in fresh), default=1)
    results = []
    for j in range(count):
        u = np.array([
            known.get((s.effect, s.kind.name, s.place), s.kind.starts[min(j, len(s.kind.starts) - 1)])
            for s in mine
        ])  # fmt: skip
        results.append(_descend(given, block, root, difference, mine, zero, u, low, high))
    u, z, jacobian = min(results, key=lambda r: float(r[1] @ r[1] + r[0] @ r[0]))
    out = {x.effect for x, v, end in zip(mine, u, np.where(u < 0, low, high), strict=True) if _ends(v, end)}
    if out:
        kept = np.array([x.effect not in out for x in mine])
        rest = [x for x in mine if x.effect not in out]
        base = {(x.effect, x.kind.name, x.place): v for x, v in zip(rest, u[kept], strict=True)}
        part, slopes, shift, square = _block(given, block, root, difference, rest, base)
        u, jacobian = np.zeros(len(mine)), np.zeros((difference.size, len(mine)))
        u[kept], jacobian[:, kept] = part, slopes
        return u, jacobian, shift, square
    return u, jacobian, at(given, block, mine, u) - zero, float(z @ z)


def _ends(value: float, end: float) -> bool:
    """Whether a coordinate ran to the end of its range: a filter of half a second stands for a course that
    differs in another way, and is none of this channel's."""
    return bool(abs(value) > NEUTRAL and abs(value - end) < AT_END * abs(end))


def _descend(given, block, root, difference, mine, zero, u, low, high):
    """Least squares within bounds, priors as further residuals; u, whitened residual and its derivative."""
    from scipy.optimize import least_squares  # slow to import

    known: dict[bytes, np.ndarray] = {}  # residual and derivative are asked for at the same place

    def residual(v: np.ndarray) -> np.ndarray:
        if v.tobytes() not in known:
            known[v.tobytes()] = np.linalg.solve(root, difference - (at(given, block, mine, v) - zero))
        return known[v.tobytes()]

    def slopes(v: np.ndarray) -> np.ndarray:
        return np.stack([(residual(v + step) - residual(v)) / STEP for step in STEP * np.eye(v.size)], 1)

    found = least_squares(
        lambda v: np.concatenate([residual(v), v]), np.clip(u, low, high),
        jac=lambda v: np.concatenate([slopes(v), np.eye(v.size)]),  # type: ignore[arg-type]
        bounds=(low, high), x_scale="jac", ftol=1e-4, max_nfev=EVALUATIONS,
    )  # fmt: skip
    return found.x, residual(found.x), slopes(found.x)
