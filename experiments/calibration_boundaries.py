"""Do 90 % boundary intervals hold in worlds that differ? A row a world, each trial by itself.

    python -m experiments.calibration_boundaries [--worlds NAME...] [--trials 16] [--first 76000]
    python -m experiments.calibration_boundaries --folders RECORDINGS...

The second form scores recordings with answers, cases pooled as they lie. Writes
experiments/results/calibration_boundaries.json (the first form only), which docs/boundaries.md shows.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.estimates import KINDS
from experiments.recordings import list_cases, read_case
from experiments.saving import save
from experiments.scoring import boundaries_covered, boundary_residuals
from experiments.worlds import WORLDS, scene, trials_of
from hmmseg.segmentation.align import segment
from hmmseg.segmentation.spans import Segmentation

RESULTS = Path(__file__).parent / "results"
FIRST, TRIALS = 115_000, 32
Scored = tuple[Segmentation, np.ndarray]


def score(pairs: Sequence[Scored]) -> dict:
    """Misfits and errors [ms], share of 90 % intervals that hold, and their half width [ms].

    Of trials that end as misfits nothing else is scored; by kind of boundary and of all.
    """
    fitting = [(s, truth) for s, truth in pairs if s.complete and np.isfinite(truth).all()]
    row: dict = {"trials": len(pairs), "misfits": sum(not s.complete for s, _ in pairs)}
    if not fitting:
        return row
    residual = 1e3 * np.stack([boundary_residuals(s, t) for s, t in fitting])
    inside = np.stack([boundaries_covered(s, t) for s, t in fitting])
    half = np.stack([[500 * (high - low) for low, high in (p.start_90 for p in s.spans[1:])]
                     for s, _ in fitting])  # fmt: skip
    every = [("all", slice(None)), *((k, slice(i, None, 4)) for i, k in enumerate(KINDS))]
    for name, kind in every:
        r, i, h = residual[:, kind], inside[:, kind], half[:, kind]
        row[name] = {
            "shift": float(np.median(r)), "median": float(np.median(np.abs(r))),
            "percentile_95": float(np.percentile(np.abs(r), 95)), "coverage_90": float(i.mean()),
            "percentile_90": float(np.percentile(np.abs(r), 90)), "half_width": float(np.median(h)),
            "se": float(np.std(i.mean(axis=1), ddof=1) / np.sqrt(len(i))) if len(i) > 1 else None,
        }  # fmt: skip
    return row


def line(name: str, row: dict) -> str:
    """A row for people."""
    if "all" not in row:
        return f"{name:28} {row['trials']:4} {row['misfits']:3} misfits"
    a = row["all"]
    kinds = "  ".join(f"{k[:5]} {100 * row[k]['coverage_90']:3.0f} {row[k]['shift']:+6.1f}" for k in KINDS)
    return (f"{name:28} {row['trials']:4} {row['misfits']:3}  {a['median']:6.2f} {a['percentile_95']:7.1f}  "
            f"+-{a['half_width']:5.1f}  {100 * a['coverage_90']:5.1f} %   {kinds}")  # fmt: skip


def world_rows(names: Sequence[str], trials: int, first: int) -> Iterator[tuple[str, dict]]:
    """A row for each world."""
    _, task = scene()
    for name in names:
        pairs = []
        for judged in trials_of(WORLDS[name], range(first, first + trials)):
            (found,) = segment([judged.trial], task, judged.rig)
            pairs.append((found, judged.boundaries))
        yield name, score(pairs)


def folder_rows(folder: Path) -> Iterator[tuple[str, dict]]:
    """A row for each case with answers, then one for all that are labelled healthy, and for the rest."""
    groups: dict[str, list[Scored]] = {"healthy": [], "others": []}
    for path in list_cases(folder):
        case = read_case(path)
        found = segment(case.trials, case.task, case.rig)
        pairs = [(s, np.asarray(t, float)) for s, t in zip(found, case.truth, strict=True) if t is not None]
        if pairs:
            groups["healthy" if case.healthy else "others"] += pairs
            yield case.name, score(pairs)
    for name, group in groups.items():
        same = {k: list(g) for k, g in itertools.groupby(sorted(group, key=_size), _size)}
        yield from ((f"{name}, {k} boundaries", score(pairs)) for k, pairs in same.items())


def _size(pair: Scored) -> int:
    return pair[1].size


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS), metavar="NAME")
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--first", type=int, default=FIRST)
    parser.add_argument("--folders", nargs="*", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS / "calibration_boundaries.json")
    options = parser.parse_args(arguments)
    if options.folders:
        for name, row in itertools.chain.from_iterable(map(folder_rows, options.folders)):
            print(line(name, row), flush=True)
        return
    began, rows = time.process_time(), {}
    for name, row in world_rows(options.worlds, options.trials, options.first):
        rows[name] = row
        print(line(name, row), flush=True)
    document = {"first": options.first, "rows": rows, "seconds": time.process_time() - began}
    save(options.output, document)


if __name__ == "__main__":
    main()
