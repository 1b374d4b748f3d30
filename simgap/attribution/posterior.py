"""Which effects act together: a spike-and-slab posterior over sets of candidates.

The evidence of a set is Laplace's approximation about its mode, found by iteratively reweighted least
squares: groups of rows are weighted by their expected precision under the background, parameters by that of
their Cauchy prior. `simgap.attribution.search` finds the sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import expit, gammaln

from simgap.attribution.problem import Gap, Spectrum, spectrum
from simgap.bounded import least

# The background: what no candidate explains, a variance of its own for each group of rows.
#
# The rows of a group (a channel in a part, in a band) have variance phi, usually one. The prior of log phi is
# normal, as stated noise is a little off, and in some groups log-uniform above that: there the model is off
# for reasons of its own. Averaged over phi, the log density of a group grows only with the logarithm of its
# squares, so that no group decides alone (a scale mixture of normals: West, Biometrika 74, 1987). In how many
# groups the model is off is unknown: a set of effects that leaves none of them off has that for it (Scott &
# Berger, Ann. Stat. 38, 2010).

STATED = 0.3  # prior: sd of log variance about the stated one: noise is stated to 15 %
# prior: shares of groups in which the model is off, equally likely: a gap may be confined to one place
OFF = (0.002, 0.01, 0.03, 0.1)
WITHIN = 0.5  # prior: share of groups that are off, of those that an effect frees
NEAR, FAR = 13, 20  # numerics: points of the grid
WIDEST = 3.0  # numerics: standard deviations that its first part spans to either side
NEAR_BY = 3.5 * STATED  # numerics: log variance that separates the two parts of the grid
LARGEST = 1e6  # numerics: largest variance over the stated one


@dataclass(frozen=True)
class Background:
    """A grid of log variances (grid,), their prior weights (grid,) near the stated ones and where the model
    is off, and the shares `off` (S,) of groups in which it may be.
    """

    log_phi: np.ndarray
    near: np.ndarray
    far: np.ndarray
    off: np.ndarray

    @classmethod
    def usual(cls, *off: float) -> Background:
        """Noise about as stated, or the model off, in shares OFF of the groups unless others are given."""
        grid = np.concatenate(
            [np.linspace(-WIDEST, WIDEST, NEAR) * STATED, np.linspace(4 * STATED, np.log(LARGEST), FAR)]
        )
        far = np.arange(grid.size) >= NEAR
        normal = np.where(far, 0.0, np.exp(-0.5 * (grid / STATED) ** 2))
        return cls(grid, normal / normal.sum(), far / FAR, np.array(off or OFF))

    def tolerant(self, most: np.ndarray) -> np.ndarray:
        """Weights (grid, G) near the stated variance if it may as well be as large as `most` (G,)."""
        inside = (self.log_phi[:, None] > NEAR_BY) & (self.log_phi[:, None] <= np.log(most))
        number = inside.sum(0)
        share = np.where(number > 0, WITHIN, 0.0)
        return (1 - share) * self.near[:, None] + share * inside / np.maximum(number, 1)

    def marginal(
        self,
        energy: np.ndarray,
        count: np.ndarray,
        shift: np.ndarray | float = 0.0,
        most: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Integrate out the variances of groups.

        Args:
            energy: Sum of squares (G,) of each group.
            count: Number of rows (G,).
            shift: Log variance that the groups have in any case.
            most: Variance (G,) that is as likely as the stated one; None for the usual prior.

        Returns:
            Log density (S, G) up to (2 pi)^(-count/2), and expected precision (S, G), for each of the shares.
        """
        log_phi = self.log_phi[:, None] + shift
        precision = np.exp(-log_phi)
        # What a random effect scatters less than usual, as rounding does a force of zero, is no better for
        # being quieter yet.
        energy = np.maximum(energy, count * np.expm1(shift) * np.exp(-WIDEST * STATED))
        each = -0.5 * (count * log_phi + energy * precision)
        peak = each.max(axis=0)
        chance = np.exp(each - peak)
        near = chance * (self.near[:, None] if most is None else self.tolerant(most))
        far, off = chance * self.far[:, None], self.off[:, None]
        total = (1 - off) * near.sum(0) + off * far.sum(0)
        expected = (1 - off) * (near * precision).sum(0) + off * (far * precision).sum(0)
        return peak + np.log(total), expected / total


