"""The exact fit of a set: the point of least squares of whitened residuals, with priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from simgap.progress import say
from simgap.robots.linear import Base, Linear, base_at, numeric_at, vary
from simgap.robots.model import Composed, Point
from simgap.robots.whiten import Whitener

STEPS = 8  # numerics: evaluations of a least-squares fit


def moved_to(
    composed: Composed, linear: Linear, whiten: Whitener, point: Point, only: Sequence[str] | None = None
) -> Point:
    """The point of least squares of whitened residuals, from a start; priors as in attribution. `only`: the
    effects that are moved, all by default."""
    if only is not None and set(only) != set(point):
        held = {e: theta for e, theta in point.items() if e not in only}
        free = {e: theta for e, theta in point.items() if e in only}
        return {**point, **_moved(composed, linear, whiten, free, held)}
    return _moved(composed, linear, whiten, point, {})


def _moved(
    composed: Composed, linear: Linear, whiten: Whitener, point: Point, held: Point
) -> dict[str, Mapping[str, float]]:
    names = [(e, p) for e, theta in point.items() for p in theta]
    known = [composed.effects[e].parameters[p] for e, p in names]
    if not names:
        return dict(point)
    sd = np.array([p.sd for p in known])
    low, high = np.array([p.low for p in known]), np.array([p.high for p in known])
    nominal = np.array([p.nominal for p in known])
    loose = np.array([composed.effects[e].fitted for e, _ in names])

    def at(x: np.ndarray) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for (effect, short), value in zip(names, nominal + sd * x, strict=True):
            out.setdefault(effect, {})[short] = float(value)
        return out

    last: dict[bytes, Base] = {}  # the derivative is asked for where the residual was

    def based(x: np.ndarray) -> Base:
        if x.tobytes() not in last:
            say(f"fitting {', '.join(point)}")
            last.clear()
            last[x.tobytes()] = base_at(composed, {**held, **at(x)})
        return last[x.tobytes()]

    def residual(x: np.ndarray) -> np.ndarray:
        return np.concatenate([_white(linear, whiten, based(x)), _prior(x, loose)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        here, base = at(x), numeric_at(composed, based(x))
        columns = []
        for effect in here:
            moved = vary(composed, base, linear.starts, effect)
            size = len(composed.effects[effect].parameters)
            columns.append(np.zeros((linear.residual.size, size)) if moved is None else moved.jacobian)
        whole = np.concatenate(columns, 1) * sd
        slope = np.where(loose, 1.0, _slope(x))
        return np.concatenate([-whiten(np.where(np.isfinite(whole), whole, 0.0)), np.diag(slope)])

    order = [(e, p) for e in point for p in composed.effects[e].parameters]
    assert order == names, "a point names all parameters of its effects, in their order"
    begin = np.array([(point[e][p] - q.nominal) / q.sd for (e, p), q in zip(names, known, strict=True)])
    bounds = (low - nominal) / sd, (high - nominal) / sd
    inside = np.clip(begin, bounds[0] + 1e-6, bounds[1] - 1e-6)
    derivative: Any = jacobian
    done = least_squares(residual, inside, derivative, bounds=bounds, max_nfev=STEPS, method="trf", ftol=1e-5)
    return dict(at(np.clip(done.x, *bounds)))


def cost_at(composed: Composed, linear: Linear, whiten: Whitener, point: Point) -> float:
    """Half the squares that `moved_to` makes least, at a point [nats]."""
    white = _white(linear, whiten, base_at(composed, point))
    out = 0.5 * float(white @ white)
    for effect, theta in point.items():
        known = composed.effects[effect]
        x = np.array([(v - known.parameters[p].nominal) / known.parameters[p].sd for p, v in theta.items()])
        out += 0.5 * float(np.sum(_prior(x, np.full(x.size, known.fitted)) ** 2))
    return out


def _white(linear: Linear, whiten: Whitener, base: Base) -> np.ndarray:
    """Whitened residuals (N,) at a base, of the rows that the linear model has."""
    found = linear.rows.observed - base.rows
    # A rollout that diverged is as far off as the recording is from its mean.
    found = np.where(np.isfinite(found), found, linear.rows.observed)
    return whiten(np.where(np.isfinite(linear.residual), found, 0.0))


def _prior(x: np.ndarray, loose: np.ndarray) -> np.ndarray:
    return np.where(loose, x, np.sqrt(2 * np.log1p(x**2)))


def _slope(x: np.ndarray) -> np.ndarray:
    """Derivative of sqrt(2 log(1 + x^2)), which is sqrt(2) sign(x) near 0 (0 at 0)."""
    root = np.sqrt(2 * np.log1p(x**2))
    return np.where(root > 1e-9, 2 * x / (1 + x**2) / np.maximum(root, 1e-9), 0.0)
