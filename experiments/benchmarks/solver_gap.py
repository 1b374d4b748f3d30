"""Candidates of a gap by our solver, by SciPy and by optimistix (for experiments.benchmarks.solvers)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.benchmarks.solver_scales import Solve, aligned_trials

SETS = ((), ("force_bias",), ("force_bias", "force_gain"))  # candidates that are fitted
COLUMNS = 16  # that optimistix's one program has room for


def gap_problem(folder: Path):
    """The problem of the gap's candidates, and the start of each."""
    from simgap.gap.frame import build
    from simgap.gap.problem import Start, neutral, problem

    given = problem(build(aligned_trials(folder)))
    return given, [Start(effects, neutral(given)) for effects in SETS]


def gap_ours(folder: Path) -> Solve:
    """Levenberg-Marquardt of simgap.gap.problem: differences of rows that one program evaluates."""
    given, starts = gap_problem(folder)

    def solve() -> tuple[list[float], list[np.ndarray]]:
        from simgap.gap.problem import fit

        found = [fit(given, start) for start in starts]
        return [f.cost for f in found], [f.u[f.columns] for f in found]

    return solve


def _blocks(given, start) -> list[np.ndarray]:
    """Places of each effect's parameters among the free columns."""
    from simgap.effects import free_parameters

    out, at = [], given.num_properties
    for key in start.effects:
        out.append(np.arange(at, at + len(free_parameters(key))))
        at += out[-1].size
    return out


def _place(given, start):
    """Free columns of a start, their limits and their first values."""
    from simgap.gap.problem import columns_of, limits

    mine = columns_of(given, start.effects)
    low, high = (edge[mine] for edge in limits(given))
    return mine, low, high, np.clip(start.u[mine], low, high)


def gap_scipy(folder: Path) -> Solve:
    """Trust-region least squares by SciPy within the same limits, on our rows and differences.

    Doubts and each effect's Cauchy prior are rows as well: the root of twice their cost.
    """
    given, starts = gap_problem(folder)

    def one(start) -> tuple[float, np.ndarray]:
        from scipy.optimize import least_squares

        from simgap.gap.problem import evaluated

        mine, low, high, begin = _place(given, start)
        blocks, z, known = _blocks(given, start), given.num_properties, {}

        def at(x: np.ndarray):
            if x.tobytes() not in known:
                u = start.u.copy()
                u[mine] = x
                known[x.tobytes()] = evaluated(given, start.effects, u, mine, blocks)
            return known[x.tobytes()]

        def rows(x: np.ndarray) -> np.ndarray:
            prior = [np.sqrt((1 + b.size) * np.log1p(x[b] @ x[b])) for b in blocks]
            return np.concatenate([at(x).residual, x[:z], prior, [np.sqrt(2 * at(x).doubts + 1e-12)]])

        def slopes(x: np.ndarray) -> np.ndarray:
            now, prior = at(x), np.zeros((len(blocks), x.size))
            for row, b in zip(prior, blocks, strict=True):
                square = x[b] @ x[b]
                root = np.sqrt((1 + b.size) * np.log1p(square))
                row[b] = (1 + b.size) * x[b] / (1 + square) / max(root, 1e-9)
            doubt = now.lift / np.sqrt(2 * now.doubts + 1e-12)
            return np.concatenate([now.push, np.eye(z, x.size), prior, doubt[None]])

        found = least_squares(rows, begin, slopes, bounds=(low, high), x_scale="jac", ftol=1e-6)  # type: ignore[arg-type]
        return at(found.x).cost, found.x

    def solve() -> tuple[list[float], list[np.ndarray]]:
        found = [one(start) for start in starts]
        return [cost for cost, _ in found], [x for _, x in found]

    return solve


def _padded(values: np.ndarray) -> np.ndarray:
    """Values (K,) with zeros up to COLUMNS."""
    return np.concatenate([values, np.zeros(COLUMNS - values.size, values.dtype)])


def gap_optimistix(folder: Path) -> Solve:
    """Levenberg-Marquardt by optimistix, one program for all candidates.

    Derivatives are differences, as ours are. It knows no bounds: unknowns are clipped to theirs before they
    are used.
    """
    given, starts = gap_problem(folder)

    @lru_cache
    def program():
        import equinox
        import jax
        import jax.numpy as jnp
        import optimistix

        from simgap.gap.problem import STEP, corrected, whitened

        (world, arrays, w), z = given.constants, given.num_properties

        def rows(y, args):
            base, mine, there, on, low, high, member, size = args
            x = jnp.clip(y, low, high) * there
            u = base.at[mine].add(x)
            properties = given.centre + given.sd * u[:z].reshape(given.centre.shape)
            residual, doubts = whitened(corrected(world, u, on, z), arrays, w, properties)
            prior = jnp.sqrt((1 + size) * jnp.log1p(member @ jnp.square(x)) + 1e-12)
            return jnp.concatenate([residual.ravel(), x[:z], prior, jnp.sqrt(2 * doubts + 1e-12)[None]])

        solver = optimistix.LevenbergMarquardt(rtol=1e-4, atol=1e-4)

        @equinox.filter_jit
        def run(y, args):
            @jax.custom_jvp
            def here(y):
                return rows(y, args)

            @here.defjvp
            def slopes(at, along):
                (y,), (t,) = at, along
                now = rows(y, args)
                return now, (rows(y + STEP * t, args) - now) / STEP

            return optimistix.least_squares(
                lambda y, _: here(y), solver, y, options={"jac": "fwd"}, max_steps=60, throw=False
            ).value

        return run

    def one(start) -> tuple[float, np.ndarray]:
        import jax
        import jax.numpy as jnp

        from simgap.gap.problem import _on, evaluated

        mine, low, high, begin = _place(given, start)
        blocks = _blocks(given, start)
        member, size = np.zeros((2, COLUMNS)), np.zeros(2)
        for k, b in enumerate(blocks):
            member[k, b], size[k] = 1.0, b.size
        u = start.u.copy()
        u[mine] = 0.0
        args = (u, _padded(mine), _padded(np.ones(mine.size)), _on(given, start.effects),
                _padded(low), _padded(high), member, size)  # fmt: skip
        y = program()(jnp.asarray(_padded(begin)), jax.tree.map(jnp.asarray, args))
        u[mine] = np.clip(np.asarray(y)[: mine.size], low, high)
        return evaluated(given, start.effects, u, mine, blocks).cost, u[mine]

    def solve() -> tuple[list[float], list[np.ndarray]]:
        found = [one(start) for start in starts]
        return [cost for cost, _ in found], [x for _, x in found]

    return solve