# What sensor noise adds to the products of a gap's columns, to be subtracted again.
#
# An effect corrects a recording, noise included: softer pads bring more of the force's noise into a distance,
# a force read between two samples has less of it. Columns of effects are therefore noisy, and by noise alone
# a set of effects may leave smaller squares than none (errors in variables). The expectation of a product of
# two columns is that of their noiseless parts plus that of their noises; the second is known and subtracted:
# the moment correction of Fuller (Measurement Error Models, 1987), a corrected score (Nakamura, Biometrika
# 77, 1990). Unlike a likelihood of both variables it does not need residuals free of other errors.


def products(columns: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Products (G, M, M) of columns (n, M) by group (n,)."""
    size = int(group.max()) + 1
    out = np.zeros((size, columns.shape[1], columns.shape[1]))
    order = np.argsort(group, kind="stable")
    ends = np.cumsum(np.bincount(group, minlength=size))[:-1]
    for g, mine in enumerate(np.split(order, ends)):
        out[g] = columns[mine].T @ columns[mine]
    return out


def of_noise(gap: Gap, s: Spectrum) -> np.ndarray:
    """Part (G, M, M) of the products of a spectrum's columns that is due to noise.

    The square of the residual is left out, and so are terms of second order in deviations from the point of
    linearisation: without a change of curvature every mode stays a maximum.
    """
    assert gap.carried is not None
    number = gap.carried.shape[2]
    out = np.zeros((int(s.group.max()) + 1, number, number))
    noisy = np.flatnonzero((gap.carried != 0).any((0, 1)))
    for draw in gap.carried:
        out[:, noisy[:, None], noisy] += products(draw[:, noisy].astype(float), s.group)
    slopes = np.ones(number, bool)
    slopes[[0, *(mine[0] for mine in gap.own_columns)]] = False
    out[:, slopes[:, None] & slopes] = 0.0
    out[:, 0, 0] = 0.0
    turn = gap.to_constant  # the identity except in columns of shifts
    shifts = [mine[0] for mine in gap.own_columns]
    turned = turn[:, shifts]
    out[:, :, shifts] = out @ turned
    out[:, shifts] = turned.T @ out
    return out


STEPS = 30  # numerics: most iterations
CLOSE = 0.02  # numerics: nats
HALVINGS = 12  # numerics: of a step that leads down


@dataclass(frozen=True)
class Model:
    """A fitted set of effects.

    Attributes:
        effects: Indices of its candidates, ascending.
        score: Unnormalised log posterior [nats].
        x: Mode (K + sum k,) of the nuisances, then of each effect's scaled deviations.
        covariance: Of x.
        energy: Sum of squares (G,) of each group at the mode.
        precision: Expected precision (G,) of each group.
        at_bound: Which coordinates are held at a bound.
    """

    effects: tuple[int, ...]
    score: float
    x: np.ndarray
    covariance: np.ndarray
    energy: np.ndarray
    precision: np.ndarray
    at_bound: np.ndarray


@dataclass(frozen=True)
class Forms:
    """Quadratic forms of a gap by group, shared by all sets of candidates.

    Attributes:
        gap: The gap.
        spectrum: Its cosine transform.
        background: Prior of the groups' variances.
        product: Products (G, M, M) of the spectrum's columns.
        count: Expected squares (G,) if nothing acts.
        modes: Sets fitted so far.
    """

    gap: Gap
    spectrum: Spectrum
    background: Background
    product: np.ndarray
    count: np.ndarray
    modes: dict[tuple[int, ...], Model] = field(init=False, default_factory=dict)

    def triangle(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Products (G, P) of pairs of columns, doubled for pairs of different columns."""
        taken = np.take(
            self.product.reshape(self.count.size, -1), first * self.product.shape[1] + second, axis=1
        )
        return taken * np.where(first == second, 1.0, 2.0)

    @cached_property
    def of_nuisances(self) -> np.ndarray:
        """Products (G, P) of all pairs of nuisances."""
        first, second = np.triu_indices(self.spectrum.num_nuisances)
        return self.triangle(1 + first, 1 + second)

    @cached_property
    def extra(self) -> np.ndarray:
        """Mean variance (J, G) that each candidate adds to a group."""
        return self._means([c.variance for c in self.gap.candidates])

    def shift(self, effects: tuple[int, ...]) -> np.ndarray:
        """Log variance (G,) that a set's effects give to the groups."""
        return np.log1p(self.extra[list(effects)].sum(0))

    @cached_property
    def freed(self) -> np.ndarray:
        """Most additional mean variance (J, G) of each group where a candidate acts."""
        return self._means([c.frees for c in self.gap.candidates])

    def _means(self, values: Sequence[np.ndarray | None]) -> np.ndarray:
        """Means (J, G) of each candidate's values (n,) by group; 0 where it has none."""
        out = np.zeros((len(values), self.count.size))
        for j, value in enumerate(values):
            if value is not None:
                out[j] = np.bincount(self.spectrum.group, value, self.count.size) / self.count
        return out

    def marginal(self, effects: tuple[int, ...], energy: np.ndarray) -> tuple[float, np.ndarray]:
        """Log density of all groups with these sums of squares (G,), and their expected precisions (G,).

        An effect frees all of its groups or none, with equal prior probability.
        """
        shift, background = self.shift(effects), self.background
        density, precision = background.marginal(energy, self.count, shift)
        total = density.sum(1)
        more = self.freed[list(effects)].sum(0)
        freed = more > 0
        if freed.any():
            own = background.marginal(energy[freed], self.count[freed], shift[freed], 1 + more[freed])
            bound, loose = density[:, freed].sum(1), own[0].sum(1)
            share = expit(loose - bound)[:, None]
            precision[:, freed] = share * own[1] + (1 - share) * precision[:, freed]
            total += np.logaddexp(bound, loose) - np.log(2.0) - bound
        whole = float(np.logaddexp.reduce(total))
        return whole - float(np.log(total.size)), np.exp(total - whole) @ precision

    @cached_property
    def log_odds(self) -> float:
        """Prior log odds of each effect to act: one is expected to."""
        return -float(np.log(max(len({c.name for c in self.gap.candidates}) - 1, 1)))


def forms(gap: Gap, background: Background | None = None) -> Forms:
    """Compute the quadratic forms that all sets of candidates share."""
    s = spectrum(gap)
    count = np.bincount(s.group, gap.mean_square).astype(float)
    product = products(s.columns, s.group)
    if gap.carried is not None:
        product -= of_noise(gap, s)
    return Forms(gap, s, background or Background.usual(), product, count)


def channel_of(f: Forms) -> np.ndarray:
    """Channel (G,) of each group."""
    out = np.zeros(f.count.size, int)
    out[f.spectrum.group] = f.gap.rows.channel
    return out


def fitted(f: Forms, effects: tuple[int, ...]) -> Model:
    """Find a set's mode and evidence, with groups first weighted alike."""
    if effects not in f.modes:
        f.modes[effects] = mode(f, quadratic_forms(f, effects), np.ones(f.count.size))
    return f.modes[effects]


@dataclass(frozen=True)
class QuadraticForms:
    """The quadratic forms of one set by group, in its n coordinates.

    Attributes:
        effects: The set.
        square: Sum of squares (G,) at zero.
        pull: Half the negative gradient (G, n).
        curvature: Upper triangles of the curvature in two parts (G, .), that of the nuisances, which all sets
            share, and the rest; off-diagonal entries are doubled.
        pairs: Coordinates (2, .) of each entry of the triangles.
        low, high: Bounds (n,).
        blocks: Coordinates of each effect's parameters.
        shift: Log variance (G,) that the effects give to the groups.
    """

    effects: tuple[int, ...]
    square: np.ndarray
    pull: np.ndarray
    curvature: tuple[np.ndarray, np.ndarray]
    pairs: tuple[np.ndarray, np.ndarray]
    low: np.ndarray
    high: np.ndarray
    blocks: dict[int, np.ndarray]
    shift: np.ndarray

    def energy(self, x: np.ndarray) -> np.ndarray:
        """Sums of squares (G,) of the residual at x."""
        shared, own = self.curvature
        each, z = x[self.pairs[0]] * x[self.pairs[1]], shared.shape[1]
        return np.maximum(self.square - 2 * self.pull @ x + shared @ each[:z] + own @ each[z:], 0.0)

    def weighed(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Curvature (n, n) and pull (n,) of all groups, weighted by these precisions (G,)."""
        matrix = np.zeros((self.low.size, self.low.size))
        matrix[self.pairs] = np.concatenate([precision @ part for part in self.curvature])
        return (matrix + matrix.T) / 2, precision @ self.pull


def quadratic_forms(f: Forms, effects: tuple[int, ...]) -> QuadraticForms:
    """Assemble the quadratic forms of one set of effects."""
    z, own = f.spectrum.num_nuisances, f.spectrum.own
    free = np.concatenate([np.arange(1, 1 + z), *(own[j][1:] for j in effects)]).astype(int)
    constant = np.array([0, *(own[j][0] for j in effects)])
    sign = np.array([1.0, *(-1.0 for _ in effects)])
    square = np.einsum("i,gij,j->g", sign, f.product[:, constant[:, None], constant], sign)
    pull = np.einsum("i,gij->gj", sign, f.product[:, constant[:, None], free])
    (first, second), (one, other) = np.triu_indices(z), np.triu_indices(free.size)
    first, second = np.append(first, one[other >= z]), np.append(second, other[other >= z])
    shared = f.of_nuisances.shape[1]
    curvature = f.triangle(free[first[shared:]], free[second[shared:]])
    limits, blocks = _limits(f, effects, z), coordinates(f, effects)
    return QuadraticForms(
        effects, square, pull, (f.of_nuisances, curvature), (first, second), *limits, blocks, f.shift(effects)
    )


def mode(f: Forms, taken: QuadraticForms, precision: np.ndarray, steps: int = STEPS) -> Model:
    """Find the mode of a set by iteratively reweighted least squares.

    Args:
        f: Quadratic forms of the gap.
        taken: Those of the set.
        precision: Precisions (G,) of the groups to start from.
        steps: Most iterations.
    """
    z, size = f.spectrum.num_nuisances, taken.low.size
    x, value, prior, energy = np.zeros(size), -np.inf, np.ones(size), taken.square
    held = np.zeros(size, bool)
    for _ in range(steps):
        for mine in taken.blocks.values():
            prior[mine] = (1 + mine.size) / (1 + x[mine] @ x[mine])
        matrix, pull = taken.weighed(precision)
        matrix[np.diag_indices(size)] += prior
        last, before, (x, held) = value, x, least(matrix, pull, taken.low, taken.high)
        # Without what noise adds, squares of a group may fall below zero far away, and a step lead nowhere.
        for _ in range(HALVINGS):
            energy = taken.energy(x)
            density, precision = f.marginal(taken.effects, energy)
            value = density + _log_prior(x, z, taken.blocks)
            if value > last - CLOSE:
                break
            x = (before + x) / 2
        if value - last < CLOSE:
            break
    held &= (x <= taken.low) | (x >= taken.high)
    for mine in taken.blocks.values():
        prior[mine] = (1 + mine.size) / (1 + x[mine] @ x[mine])
    matrix = taken.weighed(precision)[0] + np.diag(prior)
    loose = ~held
    covariance = np.zeros_like(matrix)
    covariance[np.ix_(loose, loose)] = np.linalg.inv(matrix[np.ix_(loose, loose)])
    score = value + _volume(matrix, loose, z) + _log_prior_odds(f, taken.effects)
    return Model(taken.effects, score, x, covariance, energy, precision, held)


def coordinates(f: Forms, effects: tuple[int, ...]) -> dict[int, np.ndarray]:
    """Indices of each effect's parameters in a set's x, after those of the nuisances."""
    out, at = {}, f.spectrum.num_nuisances
    for j in effects:
        k = f.gap.candidates[j].at.size
        out[j] = np.arange(at, at + k)
        at += k
    return out


def screened(f: Forms, model: Model, sets: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Scores of sets after one step, with groups weighted as in a fitted set.

    Sums over groups are shared. The scores rank the neighbours of that set; the leading ones are then
    `fitted`.
    """
    z, (groups, size) = f.spectrum.num_nuisances, f.product.shape[:2]
    summed = (model.precision @ f.product.reshape(groups, -1)).reshape(size, size)
    combined, found = np.zeros((len(sets), size)), []
    for k, effects in enumerate(sets):
        own = [f.spectrum.own[j] for j in effects]
        free = np.concatenate([np.arange(1, 1 + z), *(mine[1:] for mine in own)]).astype(int)
        combined[k, [0, *(mine[0] for mine in own)]] = 1.0, *(-1.0 for _ in own)
        blocks, (low, high) = coordinates(f, effects), _limits(f, effects, z)
        prior = np.ones(free.size)
        for mine in blocks.values():
            prior[mine] = 1 + mine.size
        matrix = summed[np.ix_(free, free)] + np.diag(prior)
        x, held = least(matrix, summed[free] @ combined[k], low, high)
        combined[k, free] = -x
        for mine in blocks.values():
            matrix[mine, mine] += (1 + mine.size) / (1 + x[mine] @ x[mine]) - prior[mine]
        found.append(_log_prior(x, z, blocks) + _volume(matrix, ~held, z) + _log_prior_odds(f, effects))
    energy = _energies(f, model, sets, combined)
    each = zip(sets, energy, strict=True)
    return np.array(found) + [f.marginal(effects, mine)[0] for effects, mine in each]


def _energies(f: Forms, model: Model, sets: Sequence[tuple[int, ...]], combined: np.ndarray) -> np.ndarray:
    """Sums of squares (S, G) by group of S neighbours of a set, at coefficients `combined` (S, M) of the
    columns.

    Products of the set's own columns are read once, and those of new effects once for all neighbours that
    have the same ones.
    """
    base = np.concatenate(
        [np.arange(1 + f.spectrum.num_nuisances), *(f.spectrum.own[j] for j in model.effects)]
    )
    first, second = np.triu_indices(base.size)
    at = combined[:, base.astype(int)]
    out = (at[:, first] * at[:, second]) @ f.triangle(base[first], base[second]).T
    alike: dict[tuple[int, ...], list[int]] = {}
    for k, effects in enumerate(sets):
        alike.setdefault(tuple(j for j in effects if j not in model.effects), []).append(k)
    for added, mine in alike.items():
        if added:
            new = np.concatenate([f.spectrum.own[j] for j in added])
            old, more = at[mine], combined[np.array(mine)[:, None], new]
            for ours, product in ((2 * old, f.product[:, base[:, None], new]),
                                  (more, f.product[:, new[:, None], new])):  # fmt: skip
                both = (ours[:, :, None] * more[:, None, :]).reshape(len(mine), -1)
                out[mine] += both @ product.reshape(f.count.size, -1).T
    return np.maximum(out, 0.0)


def _volume(matrix: np.ndarray, loose: np.ndarray, z: int) -> float:
    """Log volume of a mode with this curvature, up to (2 pi)^(z/2) of the nuisances."""
    volume = 0.5 * (loose.sum() - z) * np.log(2 * np.pi)
    return volume - 0.5 * float(np.linalg.slogdet(matrix[np.ix_(loose, loose)])[1])


def _log_prior_odds(f: Forms, effects: tuple[int, ...]) -> float:
    """Prior log odds of a set and its evidence from other sources [nats]."""
    return sum(f.gap.candidates[j].evidence for j in effects) + len(effects) * f.log_odds


def _limits(f: Forms, effects: tuple[int, ...], z: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of x."""
    chosen = [f.gap.candidates[j] for j in effects]
    low = [np.full(z, -np.inf), *((c.low - c.neutral) / c.scale for c in chosen)]
    high = [np.full(z, np.inf), *((c.high - c.neutral) / c.scale for c in chosen)]
    return np.concatenate(low), np.concatenate(high)


def _log_prior(x: np.ndarray, z: int, blocks: dict[int, np.ndarray]) -> float:
    """Log prior density of x, up to the nuisances' (2 pi)^(-K/2), which cancels."""
    out = -0.5 * float(x[:z] @ x[:z])
    for mine in blocks.values():
        k = mine.size
        if k:
            out += gammaln((1 + k) / 2) - gammaln(0.5) - 0.5 * k * np.log(np.pi)
            out -= 0.5 * (1 + k) * np.log1p(x[mine] @ x[mine])
    return float(out)


def squares_left(
    f: Forms, effects: tuple[int, ...], weight: np.ndarray, x: np.ndarray | None = None
) -> np.ndarray:
    """Sums of squares (G + 1,) that a set leaves, in excess of its own variances.

    The last entry is the square of the nuisances: what was measured of them is data as well.

    Args:
        f: Quadratic forms of the gap.
        effects: The set.
        weight: Weight (G,) of each group.
        x: Coordinates; the best ones for these weights if None.
    """
    taken, z = quadratic_forms(f, effects), f.spectrum.num_nuisances
    weight = weight * np.exp(-taken.shift)
    if x is None:
        prior = np.ones(taken.low.size)
        for mine in taken.blocks.values():
            prior[mine] = 1e-3
        matrix, pull = taken.weighed(weight)
        x, _ = least(matrix + np.diag(prior), pull, taken.low, taken.high)
    squares = weight * taken.energy(x)
    more = f.count * f.freed[list(effects)].sum(0)  # the squares that they free
    return np.append(np.maximum(squares - more, np.minimum(squares, f.count)), x[:z] @ x[:z])
