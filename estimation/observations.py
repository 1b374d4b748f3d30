"""Observations of block properties from aligned trials: one robust mean per grip and channel.

Each grip (from pickup to place of one move) gives three observations:

- `force`: mean net vertical force over the carry [N];
- `distance`: mean distance of the fingers while held, corrected for the pads' squeeze [m];
- `rise`: mean height of the fingers over the place minus that over the pickup, corrected for the pads' shear
  deflection [m].

Means are Student-t weighted; their sampling variance is the sandwich estimate psi^2 / psi'^2 pooled over
grips, with the integrated autocorrelation time of the residuals (Huber 1964; Sokal 1997; docs/properties.md).
Each drawn alignment assigns every sample to one subtask.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from estimation.pads import Slope, landing, shear_give, slopes_within
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import block_width, block_y, inertia_factor, pads_of
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.levels import AROUND, TAIL
from hmmseg.robust import coarse_step, median_of_known, robust_sd
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from hmmseg.segmentation.emissions import acceleration, thin
from hmmseg.tables import Brief

FARTHEST_LAG = 11  # numerics: samples; autocorrelations beyond are noise
MIN_STRETCH = 0.5  # numerics: samples; least autocorrelation time: white noise has 1, a short series less
LEAST = 1e-8  # numerics: m or N; least noise of a sample, which keeps rounding out of the posterior
STATED = 4.0  # prior: samples that a stated noise is worth: it is off by a factor of two once in twenty


@dataclass(frozen=True)
class Noise:
    """Variance of one effective sample, by kind of mean (KEYS) and of each force in free motion."""

    variance: dict[str, float]
    count: dict[str, float]  # samples that it was estimated from


def channel_sds(signals: Sequence[Signals], aligned: AlignedTrials) -> dict[str, float]:
    """Nominal noise of one sample behind each mean [N, m], NaN if unstated; none for a wrist's sensor."""
    pads, out = pads_of(aligned.rig), dict[str, float]()
    if any(one.trial.inertia is not None for one in aligned.trials):
        return out
    for s in signals:
        width = median_of_known(np.hypot(s.sd_x, s.sd_force * pads.normal1))
        height = median_of_known(np.hypot(s.sd_y, s.sd_force * pads.shear1)) / 2
        sds = {"force": s.sd_force, "distance": width, "pickup": height, "place": height}
        for key, sd in sds.items():
            out[key] = max(out.get(key, 0.0), float(np.sqrt(2.0) * sd))
    return out


Pooled = dict[str, list[tuple[np.ndarray, np.ndarray]]]  # residuals and weights by channel


def estimated_noise(pooled: Pooled, scales: dict[str, float], stated: dict[str, float]) -> Noise:
    """Noise of each channel from residuals and weights, pooled over grips; `stated`: sds where known."""
    variance, count = {}, {}
    for key, pairs in pooled.items():
        pairs = [(r[np.isfinite(r)], w[np.isfinite(r)]) for r, w in pairs]
        pairs = [(r, w) for r, w in pairs if r.size > 1]
        if not pairs:
            is_stated = np.isfinite(stated.get(key, np.nan))
            variance[key], count[key] = (stated[key] ** 2, STATED) if is_stated else (scales[key] ** 2, 1.0)
            continue
        psi = np.concatenate([w * r for r, w in pairs])
        z2 = np.concatenate([(r / scales[key]) ** 2 for r, _ in pairs])
        slope = np.mean((TAIL + 1) * (TAIL - z2) / (TAIL + z2) ** 2)
        # One location per grip was fitted: correct for the lost degrees of freedom.
        lost = psi.size / max(psi.size - len(pairs), 1)
        stretch = autocorrelation_time([w * r for r, w in pairs])
        variance[key] = max(float(np.mean(psi**2) / slope**2 * lost * stretch), LEAST**2)
        count[key] = float(max(psi.size - len(pairs), 1) / stretch)
        if variance[key] < stated.get(key, 0.0) ** 2:
            total = STATED + count[key]
            variance[key] = (STATED * stated[key] ** 2 + count[key] * variance[key]) / total
            count[key] = total
    return Noise(variance, count)


