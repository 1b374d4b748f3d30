"""Which effects act together: a spike-and-slab posterior over sets of candidates.

Every set's evidence is Laplace's approximation about its mode, found by iteratively reweighted least
squares: groups of rows count by their expected precision under the background (`background`), parameters by
that of their Cauchy prior. `search` finds the sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import expit, gammaln

from simgap.attribution.problem import Candidate, Gap, Spectrum, cosines, spectrum
from simgap.bounded import least

# The background: what no candidate explains, by group of rows, with a variance of its own.
#
# The rows of a group (a channel in a part, in a band) have variance phi, one as a rule. Beforehand log phi is
# normal, as stated noise is a little off, and with some probability log-uniform above that: there the model
# is off for reasons of its own. By what does not matter (a tolerance) any group is as likely off as not.
# Averaged over phi, what a group's squares say grows with their logarithm only, so that no group decides
# alone (a scale mixture of normals: West, Biometrika 74, 1987).

STATED = 0.3  # prior: sd of log variance about the stated one: noise stated to 15 %
OFF = 0.1  # prior: share of groups, beforehand, in which the model is off by itself
WITHIN = 0.5  # prior: share of groups in which it is off by less than matters
NEAR, FAR = 13, 20  # numerics: points of the grid
NEAR_BY = 3.5 * STATED  # numerics: log variance between the two parts of the grid
LARGEST = 1e6  # numerics: the most that a variance exceeds the stated one


@dataclass(frozen=True)
class Background:
    """A grid of log variances and the log of their prior weights; `plain` knows no background at all."""

    log_phi: np.ndarray
    log_prior: np.ndarray

    @classmethod
    def usual(cls, stated: float = STATED, off: float = OFF) -> Background:
        """Stated noise, or the model off."""
        grid = np.concatenate(
            [np.linspace(-3, 3, NEAR) * stated, np.linspace(4 * stated, np.log(LARGEST), FAR)]
        )
        normal = -0.5 * (grid[:NEAR] / stated) ** 2
        log_prior = np.concatenate([
            np.log(1 - off) + normal - np.logaddexp.reduce(normal), np.full(FAR, np.log(off / FAR)),
        ])  # fmt: skip
        return cls(grid, log_prior)

    @classmethod
    def plain(cls) -> Background:
        """Noise exactly as stated."""
        return cls(np.zeros(1), np.zeros(1))

    def tolerant(self, most: np.ndarray) -> np.ndarray:
        """The log prior (grid, G) of groups whose variance may be so much (G,) without it mattering."""
        inside = (self.log_phi[:, None] > NEAR_BY) & (self.log_phi[:, None] <= np.log(most))
        number = inside.sum(0)
        share = np.where(number > 0, WITHIN, 0.0)
        # What is beyond any tolerance stays as likely as it was.
        usual = self.log_phi <= NEAR_BY
        taken = share * np.exp(self.log_prior[usual]).sum()
        with np.errstate(divide="ignore"):
            more = np.log(np.where(inside, taken / np.maximum(number, 1), 0.0))
        less = np.where(usual[:, None], np.log1p(-share), 0.0)
        return np.logaddexp(self.log_prior[:, None] + less, more)

    def marginal(
        self,
        energy: np.ndarray,
        count: np.ndarray,
        shift: np.ndarray | float = 0.0,
        most: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log density (G,) of groups with these squares and counts, but for (2 pi)^(-count/2), and their
        expected precisions (G,). `shift`: log variance that the groups have in any case; `most` (G,): the
        variance that does not matter."""
        log_phi = self.log_phi[:, None] + shift
        precision = np.exp(-log_phi)
        prior = self.log_prior[:, None] if most is None else self.tolerant(most)
        each = prior - 0.5 * (count * log_phi + energy * precision)
        peak = each.max(axis=0)
        weight = np.exp(each - peak)
        total = weight.sum(axis=0)
        return peak + np.log(total), (weight * precision).sum(axis=0) / total


