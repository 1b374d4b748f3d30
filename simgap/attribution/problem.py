"""The input of an attribution: whitened residuals, nuisances and linearised candidate effects.

    residual = nuisance @ z + sum over acting effects shift_j(theta_j) + background + noise

Every row is divided by the standard deviation of its noise. An effect is affine about `at`, the point at
which it was linearised: shift_j(theta) = shift + jacobian @ (theta - at).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.fft import dct

MODELLED = 0.1  # prior: relative error of a modelled effect's form, from part to part
BANDS = (0.0, 1.0, 5.0)  # chosen: Hz; lower edges of the frequency bands


def _some_rows(data: Any, chosen: np.ndarray, *names: str) -> dict[str, Any]:
    """Some rows (a mask or indices) of the named fields; those that are None are left out."""
    values = ((name, getattr(data, name)) for name in names)
    return {name: value[chosen] for name, value in values if value is not None}


@dataclass(frozen=True)
class Rows:
    """The trial, channel, part and time of each of n residuals.

    A part is a subtask, or any stretch of a trial. A cell is one channel in one part of one trial; its rows
    are in order of time.

    Attributes:
        trial, channel, part: Indices (n,) into the names below.
        time: Times (n,) [s].
        trials, channels, parts: Names.
        bands: Lower edges of the frequency bands [Hz].
        sd: Standard deviation (n,) of the noise in each cosine coefficient of the cells; None for 1.
        shape: Variance (n,) of the same coefficients for white sensor noise, whatever its level and colour.
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
        """The rows of a mask (n,) or of indices."""
        return replace(self, **_some_rows(self, chosen, "trial", "channel", "part", "time", "sd", "shape"))

    @property
    def cell(self) -> Int[np.ndarray, " n"]:
        """The number (n,) of each row's cell."""
        return (self.trial * len(self.channels) + self.channel) * len(self.parts) + self.part

    @property
    def place(self) -> Int[np.ndarray, " n"]:
        """The channel and part (n,) of each row, over all trials, numbered consecutively."""
        return np.unique(self.channel * len(self.parts) + self.part, return_inverse=True)[1]

    def by_cell(self) -> list[np.ndarray]:
        """Indices of the rows of each cell, in order of time."""
        order = np.argsort(self.cell, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(self.cell[order])) + 1)


