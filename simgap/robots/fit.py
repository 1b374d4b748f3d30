"""The exact fit of a set of effects: least squares of whitened residuals, with priors and within bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from simgap.bounded import least
from simgap.progress import say
from simgap.robot_effects.base import RobotEffect
from simgap.robots.linear import STEP, Base, Linear, base_at, vary
from simgap.robots.model import Composed, Point

Whiten = Callable[[np.ndarray], np.ndarray]  # rows (N,) or columns (N, k)
STEPS = 8  # numerics: of a least-squares fit, at most
HALVINGS = 5  # numerics: most halvings of a start, and shorter trials of a step
FLAT = 1e-12  # numerics: of the usual curvature, so that flat directions have a minimum
SHORTEN, SHORTER = 0.1, 10.0  # numerics: damping after a step that was too long, and its growth
CLOSE = 0.05  # numerics: nats that a step must gain for a fit to go on
WIDE = 3.0  # numerics: posterior standard deviations of a finite difference
FINEST = 1e-4  # numerics: usual sizes of the smallest one


Cost = Callable[[np.ndarray], float]  # of coordinates x (n,) [nats]
Local = tuple[np.ndarray, np.ndarray]  # its curvature (n, n) and minus its gradient (n,) there


def minimise(
    cost: Cost,
    local: Callable[[np.ndarray], Local],
    x: np.ndarray,
    low: np.ndarray | float = -np.inf,
    high: np.ndarray | float = np.inf,
    steps: int = STEPS,
    far: float = np.inf,
) -> np.ndarray:
    """Minimise a cost within bounds.

    By steps of Levenberg and Marquardt (J. SIAM 11, 1963), each the minimum of the local quadratic within
    bounds.

    Args:
        cost: The cost of coordinates x (n,) [nats]; infinite where it is not known.
        local: Its curvature (n, n) and minus its gradient (n,) at x.
        x: Where to begin (n,).
        low, high: Bounds (n,).
        steps: Most steps.
        far: Longest step of a coordinate.
    """
    now, damping = cost(x), 0.0
    for _ in range(steps if x.size and np.isfinite(now) else 0):
        bend, pull = local(x)
        usual = np.diag(np.maximum(np.diag(bend), 1.0))
        # Relative to x, so that a coordinate at a bound stays exactly there.
        box = np.maximum(low - x, -far), np.minimum(high - x, far)
        for _ in range(HALVINGS):
            move, _ = least(bend + (damping + FLAT) * usual, pull, *box)
            there = cost(x + move)
            if there < now:
                break
            damping = max(SHORTER * damping, SHORTEN)
        else:
            break
        x, gained, now = x + move, now - there, there
        damping = damping / SHORTER if damping > SHORTEN else 0.0
        if gained < CLOSE * (1 + CLOSE * now):
            break
    return x


def fit_effects(
    composed: Composed,
    linear: Linear,
    whiten: Whiten,
    point: Point,
    only: Sequence[str] | None = None,
    steps: int = STEPS,
) -> Point:
    """Fit effects to the rows.

    Args:
        composed: The model along its windows.
        linear: The gap linearised nearby, whose diverged windows are left out.
        whiten: Whitens rows.
        point: Where to begin. A start that is worse than the linearisation's point is taken back towards it
            by halves.
        only: Effects to fit; all of the point by default.
        steps: Most steps.

    Returns:
        The point of least squares, priors included as in the attribution.
    """
    free = {e: theta for e, theta in point.items() if only is None or e in only}
    held = {e: theta for e, theta in point.items() if e not in free}
    if not any(free.values()):
        return point
    squares = _Squares(composed, linear, whiten, held, free)
    x = minimise(squares.cost, squares.local, squares.start(), squares.low, squares.high, steps)
    return {**point, **squares.at(x)}


@dataclass
class _Squares:
    """Squares of whitened residuals and priors at coordinates x (n,) of the `free` effects, in usual sizes
    from nominal, with others `held`.

    `latest` keeps the last rollouts, as the derivative is wanted where the residual was; `slopes` by effect
    the squares (k,) of its last derivatives.
    """

    composed: Composed
    linear: Linear
    whiten: Whiten
    held: Point
    free: Point
    latest: dict[bytes, Base] = field(default_factory=dict)
    slopes: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        effects = self.composed.effects
        self.names = [(e, p) for e, theta in self.free.items() for p in theta]
        order = [(e, p) for e in self.free for p in effects[e].parameters]
        assert order == self.names, "a point names all parameters of its effects, in their order"
        known = [effects[e].parameters[p] for e, p in self.names]
        self.sd, self.nominal = np.array([p.sd for p in known]), np.array([p.nominal for p in known])
        self.low = (np.array([p.low for p in known]) - self.nominal) / self.sd
        self.high = (np.array([p.high for p in known]) - self.nominal) / self.sd
        self.tails = np.array([_tails(effects[e]) for e, _ in self.names])
        for effect in self.free:
            if effect in self.linear.moved:
                self._learn(effect, self.whiten(np.nan_to_num(self.linear.moved[effect].jacobian)))

    def at(self, x: np.ndarray) -> dict[str, Mapping[str, float]]:
        """The free effects' values."""
        out: dict[str, dict[str, float]] = {}
        for (effect, short), value in zip(self.names, self.nominal + self.sd * x, strict=True):
            out.setdefault(effect, {})[short] = float(value)
        return dict(out)

    def start(self) -> np.ndarray:
        """Where to begin: the point, halved towards the linearisation's while it is worse than that."""
        neutral = {e: self.composed.effects[e].neutral() for e in self.free}
        both = self.linear.point, self.free
        values = np.array([[{**neutral[e], **p.get(e, {})}[n] for e, n in self.names] for p in both])
        here, x = np.clip((values - self.nominal) / self.sd, self.low, self.high)
        if np.array_equal(here, x):
            return x
        cost = self.cost(here)
        for _ in range(HALVINGS):
            if self.cost(x) <= cost:
                return x
            x = 0.5 * (here + x)
        return here

    def base(self, x: np.ndarray) -> Base:
        """The rollouts."""
        if x.tobytes() not in self.latest:
            say(f"fitting {', '.join(self.free)}")
            self.latest.clear()
            self.latest[x.tobytes()] = base_at(self.composed, {**self.held, **self.at(x)})
        return self.latest[x.tobytes()]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Whitened residuals and priors; infinite where a window diverges that the linearisation has."""
        mine = np.isfinite(self.linear.residual)
        found = np.where(mine, self.linear.target - self.base(x).rows, 0.0)
        white = self.whiten(found) if np.isfinite(found).all() else np.full(found.size, np.inf)
        return np.concatenate([white, _prior(x, self.tails)])

    def cost(self, x: np.ndarray) -> float:
        """Half the squares [nats]."""
        return 0.5 * float(np.sum(self.residual(x) ** 2))

    def local(self, x: np.ndarray) -> Local:
        """Curvature and minus the gradient of the cost."""
        jacobian, left = self.jacobian(x), self.residual(x)
        return jacobian.T @ jacobian, -jacobian.T @ left

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of `residual` by x."""
        base, columns = self.base(x), []
        for effect in self.free:
            step = self._step(effect)
            moved = vary(self.composed, base, effect, step=step, shifted=False)
            size = len(self.composed.effects[effect].parameters)
            white = np.zeros((self.linear.residual.size, size))
            if moved is not None:
                white = self.whiten(np.nan_to_num(moved.jacobian))
                self._learn(effect, white)
            columns.append(white)
        slope = _slope(x, self.tails)
        return np.concatenate([-np.concatenate(columns, 1) * self.sd, np.diag(slope)])

    def _learn(self, effect: str, white: np.ndarray) -> None:
        mine = np.array([e == effect for e, _ in self.names])
        self.slopes[effect] = np.sum((white * self.sd[mine]) ** 2, 0)

    def _step(self, effect: str) -> np.ndarray | None:
        """Finite differences (k,) in usual sizes, as wide as the parameters are uncertain and no wider: what
        curves or kinks farther away is not the slope that a fit needs."""
        if effect not in self.slopes:
            return None
        return np.clip(WIDE / np.sqrt(1 + self.slopes[effect]), FINEST, STEP)


