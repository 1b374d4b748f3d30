"""Which solver for which problem: SciPy, optimistix and our own on the same real problems.

    python -m experiments.benchmarks.solvers RECORDING_FOLDER

Three problems of one recording: the mode of the scales (6 unknowns), candidates of the gap fitted within
limits (up to 16 unknowns, some 5,000 residuals), and the quadratic with bounds that every set of effects is
weighed by. Every solver runs in processes of its own, from the import of its library on: with an empty
compilation cache, with what the first run left there, and once more in the same process. Processor time.
Writes experiments/results/benchmark_solvers.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.benchmarks.solver_gap import gap_optimistix, gap_ours, gap_problem, gap_scipy
from experiments.benchmarks.solver_scales import Solve, scales_optimistix, scales_scipy
from experiments.saving import save

OUT = Path(__file__).parents[1] / "results" / "benchmark_solvers.json"
REPEATS = 3


def quadratics(folder: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """matrix, pull, low, high of every pair of candidates of a gap, groups counting alike."""
    from simgap.attribution.posterior import forms, quadratic_forms
    from simgap.gap.assemble import gap_of
    from simgap.gap.problem import fit
    from simgap.gap.search import best_fit, candidate_names, shifting

    given, starts = gap_problem(folder)
    healthy = fit(given, starts[0])
    fits = [best_fit(given, key, healthy) for key in shifting(candidate_names(given.frame.rig))]
    f = forms(gap_of(given, healthy, fits))
    out, count = [], len(f.gap.candidates)
    for i in range(count):
        for j in range(i + 1, count):
            taken = quadratic_forms(f, (i, j))
            bend, pull = taken.weighed(np.ones(f.count.size))
            out.append((bend + np.eye(taken.low.size), pull, taken.low, taken.high))
    return out


def _value(matrix: np.ndarray, pull: np.ndarray, x: np.ndarray) -> float:
    return float(0.5 * x @ matrix @ x - pull @ x)


def _each(folder: Path, one: Callable) -> Solve:
    problems = quadratics(folder)

    def solve() -> tuple[list[float], list[np.ndarray]]:
        found = [np.clip(one(*p), p[2], p[3]) for p in problems]
        return [_value(p[0], p[1], x) for p, x in zip(problems, found, strict=True)], found

    return solve


def quadratic_ours(folder: Path) -> Solve:
    """The pivoting of simgap.bounded."""

    def one(matrix, pull, low, high):
        from simgap.bounded import least

        return least(matrix, pull, low, high)[0]

    return _each(folder, one)


def quadratic_scipy(folder: Path) -> Solve:
    """Bounded linear least squares by SciPy (BVLS) on the matrix's factor."""

    def one(matrix, pull, low, high):
        from scipy.optimize import lsq_linear

        factor = np.linalg.cholesky(matrix)
        return lsq_linear(factor.T, np.linalg.solve(factor, pull), (low, high), method="bvls").x

    return _each(folder, one)


SOLVERS: dict[str, dict[str, Callable[[Path], Solve]]] = {
    "mode of the scales": {"SciPy BFGS": scales_scipy, "optimistix BFGS": scales_optimistix},
    "candidates of the gap": {
        "our Levenberg-Marquardt": gap_ours,
        "SciPy least_squares": gap_scipy,
        "optimistix LevenbergMarquardt": gap_optimistix,
    },
    "quadratic with bounds": {"our pivoting": quadratic_ours, "SciPy lsq_linear": quadratic_scipy},
}


def one(problem: str, solver: str, folder: Path) -> dict:
    """First and warm times of a solver in this process, and what it reached."""
    import jax

    from hmmseg.jaxconfig import double_precision

    solve = double_precision(SOLVERS[problem][solver](folder))
    jax.clear_caches()  # what the problem's own making compiled is not told here
    began = time.process_time()
    costs, values = solve()
    first = time.process_time() - began
    warm = []
    for _ in range(REPEATS):
        began = time.process_time()
        costs, values = solve()
        warm.append(time.process_time() - began)
    return {"first": first, "warm": min(warm), "costs": costs, "values": [v.tolist() for v in values]}


def main() -> None:
    """Measure every solver in processes of its own, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--one", nargs=2, metavar=("PROBLEM", "SOLVER"))
    given = parser.parse_args()
    if given.one:
        from hmmseg.jaxconfig import configure

        configure()
        print(json.dumps(one(*given.one, given.folder)))
        return
    document: dict = {"recording": given.folder.name, "problems": {}}
    for problem, solvers in SOLVERS.items():
        rows = {}
        for solver in solvers:
            with tempfile.TemporaryDirectory() as cache:
                runs = [_process(given.folder, problem, solver, cache) for _ in range(2)]
            rows[solver] = {"first": runs[0]["first"], "cached": runs[1]["first"],
                            "warm": min(r["warm"] for r in runs), "costs": runs[1]["costs"]}  # fmt: skip
            print(problem, solver, {k: v for k, v in rows[solver].items() if k != "costs"}, flush=True)
        best = np.min([row["costs"] for row in rows.values()], axis=0)
        for row in rows.values():
            row["above_best"] = float(np.max(np.array(row.pop("costs")) - best))
        document["problems"][problem] = {"number": len(best), "solvers": rows}
    save(OUT, document)


def _process(folder: Path, problem: str, solver: str, cache: str) -> dict:
    import os

    command = [sys.executable, "-m", "experiments.benchmarks.solvers", str(folder), "--one", problem, solver]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
