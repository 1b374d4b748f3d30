"""The input of an attribution: whitened residuals, nuisances, and candidate effects about their best fits.

    residual = nuisance @ z + sum over acting effects shift_j(theta_j) + background + noise

Every row is divided by its noise's standard deviation. An effect is affine about `at`, where it was
linearised: shift_j(theta) = shift + jacobian @ (theta - at).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct

MODELLED = 0.1  # prior: share by which the form of a modelled effect is off from part to part
BANDS = (0.0, 1.0, 5.0)  # chosen: Hz; lower edges of the bands that are distinguished


@dataclass(frozen=True)
class Rows:
    """What each of n residuals is: indices of its trial, channel and part, and its time [s].

    A part is a subtask, or any stretch of a trial. Rows of one cell (a channel in a part of a trial) are in
    the order of time. `bands` [Hz]: lower edges of the frequency bands that are distinguished. `sd` (n,): the
    noise's in the cosine coefficients of the cells, one where it is not given; `shape` (n,): what of it white
    noise of the sensors has by itself, their level and colour left out.
    """

    trial: Int[np.ndarray, " n"]
    channel: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    trials: tuple[str, ...]
    channels: tuple[str, ...]
    parts: tuple[str, ...]
    bands: tuple[float, ...] = BANDS
    sd: np.ndarray | None = None
    shape: np.ndarray | None = None

    def taken(self, chosen: np.ndarray) -> Rows:
        """The rows of a mask (n,) or of indices; names stay."""
        return Rows(self.trial[chosen], self.channel[chosen], self.part[chosen], self.time[chosen],
                    self.trials, self.channels, self.parts, self.bands,
                    None if self.sd is None else self.sd[chosen],
                    None if self.shape is None else self.shape[chosen])  # fmt: skip

    @property
    def cell(self) -> Int[np.ndarray, " n"]:
        """One number for each trial, channel and part."""
        return (self.trial * len(self.channels) + self.channel) * len(self.parts) + self.part


@dataclass(frozen=True)
class Candidate:
    """One effect with k `parameters`; it changes nothing at `neutral`, and was linearised at `at`.

    `scale`: the usual size of each deviation from neutral. The prior of all k together is a multivariate
    Cauchy distribution of that scale, so that gross faults stay possible (Gelman et al., Ann. Appl. Stat. 2,
    2008). `shift` (n,): by how much the effect at `at` shifts the residual, `jacobian` (n, k) its derivatives
    there. `variance` (n,) is what it adds to each row's variance instead, at `at`; `evidence` [nats] what
    else speaks for it. `form`: by
    which share the effect's own form is usually off from one part of a recording to another. `hidden`:
    parameters that may be others in every part, as phases of an oscillation are. `size` (k,): what a share of
    a parameter is a share of; its deviation from neutral where that is not given, or not finite.
    `frees` (n,): by how much, at most, the variance of cosine coefficients of cells may be larger
    where it acts, in units of the noise's.
    """

    name: str
    parameters: tuple[str, ...]
    at: Float[np.ndarray, " k"]
    neutral: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " k"]
    shift: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]
    variance: Float[np.ndarray, " n"] | None = None
    evidence: float = 0.0
    form: float = MODELLED
    hidden: tuple[str, ...] = ()
    size: Float[np.ndarray, " k"] | None = None
    frees: np.ndarray | None = None

    def taken(self, rows: np.ndarray) -> Candidate:
        """The candidate on some rows."""
        variance = None if self.variance is None else self.variance[rows]
        return Candidate(self.name, self.parameters, self.at, self.neutral, self.scale, self.shift[rows],
                         self.jacobian[rows], self.low, self.high, variance, self.evidence,
                         self.form, self.hidden, self.size,
                         None if self.frees is None else self.frees[rows])  # fmt: skip


@dataclass(frozen=True)
class Gap:
    """Residuals (n,) at the nominal, derivatives by nuisances whose prior is N(0, 1), and candidates.

    `expected`: how many of all candidates act, beforehand. `own`: nuisances of one trial each, of which other
    trials say nothing. `carried` (D, n, M): draws of what noise makes of `raw_columns`, which are computed
    from the same recording as the residual. `tolerance` (n,): smallest shift of each row that matters, in sds
    of its noise; where it is `usual`, nobody's own, a cause that is found matters all the same. `told` (n,):
    the mean square of a row if nothing acts, 1 where it is not given: repeats of one motion share an error.
    """

    rows: Rows
    residual: Float[np.ndarray, " n"]
    nuisance: Float[np.ndarray, "n z"]
    candidates: tuple[Candidate, ...]
    expected: float = 1.0
    own: tuple[int, ...] = ()
    carried: Float[np.ndarray, "d n m"] | None = None
    tolerance: Float[np.ndarray, " n"] | None = None
    usual: bool = False
    told: Float[np.ndarray, " n"] | None = None

    def taken(self, rows: np.ndarray) -> Gap:
        """The gap on some rows (a mask or indices)."""
        return Gap(self.rows.taken(rows), self.residual[rows], self.nuisance[rows],
                   tuple(c.taken(rows) for c in self.candidates), self.expected, self.own,
                   None if self.carried is None else self.carried[:, rows],
                   None if self.tolerance is None else self.tolerance[rows], self.usual,
                   None if self.told is None else self.told[rows])  # fmt: skip

    def only(self, effects: Sequence[int]) -> Gap:
        """The gap with some of its candidates alone, in this order."""
        carried = self.carried
        if carried is not None:
            own = self.own_columns
            kept = [np.arange(1 + self.nuisance.shape[1]), *(own[j] for j in effects)]
            carried = carried[:, :, np.concatenate(kept)]
        return replace(self, candidates=tuple(self.candidates[j] for j in effects), carried=carried)

    @property
    def raw_columns(self) -> Float[np.ndarray, "n m"]:
        """Residual, nuisances, and each candidate's shift and derivatives by deviations over scale."""
        parts = [self.residual[:, None], self.nuisance]
        for c in self.candidates:
            parts += [c.shift[:, None], c.jacobian * c.scale]
        return np.concatenate(parts, 1)

    @property
    def own_columns(self) -> tuple[np.ndarray, ...]:
        """Places of each candidate's columns, that of its shift first."""
        out, at = [], 1 + self.nuisance.shape[1]
        for c in self.candidates:
            out.append(np.arange(at, at + 1 + c.at.size))
            at += 1 + c.at.size
        return tuple(out)

    @property
    def to_constant(self) -> Float[np.ndarray, "m m"]:
        """Turns raw columns, from their right, into those with each shift as it is at no deviation."""
        own = self.own_columns
        out = np.eye(1 + self.nuisance.shape[1] + sum(mine.size for mine in own))
        for c, mine in zip(self.candidates, own, strict=True):
            out[mine[1:], mine[0]] = -(c.at - c.neutral) / c.scale
        return out