def autocorrelation_time(series: list[np.ndarray]) -> float:
    """Integrated autocorrelation time of residual series, pooled; at least MIN_STRETCH: Geyer's (1992)
    initial positive sequence, below 1 if successive residuals cancel. Autocorrelations about a series' own
    mean are biased by -1 / length, which is corrected."""
    power, size = sum(float(r @ r) for r in series), sum(r.size for r in series)
    bias = len(series) / max(size, 1)

    def rho(lag: int) -> float:
        if lag == 0:
            return 1.0
        pairs = sum(max(r.size - lag, 0) for r in series)
        if pairs < 8 or power <= 0:
            return 0.0
        products = sum(float(r[lag:] @ r[: r.size - lag]) for r in series if r.size > lag)
        return products / power * size / pairs + bias

    total, lags = -1.0, 1
    for lag in range(0, FARTHEST_LAG, 2):
        pair = rho(lag) + rho(lag + 1)
        # A pair counts only where it exceeds its own sampling noise.
        if lag > 0 and pair <= 2 / np.sqrt(size):
            break
        total += 2 * pair
        lags = lag + 1
    # From few samples, the excess over white noise is mostly noise, of variance about 4 / size per lag; it is
    # shrunk accordingly (positive-part James and Stein 1961).
    excess = total - 1
    if excess != 0 and size:
        total = 1 + excess * max(0.0, 1 - 4 * lags / size / excess**2)
    return max(total, MIN_STRETCH)


CHANNELS = ("force", "distance", "rise")
KEYS = ("force", "distance", "pickup", "place")  # the means of a grip; a rise is place less pickup
NUM_ALIGNMENTS = 16  # numerics: draws of all boundaries; their mean is known to a quarter of their sd
MIN_FREE = 8  # numerics: least samples of free motion to estimate the scale of forces


def draw_boundaries(trial: TrialAlignment, rng: np.random.Generator, num: int) -> np.ndarray:
    """Boundary times (num, num_subtasks - 1) [s] drawn from their posteriors, kept in order."""
    columns = []
    for boundary in trial.boundaries:
        cumulative = np.cumsum(boundary.probabilities)
        columns.append(np.interp(rng.uniform(size=num) * cumulative[-1], cumulative, boundary.times))
    return np.maximum.accumulate(np.stack(columns, axis=1), axis=1)


def channel_values(signals: Signals, rig: Rig) -> dict[str, np.ndarray]:
    """Sample values behind each mean, arrays (num_timesteps,)."""
    s, pads = signals, pads_of(rig)
    width = block_width(s.distance, s.fx1, s.fx2, pads)
    height = block_y(s.y, s.fy1, s.fy2, pads)
    return {"force": s.fy, "distance": width, "pickup": height, "place": height}


def gravity_factor(signals: Signals, rig: Rig) -> np.ndarray:
    """1 + a / g (num_timesteps,): net force of a carried block in units of its weight."""
    return inertia_factor(np.nan_to_num(acceleration(signals.t, signals.vy)), rig.gravity)


def subtask_masks(
    times: np.ndarray, boundaries: np.ndarray, num_subtasks: int, reach: float = 0.0
) -> np.ndarray:
    """Booleans (num_alignments, num_subtasks, num_timesteps): which subtask each sample is in. A mean over
    samples up to `reach` [s] to either side, across a boundary, is in none."""
    first, last = ((at[None, :, None] >= boundaries[:, None, :]).sum(axis=2)
                   for at in (times - reach, times + reach))  # fmt: skip
    return np.where(first == last, first, -1)[:, None, :] == np.arange(num_subtasks)[None, :, None]


def _members(steps: tuple[Subtask, ...], move: int) -> dict[str, list[int]]:
    """Subtask indices that each mean of a grip is taken over."""
    held = [s for s in steps if s.move == move and s.state != FREE]
    ground, above = ([s.index for s in held if s.state == state] for state in (ON_GROUND, ABOVE_GROUND))
    every = [s.index for s in held]
    return {"force": above, "distance": every, "pickup": ground[:1], "place": ground[1:]}


