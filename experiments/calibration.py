"""Calibration of the uncertainties: boundaries and properties against the truth of many cases.

    python -m experiments.calibration [RECORDINGS] [--cases 64]

On a bank of simulated healthy cases, on the same with hands that deviate as a [systematic] table
says, and on the healthy cases of a recordings folder: all trials of a case pooled (four at a time)
and single trials. Writes experiments/results/calibration.json; docs/calibration.md reads it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

from estimation.design import PROPERTIES, build
from estimation.observations import aligned_weights
from estimation.posterior import find_mode, posterior
from estimation.sampler import sample
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from experiments.scoring import boundaries_covered, boundary_residuals
from experiments.table_text import covered, markdown, milliseconds, percent
from experiments.worlds import HAND, SEED, simulated_cases
from hmmseg.segmentation.align import align

RESULTS = Path(__file__).parent / "results"
POOLED = 4
KINDS = ("touch", "lift", "land", "release")  # the boundaries of each move, in order
LEVELS = {"68": 0.68, "95": 0.95}
SETS = {
    "bank": "Virtual model, fresh seeds",
    "recordings": "Stand-in recordings, healthy",
    "systematic": "Hands that deviate as [systematic] says",
}
PAPER = {"weight": "3 %", "width": "7 %", "height": "10 %"}


@dataclass(frozen=True)
class Estimates:
    """Estimates of one case against its truth.

    `residuals` [s] and `covered` (num_trials, num_boundaries); `names` of the properties (object,
    property); `errors` relative; `z` by the Laplace approximation, `ranks` of the true values among
    the draws, both (num_properties,).
    """

    residuals: np.ndarray
    covered: np.ndarray
    names: tuple[tuple[str, str], ...]
    errors: np.ndarray
    z: np.ndarray
    ranks: np.ndarray
    rhat: float
    ess: float


def estimate(case: Case, trials: slice = slice(None), seed: int = 0) -> Estimates:
    """Estimate a case from some of its trials, pooled."""
    chosen = list(case.trials[trials])
    aligned = align(chosen, case.task, case.rig)
    segmentations = aligned.segmentations
    truth = [t for t in case.truth[trials] if t is not None]
    pairs = list(zip(segmentations, truth, strict=True))
    rng = np.random.default_rng(seed)
    weighed, noise = aligned_weights(aligned, rng)
    design = build(aligned, weighed, noise)
    post = posterior(design)
    mode = find_mode(post)
    single = [i for i, u in enumerate(design.unknowns) if u.single]
    names = tuple(design.names[i] for i in single)
    true = np.array([case.blocks[obj][prop][0] for obj, prop in names])
    z = (mode.unknowns[single] - true) / np.sqrt(np.diag(mode.unknowns_covariance))[single]
    found = sample(post, seed, mode=mode)
    draws = found.flat[:, single]
    return Estimates(
        np.array([boundary_residuals(s, t) for s, t in pairs]),
        np.array([boundaries_covered(s, t) for s, t in pairs]),
        names, draws.mean(axis=0) / true - 1, z, (draws < true).mean(axis=0), found.rhat, found.ess,
    )  # fmt: skip


def summarise_estimates(cases: Sequence[Sequence[Estimates]]) -> dict:
    """Boundaries by kind, properties by kind, coverages with standard errors, cases as clusters."""
    every = [e for case in cases for e in case]
    known = {prop for e in every for _, prop in e.names} | {"all"}
    properties = {p: _properties(cases, p) for p in (*PROPERTIES, "all") if p in known}
    boundaries = {"all": _boundaries(cases, slice(None))}
    boundaries |= {kind: _boundaries(cases, slice(k, None, len(KINDS))) for k, kind in enumerate(KINDS)}
    out = {"cases": len(cases), "estimates": len(every), "boundaries": boundaries, "properties": properties}
    rhat, ess = [e.rhat for e in every], [e.ess for e in every]
    out["rhat"] = {"median": float(np.median(rhat)), "largest": max(rhat)}
    out["ess"] = {"median": float(np.median(ess)), "least": min(ess)}
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


def groups(case: Case, size: int) -> list[slice]:
    """Slices of `size` trials each; trials left over are not used."""
    return [slice(k, k + size) for k in range(0, len(case.trials) - size + 1, size)]


def calibrate(cases: Sequence[Case], pooled: int = POOLED, singles: int | None = None) -> dict:
    """Summaries of all trials pooled and of single trials (the first `singles` of each case)."""
    began = time.perf_counter()
    many = [[estimate(case, g) for g in groups(case, pooled)] for case in cases]
    one = [[estimate(case, g) for g in groups(case, 1)[:singles]] for case in cases]
    return {
        "pooled": summarise_estimates(many), "single": summarise_estimates(one),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


def table(found: dict) -> str:
    """docs/tables/calibration.csv: coverages by kind of boundary and property, by sampling and by Laplace."""
    parts = []
    for name, title in SETS.items():
        if name not in found:
            continue
        for size, of in (("pooled", "four trials pooled"), ("single", "single trials")):
            s = found[name][size]
            parts.append(f"### {title}: {of} ({s['estimates']} estimates)")
            head = ["boundary", "number", "shift", "median error", "95th percentile", "90 % intervals cover"]
            rows = []
            for kind, b in s["boundaries"].items():
                times = [milliseconds(b[k]) for k in ("bias", "median", "percentile_95")]
                rows.append([kind, f"{b['count']}", *times, covered(b, "coverage_90")])
            parts.append(markdown(head, rows))
            head = ["property", "number", "rms error", "68 % cover", "Laplace", "95 % cover", "Laplace"]
            rows = []
            for key, p in s["properties"].items():
                shares = ("coverage_68", "laplace_68", "coverage_95", "laplace_95")
                rows.append([key, f"{p['count']}", percent(p["rms"], 3), *(covered(p, c) for c in shares)])
            parts.append(markdown(head, rows))
    return "\n\n".join(parts)


def headline(found: dict) -> str | None:
    """README: errors and coverage on two kinds of recordings, in four rows."""
    if "recordings" not in found:
        return None
    columns = [found["recordings"]["pooled"], found["bank"]["pooled"]]
    b, p = [c["boundaries"]["all"] for c in columns], [c["properties"] for c in columns]
    rows = [
        ["boundary error, median", *(milliseconds(x["median"]) for x in b)],
        ["90 % boundary intervals cover", *(covered(x, "coverage_90") for x in b)],
        [", ".join(PROPERTIES), *(", ".join(percent(x[k]["rms"], 2) for k in PROPERTIES) for x in p)],
        ["95 % property intervals cover", *(covered(x["all"], "coverage_95") for x in p)],
    ]
    cases = [f"{c['estimates']}" for c in columns]
    table = markdown(["", f"recordings ({cases[0]} cases)", f"virtual model ({cases[1]} cases)"], rows)
    return f"{table}\n\nFour trials a case; properties: rms relative error."


def results(found: dict, speed: dict) -> str | None:
    """docs/results.md: errors and coverage on two kinds of recordings, with the paper's errors below."""
    if "recordings" not in found:
        return None
    columns = [found["recordings"]["pooled"], found["bank"]["pooled"]]
    b, p = [c["boundaries"]["all"] for c in columns], [c["properties"] for c in columns]
    rows = [
        ["healthy cases (of four trials, pooled)", *(f"{c['estimates']}" for c in columns)],
        ["boundary error, median", *(milliseconds(x["median"]) for x in b)],
        ["boundary error, 95th percentile", *(milliseconds(x["percentile_95"]) for x in b)],
        ["90 % boundary intervals cover", *(covered(x, "coverage_90") for x in b)],
    ]
    rows += [[f"{key}, rms relative error", *(percent(x[key]["rms"], 2) for x in p)] for key in PROPERTIES]
    for level in ("95", "68"):
        cells = [covered(x["all"], f"coverage_{level}") for x in p]
        rows.append([f"{level} % property intervals cover", *cells])
    single = [found["recordings"]["single"], found["bank"]["single"]]
    rms = [", ".join(percent(c["properties"][k]["rms"], 2) for k in PROPERTIES) for c in single]
    rows.append(["weight, width, height from a single trial", *rms])
    theirs = ", ".join(f"{key} {PAPER[key]}" for key in PROPERTIES)
    note = (
        f"Coverages with their standard error over cases. The paper's own errors, of one recording: {theirs}."
    )
    seconds = speed["commands"]["identify"]["warm"]
    note += f" `hmmseg identify` of one trial takes {seconds:.1f} s of processor."
    note += f" Code of {found['made_by']}."
    head = ["", "stand-in recordings", "virtual model, fresh seeds"]
    return f"{markdown(head, rows)}\n\n{note}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="?")
    parser.add_argument("--cases", type=int, default=48)
    parser.add_argument("--output", type=Path, default=RESULTS / "calibration.json")
    options = parser.parse_args(arguments)
    document: dict = {"seed": SEED, "systematic_table": HAND.model_dump()}
    cases = {
        "bank": simulated_cases(options.cases),
        "systematic": simulated_cases(options.cases // 3, seed=SEED + 1000, systematic=HAND),
    }
    if options.recordings is not None:
        every = [read_case(folder) for folder in list_cases(options.recordings)]
        cases["recordings"] = [case for case in every if case.healthy]
    for name, mine in cases.items():
        document[name] = calibrate(mine, singles=None if name == "recordings" else 1)
        found = document[name]["pooled"]
        print(name, found["boundaries"]["all"], found["properties"]["all"], flush=True)
    save(options.output, document)


if __name__ == "__main__":
    main()