@dataclass(frozen=True)
class Spectrum:
    """Columns (n, M) of a gap as cosines of each cell: residual, nuisances, and of every candidate its
    constant part and its derivatives by deviations over `scale`.

    `group` (n,): channel, part and band of each coefficient, numbered without holes, trials together;
    `own` the columns of candidate j, the first its constant part.
    """

    columns: np.ndarray
    group: np.ndarray
    band: np.ndarray
    own: tuple[np.ndarray, ...]
    num_nuisances: int


def spectrum(gap: Gap) -> Spectrum:
    """The gap's columns under an orthonormal cosine transform of every cell (white noise stays white)."""
    columns, (band,) = cosines(gap.rows, gap.raw_columns @ gap.to_constant)
    key = (gap.rows.channel * len(gap.rows.parts) + gap.rows.part) * len(gap.rows.bands) + band
    group = np.unique(key, return_inverse=True)[1]
    return Spectrum(columns, group, band, gap.own_columns, gap.nuisance.shape[1])


def cosines(
    rows: Rows, columns: np.ndarray, variance: np.ndarray | None = None
) -> tuple[np.ndarray, tuple[np.ndarray]]:
    """Columns (n, M) under an orthonormal cosine transform of every cell, over the noise's sd there (the root
    of `variance` (n,) instead, where that is given), and the coefficients' bands."""
    out, band = np.empty_like(columns, float), np.zeros(len(columns), int)
    order = np.argsort(rows.cell, kind="stable")
    starts = np.flatnonzero(np.diff(rows.cell[order], prepend=-1))
    edges = np.asarray(rows.bands[1:])
    for mine in np.split(order, starts[1:]):
        out[mine] = dct(columns[mine], axis=0, norm="ortho")
        if mine.size > 1:
            step = float(np.median(np.diff(rows.time[mine])))
            band[mine] = np.searchsorted(edges, np.arange(mine.size) / (2 * mine.size * step), side="right")
    sd = rows.sd if variance is None else np.sqrt(variance)
    return out if sd is None else out / sd[:, None], (band,)