def held_as_described(present: np.ndarray, steps: tuple[Subtask, ...]) -> np.ndarray:
    """Which subtasks shown (num_subtasks,) determine properties: not those of a grip without its carry."""
    out = present.copy()
    for carry in steps:
        if carry.state == ABOVE_GROUND and not present[carry.index]:
            out[[s.index for s in steps if s.move == carry.move and s.state == ON_GROUND]] = False
    return out


def robust_weights(
    values: np.ndarray, mask: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Student-t weights (num_timesteps,), residuals and location of the masked values."""
    chosen = values[mask & np.isfinite(values)]
    if not chosen.size:
        return np.zeros_like(values), np.full_like(values, np.nan), np.nan
    centre = float(np.median(chosen))
    for _ in range(20):
        weight = (TAIL + 1) / (TAIL + ((chosen - centre) / scale) ** 2)
        centre = float(weight @ chosen / weight.sum())
    residual = values - centre
    weights = (TAIL + 1) / (TAIL + (residual / scale) ** 2)
    return np.where(np.isfinite(values), weights, 0.0), residual, centre


@dataclass(frozen=True, repr=False)
class WeighedTrial(Brief):
    """One trial thinned for estimation: its `signals`, and sample weights of each grip's means."""

    signals: Signals
    masks: np.ndarray  # (num_alignments, num_subtasks, num_timesteps) samples in drawn alignments
    # by move and KEYS weights (num_alignments, num_timesteps), 0 where nothing was recorded
    grips: dict[int, dict[str, np.ndarray]]
    counts: dict[int, dict[str, np.ndarray]]  # likewise effective sample numbers (num_alignments,)
    free: np.ndarray  # weights (num_timesteps,) over free motion
    # (4, num_timesteps) the same of each force, robust to a finger that touches early
    free_robust: np.ndarray
    free_count: float  # samples of free motion
    # by move over the pads' give: "distance" and "rise" within the grip, and "landing" from touch to place
    slopes: dict[int, dict[str, Slope]] = field(default_factory=dict)
    # (4,) [N] error of each force that no average removes
    rounding: np.ndarray = field(default_factory=lambda: np.zeros(len(FORCE_CHANNELS)))


def aligned_weights(aligned: AlignedTrials, rng: np.random.Generator) -> tuple[list[WeighedTrial], Noise]:
    """Weights of every grip's means for drawn alignments, and the noise of each channel."""
    steps, rig, prepared = aligned.subtasks, aligned.rig, []
    members = {m: _members(steps, m) for m in sorted({s.move for s in steps if s.move is not None})}
    for trial in aligned.trials:
        thinned = thin(trial.signals)
        medians = np.array([[b.quantile(0.5) for b in trial.boundaries]])
        drawn = draw_boundaries(trial, rng, NUM_ALIGNMENTS)
        reach = max(float(np.median(np.diff(thinned.t)) - np.median(np.diff(trial.signals.t))), 0.0) / 2
        best = subtask_masks(thinned.t, np.maximum.accumulate(medians, axis=1), len(steps), reach)[0]
        present = held_as_described(trial.present, steps)
        masks = subtask_masks(thinned.t, drawn, len(steps), reach) & present[None, :, None]
        readings = channel_values(thinned, rig)
        readings["force"] = readings["force"] / gravity_factor(thinned, rig)
        prepared.append((thinned, readings, best & present[:, None], masks))
    scales = {}
    for key in KEYS:
        indices = [of[key] for of in members.values()]
        scales[key] = _scale([(readings[key], best) for _, readings, best, _ in prepared], indices)
    pooled: Pooled = {key: [] for key in (*KEYS, *FORCE_CHANNELS)}
    landings = [(a, b) for a, b in pairwise(steps) if (a.state, b.state) == (ABOVE_GROUND, ON_GROUND)]
    touched = {b.move: a.index for a, b in landings}
    weighed = []
    for trial, (thinned, readings, best, masks) in zip(aligned.trials, prepared, strict=True):
        grips, counts = dict[int, dict[str, np.ndarray]](), dict[int, dict[str, np.ndarray]]()
        slopes = {}
        for move, of in members.items():
            grips[move], counts[move], groups = {}, {}, {}
            for key, indices in of.items():
                groups[key] = chosen = best[indices].any(axis=0)
                weight, residual, _ = robust_weights(readings[key], chosen, scales[key])
                pooled[key].append((residual[chosen], weight[chosen]))
                each = masks[:, indices].any(axis=1) * weight
                total = each.sum(axis=1, keepdims=True)
                grips[move][key] = each / np.where(total > 0, total, 1.0)
                counts[move][key] = (each > 0).sum(axis=1)
            slopes[move] = slopes_within(thinned, readings, groups, scales, rig)
            if move in touched:
                k, place, give = touched[move], grips[move]["place"].mean(axis=0), shear_give(thinned, rig)
                touch = trial.boundaries[k].mean, trial.boundaries[k].sd
                shown = landing(thinned.t, readings["place"], give, place, touch, best[k], scales["place"])
                slopes[move] |= {} if shown is None else {"landing": shown}
            if "friction" in trial.trial.hidden:  # the grip force is not measured
                slopes[move].pop("distance", None)
        free = _free_samples(thinned, best[[s.index for s in steps if s.state == FREE]].any(axis=0))
        robust = np.zeros((len(FORCE_CHANNELS), free.size))
        for row, name in zip(robust, FORCE_CHANNELS, strict=True):
            force = getattr(thinned, name)
            if free.sum() < MIN_FREE:  # too few samples to estimate the scale
                scale = thinned.sd_force if np.isfinite(thinned.sd_force) else 1.0
            else:
                scale = max(robust_sd(force[free] - np.median(force[free])), 1e-9)
            weight, residual, _ = robust_weights(force, free, scale)
            row[:] = np.where(free, weight, 0.0) / max(weight[free].sum(), 1e-9)
            scales[name] = max(scales.get(name, 0.0), scale)
            pooled[name].append((residual[free], weight[free]))
        shares, count = free / max(free.sum(), 1), float(free.sum())
        rounding = np.array([coarse_step(getattr(trial.signals, n)) for n in FORCE_CHANNELS]) / np.sqrt(12)
        weighed.append(WeighedTrial(thinned, masks, grips, counts, shares, robust, count, slopes, rounding))
    return weighed, estimated_noise(pooled, scales, channel_sds([w.signals for w in weighed], aligned))


def _free_samples(s: Signals, free: np.ndarray) -> np.ndarray:
    """Samples (num_timesteps,) of `free` motion with all forces, apart from changes of contact."""
    free = free & np.isfinite(s.fx1 + s.fy1 + s.fx2 + s.fy2)
    margin = 1 + int(np.ceil(AROUND / float(np.median(np.diff(s.t)))))
    return free & (np.convolve(~free, np.ones(2 * margin + 1), "same") == 0)


def free_forces(signals: Signals, weighed: WeighedTrial) -> np.ndarray:
    """Mean forces (4,) in free motion [N], where they should vanish."""
    force = np.stack([getattr(signals, name) for name in FORCE_CHANNELS])
    return (weighed.free_robust * np.nan_to_num(force)).sum(axis=1)


def _scale(trials: list[tuple[np.ndarray, np.ndarray]], groups: list[list[int]]) -> float:
    """Robust scale of one channel's residuals, pooled over grips, of readings and subtask masks."""
    residuals = []
    for reading, best in trials:
        for indices in groups:
            chosen = reading[best[indices].any(axis=0)]
            chosen = chosen[np.isfinite(chosen)]
            if chosen.size > 2:
                residuals.append(chosen - np.median(chosen))
    return max(robust_sd(np.concatenate(residuals)), 1e-9) if residuals else 1.0