def prior_cost(composed: Composed, point: Point) -> float:
    """Minus the log prior density of a point, without constants [nats]."""
    out = 0.0
    for effect, theta in point.items():
        known = composed.effects[effect]
        x = np.array([known.parameters[p].coordinate(v) for p, v in theta.items()])
        out += 0.5 * float(np.sum(_prior(x, np.full(x.size, _tails(known))) ** 2))
    return out


def _tails(effect: RobotEffect) -> float:
    """The scale of an effect's heavy-tailed prior: how many of its usual sizes its `sd` is; 0 of a normal
    prior."""
    return effect.widened if effect.widened else float(not effect.fitted)


def _prior(x: np.ndarray, tails: np.ndarray) -> np.ndarray:
    """Roots (n,) of the priors: half their squares are minus the log densities, normal (`tails` 0) or log(1 +
    (tails x)^2)."""
    return np.where(tails > 0, np.sign(x) * np.sqrt(2 * np.log1p((tails * x) ** 2)), x)


def _slope(x: np.ndarray, tails: np.ndarray) -> np.ndarray:
    """The derivative of `_prior`; that of sign(y) sqrt(2 log(1 + y^2)) is sqrt(2) at 0."""
    y = tails * x
    root = np.sqrt(2 * np.log1p(y**2))
    heavy = np.where(root > 1e-6, 2 * np.abs(y) / (1 + y**2) / np.maximum(root, 1e-6), np.sqrt(2.0))
    return np.where(tails > 0, tails * heavy, 1.0)