# What the sensors' noise adds to the products of a gap's columns, to be taken off again.
#
# An effect takes a recording back, noise and all: softer pads bring more of the force's noise into a
# distance, a force read between two samples has less of it. Its columns are noisy, then, and by noise alone a
# set of effects may leave smaller squares than none (errors in variables). Each product of two columns is in
# expectation that of their noiseless parts and that of their noises; the second is known and subtracted: the
# moments' correction of Fuller (Measurement Error Models, 1987), a corrected score (Nakamura, Biometrika 77,
# 1990). It needs no residual to be free of other errors, as a likelihood of both variables does.


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
    """The noise's part (G, M, M) of the products of a spectrum's columns, the residual's own square left out.

    Of second order in deviations from where effects were linearised it is left out, too: no curvature is
    taken off, so that every mode stays a maximum.
    """
    assert gap.carried is not None
    rows, columns = gap.rows, gap.carried
    out = np.zeros((int(s.group.max()) + 1, columns.shape[2], columns.shape[2]))
    noisy = np.flatnonzero((columns != 0).any((0, 1)))
    for draw in columns:
        white, _ = cosines(rows, draw[:, noisy].astype(float), rows.shape)
        out[:, noisy[:, None], noisy] += products(white, s.group) / len(columns)
    slopes = np.ones(columns.shape[2], bool)
    slopes[[0, *(mine[0] for mine in gap.own_columns)]] = False
    out[:, slopes[:, None] & slopes] = 0.0
    out[:, 0, 0] = 0.0
    turn = gap.to_constant  # differs from one in columns of shifts alone
    shifts = [mine[0] for mine in gap.own_columns]
    turned = turn[:, shifts]
    out[:, :, shifts] = out @ turned
    out[:, shifts] = turned.T @ out
    return out


STEPS = 30  # numerics: of an iteration, at most
CLOSE = 0.02  # numerics: nats


