"""Features of plain ordered tasks: any channels on an even grid, robustly standardised.

Each channel gives its value and an edge-preserving slope. Samples are averaged in cells of one width for all
trials of a model, so that rate, gaps and uneven sampling do not matter; an empty cell is NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.trial import Trial
from hmmseg.robust import filled

CELLS_PER_TRIAL = 1500  # numerics: resolves a boundary to under 0.1 % of a trial's duration
FEWEST = 20  # numerics: changes of a channel below which its own sampling rate is not inferred
SMOOTHING = 0.01  # chosen: slope window, as a share of the median trial's duration


@dataclass(frozen=True)
class FeatureMap:
    """From channels to features, fixed once for all trials of a model."""

    channels: tuple[str, ...]
    step: float  # [s] width of a cell
    window: int  # [cells] width of slopes
    center: np.ndarray  # (num_features,) values of all channels, then their slopes
    scale: np.ndarray  # (num_features,)


@dataclass(frozen=True)
class SequenceFeatures:
    """One trial on the grid: `edges` (num_cells + 1,) [s]; `values` (num_cells, num_features)."""

    edges: np.ndarray
    values: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Middle (num_cells,) of each cell [s]."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    def shares(self, boundaries: np.ndarray) -> np.ndarray:
        """Times [s] as shares of the trial."""
        return (boundaries - self.edges[0]) / (self.edges[-1] - self.edges[0])


def drop_repeats(values: np.ndarray) -> np.ndarray:
    """A channel (num_timesteps,) without repeated readings (NaN) if it is sampled more slowly than rows."""
    changes = np.flatnonzero(np.diff(values) != 0) + 1
    if changes.size < FEWEST or (period := int(np.diff(changes).min())) < 2:
        return values
    starts = np.concatenate([[0], changes])
    age = np.arange(values.size) - starts[np.searchsorted(starts, np.arange(values.size), side="right") - 1]
    return np.where(age % period == 0, values, np.nan)


def cell_means(trial: Trial, channels: Sequence[str], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges (num_cells + 1,), means (num_cells, num_channels), NaN in empty cells; InputError if none."""
    for name in channels:
        if name not in trial.channels:
            raise InputError(trial.file, f"has no channel {name}", f"channels {', '.join(channels)}")
    start = float(trial.t[0])
    num_cells = max(int(np.ceil((trial.t[-1] - start) / step * (1 - 1e-9))), 1)
    cell = np.minimum(((trial.t - start) / step).astype(int), num_cells - 1)
    means = np.full((num_cells, len(channels)), np.nan)
    for j, name in enumerate(channels):
        x = drop_repeats(trial.channels[name])
        finite = np.isfinite(x)
        count = np.bincount(cell[finite], minlength=num_cells)
        total = np.bincount(cell[finite], x[finite], minlength=num_cells)
        means[count > 0, j] = total[count > 0] / count[count > 0]
    return start + step * np.arange(num_cells + 1), means


def fill_gaps(x: np.ndarray) -> np.ndarray:
    """Missing cells interpolated linearly (held at the ends) in each column, 0 in an empty one."""
    return np.stack([filled(column) for column in x.T], axis=1)


def edge_preserving_slopes(x: np.ndarray, window: int) -> np.ndarray:
    """Slope (num_cells, num_channels) by least squares over `window` cells before, around or after each cell.
    Of the three windows the one with the best linear fit is used (Kuwahara et al., Digital Processing of
    Biomedical Images, 1976), so that no slope extends across a jump."""
    num_cells = len(x)
    window = min(window, num_cells)
    if window < 2:
        return np.zeros_like(x)
    ramp = np.arange(window) - (window - 1) / 2
    spread = (ramp**2).sum()
    seen = np.lib.stride_tricks.sliding_window_view(x - x.mean(axis=0), window, axis=0)
    slope = seen @ ramp / spread
    rest = seen.var(axis=2) * window - slope**2 * spread
    index = np.arange(num_cells)
    starts = np.stack([index - window + 1, index - window // 2, index]).clip(0, num_cells - window)
    best = rest[starts].argmin(axis=0)
    return np.take_along_axis(slope[starts], best[None], axis=0)[0]


def _raw(means: np.ndarray, step: float, window: int) -> np.ndarray:
    slopes = edge_preserving_slopes(fill_gaps(means), window) / step
    return np.hstack([means, np.where(np.isfinite(means), slopes, np.nan)])


def feature_map(trials: Sequence[Trial], channels: Sequence[str]) -> FeatureMap:
    """Grid and standardisation learned from trials: medians, and spreads without the outer 2 %."""
    duration = float(np.median([trial.t[-1] - trial.t[0] for trial in trials]))
    step = max(float(np.median([1 / trial.rate for trial in trials])), duration / CELLS_PER_TRIAL)
    window = max(round(SMOOTHING * duration / step), 3)
    raw = np.vstack([_raw(cell_means(trial, channels, step)[1], step, window) for trial in trials])
    center = np.nanmedian(raw, 0)
    low, high = np.nanquantile(raw, [0.02, 0.98], axis=0)
    scale = np.nanstd(np.clip(raw, low, high), 0)
    return FeatureMap(tuple(channels), step, window, center, np.where(scale > 0, scale, 1.0))


def features(trial: Trial, mapping: FeatureMap) -> SequenceFeatures:
    """Standardised features of one trial; InputError if it lacks a channel."""
    edges, means = cell_means(trial, mapping.channels, mapping.step)
    raw = _raw(means, mapping.step, mapping.window)
    return SequenceFeatures(edges, (raw - mapping.center) / mapping.scale)