@dataclass(frozen=True)
class Candidate:
    """One effect with k parameters; it changes nothing at `neutral`.

    The joint prior of the k deviations from neutral is a multivariate Cauchy distribution of the given
    `scale`, so that gross faults stay possible (Gelman et al., Ann. Appl. Stat. 2, 2008).

    Attributes:
        name: The effect; one effect may have several candidates.
        parameters: Names of the parameters.
        at: Parameters (k,) at which the effect was linearised.
        neutral: Parameters (k,) at which it changes nothing.
        scale: Usual size (k,) of their deviations from neutral.
        shift: What the effect adds to each residual (n,) at `at`.
        jacobian: Derivatives (n, k) of the shift there.
        low, high: Bounds (k,) of the parameters.
        variance: Variance (n,) that a random effect adds to each row, in place of a shift.
        evidence: Log evidence from other sources [nats].
        form: Usual relative error of the effect's form, from part to part of a recording.
        hidden: Parameters that differ from part to part, such as the phase of an oscillation.
        size: What relative errors (k,) of parameters refer to; their deviation from neutral if None or NaN.
        frees: Most additional variance (n,) of each cosine coefficient, in units of the noise's, if it acts.
        beside: Effects that acted where it was linearised; one without is listed before.
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
    beside: tuple[str, ...] = ()

    @property
    def form_of(self) -> tuple[str, tuple[str, ...]]:
        """Name and parameters, which identify it wherever it was linearised."""
        return self.name, self.parameters

    def taken(self, rows: np.ndarray) -> Candidate:
        """The candidate on some rows (a mask or indices)."""
        return replace(self, **_some_rows(self, rows, "shift", "jacobian", "variance", "frees"))


@dataclass(frozen=True)
class Gap:
    """Residuals at the nominal values, their derivatives by nuisances, and the candidates.

    Attributes:
        rows: What each residual is.
        residual: Whitened residuals (n,).
        nuisance: Derivatives (n, z) by nuisances, whose prior is N(0, 1).
        candidates: The effects that may act.
        carried: Errors (D, n, M) that noise of the recordings causes in the spectra of `raw_columns`; their
            products, summed over D, are the noise's.
        tolerance: Smallest shift (n,) of each row that matters, in standard deviations of its noise.
        usual: Whether the tolerance is a default; a cause that is found then matters in any case.
        mean_square: Mean square (n,) of each row if nothing acts, less for repeats that share an error;
            None for 1.
    """

    rows: Rows
    residual: Float[np.ndarray, " n"]
    nuisance: Float[np.ndarray, "n z"]
    candidates: tuple[Candidate, ...]
    carried: Float[np.ndarray, "d n m"] | None = None
    tolerance: Float[np.ndarray, " n"] | None = None
    usual: bool = False
    mean_square: Float[np.ndarray, " n"] | None = None

    def taken(self, rows: np.ndarray) -> Gap:
        """The gap on some rows (a mask or indices)."""
        candidates = tuple(c.taken(rows) for c in self.candidates)
        carried = None if self.carried is None else self.carried[:, rows]
        few = _some_rows(self, rows, "residual", "nuisance", "tolerance", "mean_square")
        return replace(self, rows=self.rows.taken(rows), candidates=candidates, carried=carried, **few)

    def only(self, effects: Sequence[int]) -> Gap:
        """The gap with some of its candidates only, in this order."""
        carried = self.carried
        if carried is not None:
            own = self.own_columns
            kept = [np.arange(1 + self.nuisance.shape[1]), *(own[j] for j in effects)]
            carried = carried[:, :, np.concatenate(kept)]
        return replace(self, candidates=tuple(self.candidates[j] for j in effects), carried=carried)

    @property
    def raw_columns(self) -> Float[np.ndarray, "n m"]:
        """Residual, nuisances, and each candidate's shift and its derivatives by scaled deviations."""
        parts = [self.residual[:, None], self.nuisance]
        for c in self.candidates:
            parts += [c.shift[:, None], c.jacobian * c.scale]
        return np.concatenate(parts, 1)

    @property
    def own_columns(self) -> tuple[np.ndarray, ...]:
        """Indices of each candidate's columns, its shift first."""
        out, at = [], 1 + self.nuisance.shape[1]
        for c in self.candidates:
            out.append(np.arange(at, at + 1 + c.at.size))
            at += 1 + c.at.size
        return tuple(out)

    @property
    def to_constant(self) -> Float[np.ndarray, "m m"]:
        """The matrix that, from the right, replaces each shift in the raw columns by its value at neutral."""
        own = self.own_columns
        out = np.eye(1 + self.nuisance.shape[1] + sum(mine.size for mine in own))
        for c, mine in zip(self.candidates, own, strict=True):
            out[mine[1:], mine[0]] = -(c.at - c.neutral) / c.scale
        return out


@dataclass(frozen=True)
class Spectrum:
    """The columns of a gap after a cosine transform of each cell.

    Attributes:
        columns: Residual, nuisances, and each candidate's constant part and derivatives by scaled deviations
            (n, M).
        group: Group (n,) of each coefficient: channel, part and band over all trials, numbered consecutively.
        band: Band (n,) of each coefficient.
        own: Columns of each candidate, its constant part first.
        num_nuisances: Number of nuisances.
    """

    columns: np.ndarray
    group: np.ndarray
    band: np.ndarray
    own: tuple[np.ndarray, ...]
    num_nuisances: int


def spectrum(gap: Gap) -> Spectrum:
    """Apply an orthonormal cosine transform to every cell of a gap (white noise stays white)."""
    columns, (band,) = cosines(gap.rows, gap.raw_columns @ gap.to_constant)
    key = (gap.rows.channel * len(gap.rows.parts) + gap.rows.part) * len(gap.rows.bands) + band
    group = np.unique(key, return_inverse=True)[1]
    return Spectrum(columns, group, band, gap.own_columns, gap.nuisance.shape[1])


def cosines(
    rows: Rows, columns: np.ndarray, variance: np.ndarray | None = None
) -> tuple[np.ndarray, tuple[np.ndarray]]:
    """Apply an orthonormal cosine transform to every cell.

    Args:
        rows: What each row is.
        columns: Columns (n, M) to be transformed.
        variance: Variance (n,) of the noise in each coefficient; the rows' own if None.

    Returns:
        Coefficients (n, M) over the noise's standard deviation, and a tuple of their bands (n,).
    """
    out, band = np.empty_like(columns, float), np.zeros(len(columns), int)
    edges = np.asarray(rows.bands[1:])
    for mine in rows.by_cell():
        out[mine] = dct(columns[mine], axis=0, norm="ortho")
        if mine.size > 1:
            step = float(np.median(np.diff(rows.time[mine])))
            band[mine] = np.searchsorted(edges, np.arange(mine.size) / (2 * mine.size * step), side="right")
    sd = rows.sd if variance is None else np.sqrt(variance)
    return out if sd is None else out / sd[:, None], (band,)
