"""The mode of the scales, by SciPy and by optimistix (for experiments.benchmarks.solvers)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

STEPS = 1e-3 * np.eye(6)  # of the scales, for differences
# What a run gives: the cost of each solution, and the solutions.
Solve = Callable[[], tuple[list[float], list[np.ndarray]]]


def aligned_trials(folder: Path):
    """The trials of a folder, aligned."""
    from hmmseg.hand.read import read_trial
    from hmmseg.io.rig import read_rig
    from hmmseg.io.task import read_task
    from hmmseg.segmentation.align import align

    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    trials = [read_trial(path, rig) for path in sorted(folder.glob("trial_*.csv"))]
    return align(trials, task, rig)


def scales_problem(folder: Path):
    """The posterior whose mode `identify` seeks."""
    from estimation.design import build
    from estimation.observations import aligned_weights
    from estimation.posterior import posterior

    aligned = aligned_trials(folder)
    weighed, noise = aligned_weights(aligned, np.random.default_rng(0))
    return posterior(build(aligned, weighed, noise))


def scales_optimistix(folder: Path) -> Solve:
    """BFGS by optimistix, as `identify` has it."""
    post = scales_problem(folder)
    post.log_prob(np.zeros((1, 6)))  # its tables are part of the problem

    def climb() -> np.ndarray:
        from estimation.posterior import find_mode

        return find_mode(post).scales

    return _solve(post, climb)


def scales_scipy(folder: Path) -> Solve:
    """BFGS by SciPy from the same start, with derivatives and curvature by central differences."""
    post = scales_problem(folder)
    post.log_prob(np.zeros((1, 6)))

    def gradient(x: np.ndarray) -> np.ndarray:
        up, down = np.split(post.log_prob(np.concatenate([x + STEPS, x - STEPS])), 2)
        return -(up - down) / (2 * STEPS[0, 0])

    def climb() -> np.ndarray:
        from scipy.optimize import minimize

        from estimation.posterior import start_of

        found = minimize(lambda x: -float(post.log_prob(x[None])[0]), start_of(post), jac=gradient,
                         method="BFGS", options={"gtol": 1e-4}).x  # fmt: skip
        assert np.isfinite([gradient(found + h) - gradient(found - h) for h in STEPS]).all()
        return found

    return _solve(post, climb)


def _solve(post, climb: Callable[[], np.ndarray]) -> Solve:
    def solve() -> tuple[list[float], list[np.ndarray]]:
        found = climb()
        return [-float(post.log_prob(found[None])[0])], [found]

    return solve