@dataclass(frozen=True)
class Model:
    """One set of effects: its log posterior (unnormalised), and the mode of its parameters.

    `effects`: indices of candidates, ascending; `x` (K + sum k,): nuisances, then each effect's deviations
    over scale; `covariance` of x; `energy` (G,), `precision` (G,) of the groups at the mode; `at_bound`
    marks coordinates held at a bound.
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
    """Quadratic forms of a gap by group: products (G, M, M) of the spectrum's columns, counts (G,).

    `lenient`: a group is as likely as not off by what does not matter. `modes`: sets fitted so far.
    """

    gap: Gap
    spectrum: Spectrum
    background: Background
    product: np.ndarray
    count: np.ndarray
    lenient: bool = False
    modes: dict[tuple[int, ...], Model] = field(init=False, default_factory=dict)

    def triangle(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Products (G, P) of pairs of columns, twice those of two different ones."""
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
        out = np.zeros((len(self.gap.candidates), self.count.size))
        for j, c in enumerate(self.gap.candidates):
            if c.variance is not None:
                out[j] = np.bincount(self.spectrum.group, c.variance, self.count.size) / self.count
        return out

    def shift(self, effects: tuple[int, ...]) -> np.ndarray:
        """Log variance (G,) that a set's effects give to the groups."""
        return np.log1p(self.extra[list(effects)].sum(0))

    @cached_property
    def freed(self) -> np.ndarray:
        """By how much (J, G) the variance of each group may be larger where a candidate acts."""
        out = np.zeros((len(self.gap.candidates), self.count.size))
        for j, c in enumerate(self.gap.candidates):
            if c.frees is not None:
                out[j] = np.bincount(self.spectrum.group, c.frees, self.count.size) / self.count
        return out

    def marginal(
        self, effects: tuple[int, ...], energy: np.ndarray, background: Background | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log density (G,) of groups with these squares under a set of effects, and expected precisions.

        An effect frees all of its groups or none, one as likely beforehand as the other.
        """
        shift, background = self.shift(effects), background or self.background
        density, precision = background.marginal(energy, self.count, shift, self.most)
        more = self.freed[list(effects)].sum(0)
        freed = more > 0
        if freed.any():
            most = 1 + more if self.most is None else self.most + more
            own = background.marginal(energy, self.count, shift, most)
            bound, loose = float(density[freed].sum()), float(own[0][freed].sum())
            share = float(expit(loose - bound))
            precision = np.where(freed, share * own[1] + (1 - share) * precision, precision)
            both = np.logaddexp(bound, loose) - np.log(2.0)
            density = np.where(freed, both / freed.sum(), density)
        return density, precision

    @cached_property
    def most(self) -> np.ndarray | None:
        """The variance (G,) of groups that does not matter, where that is allowed for.

        A channel's part may be off by its tolerance throughout, all of it in one band.
        """
        rows, group = self.gap.rows, self.spectrum.group
        if self.gap.tolerance is None or not self.lenient:
            return None
        _, place = np.unique(rows.channel * len(rows.parts) + rows.part, return_inverse=True)
        square = np.square(self.gap.tolerance / (1.0 if rows.sd is None else rows.sd))
        whole = np.bincount(place, square)[place]
        return 1 + np.bincount(group, whole) / self.count**2

    @cached_property
    def log_odds(self) -> float:
        """Prior log odds of one effect to act."""
        number = len({c.name for c in self.gap.candidates})
        share = min(self.gap.expected / max(number, 1), 0.5)
        return float(np.log(share / (1 - share)))


def forms(gap: Gap, background: Background | None = None) -> Forms:
    """The quadratic forms that all sets of candidates share."""
    s = spectrum(gap)
    count = np.bincount(s.group, gap.told).astype(float)
    product = products(s.columns, s.group)
    if gap.carried is not None:
        product -= of_noise(gap, s)
    return Forms(gap, s, background or Background.usual(), product, count)


def channel_of(f: Forms) -> np.ndarray:
    """The channel (G,) of each group."""
    out = np.zeros(f.count.size, int)
    out[f.spectrum.group] = f.gap.rows.channel
    return out


def fitted(f: Forms, effects: tuple[int, ...]) -> Model:
    """The set's mode and evidence, the better one of two starts: all groups count alike, and as they would
    with every effect as it was linearised."""
    if effects in f.modes:
        return f.modes[effects]
    taken = quadratic_forms(f, effects)
    found = [mode(f, taken, np.ones(f.count.size))]
    if effects:
        x = np.zeros(taken.low.size)
        for j, mine in taken.blocks.items():
            c = f.gap.candidates[j]
            x[mine] = (c.at - c.neutral) / c.scale
        found.append(mode(f, taken, f.marginal(effects, taken.energy(x))[1], x))
    f.modes[effects] = max(found, key=lambda m: m.score)
    return f.modes[effects]


@dataclass(frozen=True)
class QuadraticForms:
    """The quadratic forms of one set by group: square (G,), pull (G, n) and bend of its coordinates x (n,).

    `bend`: two parts (G, .) of the products' upper triangles, those off the diagonal twice: of the nuisances
    alone, which all sets have, and what the set's own coordinates add; `pairs` (2, .): their coordinates.
    """

    effects: tuple[int, ...]
    square: np.ndarray
    pull: np.ndarray
    bend: tuple[np.ndarray, np.ndarray]
    pairs: tuple[np.ndarray, np.ndarray]
    low: np.ndarray
    high: np.ndarray
    blocks: dict[int, np.ndarray]
    shift: np.ndarray

    def energy(self, x: np.ndarray) -> np.ndarray:
        """Squares (G,) of what is left at x."""
        usual, own = self.bend
        each, known = x[self.pairs[0]] * x[self.pairs[1]], usual.shape[1]
        return np.maximum(self.square - 2 * self.pull @ x + usual @ each[:known] + own @ each[known:], 0.0)

    def weighed(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Curvature (n, n) and pull (n,) with groups of these precisions (G,) together."""
        matrix = np.zeros((self.low.size, self.low.size))
        matrix[self.pairs] = np.concatenate([precision @ part for part in self.bend])
        return (matrix + matrix.T) / 2, precision @ self.pull


def quadratic_forms(f: Forms, effects: tuple[int, ...]) -> QuadraticForms:
    """The quadratic forms of one set of effects."""
    z, own = f.spectrum.num_nuisances, f.spectrum.own
    free = np.concatenate([np.arange(1, 1 + z), *(own[j][1:] for j in effects)]).astype(int)
    constant = np.array([0, *(own[j][0] for j in effects)])
    sign = np.array([1.0, *(-1.0 for _ in effects)])
    square = np.einsum("i,gij,j->g", sign, f.product[:, constant[:, None], constant], sign)
    pull = np.einsum("i,gij->gj", sign, f.product[:, constant[:, None], free])
    (first, second), (one, other) = np.triu_indices(z), np.triu_indices(free.size)
    first, second = np.append(first, one[other >= z]), np.append(second, other[other >= z])
    known = f.of_nuisances.shape[1]
    bend = f.triangle(free[first[known:]], free[second[known:]])
    limits, blocks = _limits(f, effects, z), coordinates(f, effects)
    return QuadraticForms(
        effects, square, pull, (f.of_nuisances, bend), (first, second), *limits, blocks, f.shift(effects)
    )


def mode(
    f: Forms, taken: QuadraticForms, precision: np.ndarray, x: np.ndarray | None = None, steps: int = STEPS
) -> Model:
    """Iteratively reweighted least squares from given precisions of the groups."""
    z, size = f.spectrum.num_nuisances, taken.low.size
    x = np.zeros(size) if x is None else x
    value, prior, energy = -np.inf, np.ones(size), taken.square
    held = np.zeros(size, bool)
    for _ in range(steps):
        for mine in taken.blocks.values():
            prior[mine] = (1 + mine.size) / (1 + x[mine] @ x[mine])
        matrix, pull = taken.weighed(precision)
        matrix[np.diag_indices(size)] += prior
        x, held = least(matrix, pull, taken.low, taken.high)
        energy = taken.energy(x)
        density, precision = f.marginal(taken.effects, energy)
        last, value = value, float(density.sum()) + _log_prior(x, z, taken.blocks)
        if abs(value - last) < CLOSE:
            break
    for mine in taken.blocks.values():
        prior[mine] = (1 + mine.size) / (1 + x[mine] @ x[mine])
    matrix = taken.weighed(precision)[0] + np.diag(prior)
    loose = ~held
    covariance = np.zeros_like(matrix)
    covariance[np.ix_(loose, loose)] = np.linalg.inv(matrix[np.ix_(loose, loose)])
    score = value + _volume(matrix, loose, z) + _known(f, taken.effects)
    return Model(taken.effects, score, x, covariance, energy, precision, held)


def coordinates(f: Forms, effects: tuple[int, ...]) -> dict[int, np.ndarray]:
    """Places of each effect's parameters in a set's x, after those of the nuisances."""
    out, at = {}, f.spectrum.num_nuisances
    for j in effects:
        k = f.gap.candidates[j].at.size
        out[j] = np.arange(at, at + k)
        at += k
    return out


def screened(f: Forms, model: Model, sets: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Scores of sets after one step from where a set counts its groups, all sums over groups shared.

    They rank neighbours of the set; the leading ones are then `fitted`.
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
        found.append(_log_prior(x, z, blocks) + _volume(matrix, ~held, z) + _known(f, effects))
    energy = _energies(f, model, sets, combined)
    each = zip(sets, energy, strict=True)
    return np.array(found) + [f.marginal(effects, mine)[0].sum() for effects, mine in each]


def _energies(f: Forms, model: Model, sets: Sequence[tuple[int, ...]], combined: np.ndarray) -> np.ndarray:
    """Squares (S, G) that S neighbours of a set leave, of columns `combined` (S, M) so.

    Products of what the set has itself are taken from memory once, and those of what is new once for all
    neighbours with the same new effects.
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
    """Log volume of a mode with this curvature, but for the nuisances' (2 pi)^(z/2)."""
    volume = 0.5 * (loose.sum() - z) * np.log(2 * np.pi)
    return volume - 0.5 * float(np.linalg.slogdet(matrix[np.ix_(loose, loose)])[1])


def _known(f: Forms, effects: tuple[int, ...]) -> float:
    """What speaks for a set beforehand, and in other ways than by its rows [nats]."""
    return sum(f.gap.candidates[j].evidence for j in effects) + len(effects) * f.log_odds


def _limits(f: Forms, effects: tuple[int, ...], z: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of x."""
    chosen = [f.gap.candidates[j] for j in effects]
    low = [np.full(z, -np.inf), *((c.low - c.neutral) / c.scale for c in chosen)]
    high = [np.full(z, np.inf), *((c.high - c.neutral) / c.scale for c in chosen)]
    return np.concatenate(low), np.concatenate(high)


def _log_prior(x: np.ndarray, z: int, blocks: dict[int, np.ndarray]) -> float:
    """Log prior density of x, nuisances' (2 pi)^(-K/2) left out as it cancels."""
    out = -0.5 * float(x[:z] @ x[:z])
    for mine in blocks.values():
        k = mine.size
        if k:
            out += gammaln((1 + k) / 2) - gammaln(0.5) - 0.5 * k * np.log(np.pi)
            out -= 0.5 * (1 + k) * np.log1p(x[mine] @ x[mine])
    return float(out)


def deviations(c: Candidate, x: np.ndarray) -> np.ndarray:
    """Parameters from deviations over scale."""
    return c.neutral + c.scale * x


def squares_left(
    f: Forms, effects: tuple[int, ...], weight: np.ndarray, x: np.ndarray | None = None
) -> np.ndarray:
    """Squares (G,) that a set leaves at x, or at best, groups weighted, its variances taken off; and as one
    more entry those of the nuisances themselves, for what was measured of them is data as well."""
    taken, z = quadratic_forms(f, effects), f.spectrum.num_nuisances
    weight = weight * np.exp(-taken.shift)
    if x is None:
        prior = np.ones(taken.low.size)
        for mine in taken.blocks.values():
            prior[mine] = 1e-3
        matrix, pull = taken.weighed(weight)
        x, _ = least(matrix + np.diag(prior), pull, taken.low, taken.high)
    squares = weight * taken.energy(x)
    more = f.count * f.freed[list(effects)].sum(0)  # of the squares, so much is what they free
    return np.append(np.maximum(squares - more, np.minimum(squares, f.count)), x[:z] @ x[:z])
