"""Segment and estimate one case, with all that calibration and ablation score of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from estimation.design import PROPERTIES
from estimation.observations import aligned_weights
from estimation.posterior import find_mode, posterior
from estimation.sampler import designs, sample_either
from experiments.recordings import Case
from experiments.scoring import boundaries_covered, boundary_residuals
from hmmseg.segmentation.align import align

KINDS = ("touch", "lift", "land", "release")  # the boundaries of each move, in order
LEVELS = {"68": 0.68, "95": 0.95}


@dataclass(frozen=True)
class Estimates:
    """Estimates of one case against its truth.

    `residuals` [s] and `covered` (num_trials, num_boundaries); `names` of the properties (object,
    property); `errors` relative; `z` by the Laplace approximation, `ranks` of the true values among
    the draws (empty where not sampled), both (num_properties,).
    """

    residuals: np.ndarray
    covered: np.ndarray
    names: tuple[tuple[str, str], ...]
    errors: np.ndarray
    z: np.ndarray
    ranks: np.ndarray
    rhat: float
    ess: float


def estimate(case: Case, trials: slice = slice(None), sampled: bool = True, seed: int = 0) -> Estimates:
    """Estimate a case from some of its trials, pooled; without the sampler if not `sampled`."""
    chosen = list(case.trials[trials])
    aligned = align(chosen, case.task, case.rig)
    segmentations = aligned.segmentations
    truth = [t for t in case.truth[trials] if t is not None]
    pairs = list(zip(segmentations, truth, strict=True))
    rng = np.random.default_rng(seed)
    weighed, noise = aligned_weights(aligned, rng)
    design, other = designs(aligned, weighed, noise)
    post = posterior(design)
    mode = find_mode(post)
    single = [i for i, u in enumerate(design.unknowns) if u.single]
    names = tuple(design.names[i] for i in single)
    true = np.array([case.blocks[obj][prop][0] for obj, prop in names])
    means, sd = mode.unknowns[single], np.sqrt(np.diag(mode.unknowns_covariance))[single]
    z = (means - true) / sd
    ranks, rhat, ess = np.array([]), np.nan, np.nan
    if sampled:
        _, found = sample_either(design, other, seed)
        draws = found.flat[:, single]
        means, ranks, rhat, ess = draws.mean(axis=0), (draws < true).mean(axis=0), found.rhat, found.ess
    return Estimates(
        np.array([boundary_residuals(s, t) for s, t in pairs]),
        np.array([boundaries_covered(s, t) for s, t in pairs]),
        names, means / true - 1, z, ranks, rhat, ess,
    )  # fmt: skip


def summarise_estimates(cases: Sequence[Sequence[Estimates]]) -> dict:
    """Boundaries by kind, properties by kind, coverages with standard errors, cases as clusters."""
    every = [e for case in cases for e in case]
    known = {prop for e in every for _, prop in e.names} | {"all"}
    properties = {p: _properties(cases, p) for p in (*PROPERTIES, "all") if p in known}
    boundaries = {"all": _boundaries(cases, slice(None))}
    boundaries |= {kind: _boundaries(cases, slice(k, None, len(KINDS))) for k, kind in enumerate(KINDS)}
    out = {"cases": len(cases), "estimates": len(every), "boundaries": boundaries, "properties": properties}
    if every[0].ranks.size:
        out["rhat"] = {
            "median": float(np.median([e.rhat for e in every])),
            "largest": max(e.rhat for e in every),
        }
        out["ess"] = {"median": float(np.median([e.ess for e in every])), "least": min(e.ess for e in every)}
    return out


def _boundaries(cases: Sequence[Sequence[Estimates]], kind: slice) -> dict:
    residuals = np.concatenate([e.residuals[:, kind].ravel() for case in cases for e in case])
    size = np.abs(residuals[np.isfinite(residuals)])
    inside = [np.concatenate([e.covered[:, kind].ravel() for e in case]) for case in cases]
    return {
        "median": float(np.median(size)), "percentile_95": float(np.percentile(size, 95)),
        "largest": float(size.max()), "bias": float(np.nanmedian(residuals)), "count": int(size.size),
    } | _coverage(inside, "coverage_90")  # fmt: skip


def _properties(cases: Sequence[Sequence[Estimates]], prop: str) -> dict:
    def collect(field: str) -> list[np.ndarray]:
        return [
            np.concatenate([
                getattr(e, field)[[prop in ("all", p) for _, p in e.names]] for e in case
            ]) for case in cases
        ]  # fmt: skip

    errors, z = np.concatenate(collect("errors")), collect("z")
    out = {"rms": float(np.sqrt(np.mean(errors**2))), "bias": float(np.mean(errors)),
           "count": int(errors.size), "z_rms": float(np.sqrt(np.mean(np.concatenate(z) ** 2)))}  # fmt: skip
    for name, level in LEVELS.items():
        out |= _coverage([np.abs(v) < norm.ppf((1 + level) / 2) for v in z], f"laplace_{name}")
        if cases[0][0].ranks.size:
            inside = [np.abs(rank - 0.5) < level / 2 for rank in collect("ranks")]
            out |= _coverage(inside, f"coverage_{name}")
    return out


def _coverage(inside: Sequence[np.ndarray], name: str) -> dict[str, float | None]:
    """Share inside and its standard error with cases as clusters (None of one case)."""
    rows = [row[np.isfinite(row)] for row in (np.asarray(i, float) for i in inside)]
    share = float(np.mean(np.concatenate(rows)))
    error = None
    if len(rows) > 1:
        scores = np.array([(row - share).sum() for row in rows]) / np.mean([row.size for row in rows])
        error = float(np.std(scores, ddof=1) / np.sqrt(len(rows)))
    return {name: share, f"{name}_se": error}
