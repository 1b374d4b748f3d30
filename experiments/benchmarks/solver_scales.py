"""The mode of the scales, by SciPy and by optimistix (for experiments.benchmarks.solvers)."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

# What a run gives: the cost of each solution, and the solutions.
Solve = Callable[[], tuple[list[float], list[np.ndarray]]]


def aligned_trials(folder: Path):
    """Trials, their alignment and their rig."""
    from hmmseg.io.rig import read_rig
    from hmmseg.io.task import read_task
    from hmmseg.io.trial import read_trial
    from hmmseg.segmentation.align import align

    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    trials = [read_trial(path, rig) for path in sorted(folder.glob("trial_*.csv"))]
    return trials, align(trials, task, rig), rig


def scales_problem(folder: Path):
    """The posterior whose mode `identify` seeks."""
    from estimation.design import build
    from estimation.observations import aligned_weights
    from estimation.posterior import posterior

    trials, aligned, rig = aligned_trials(folder)
    weighed, noise = aligned_weights(aligned, np.random.default_rng(0))
    return posterior(build(trials, weighed, noise, aligned.task, rig))


def scales_scipy(folder: Path) -> Solve:
    """BFGS by SciPy, as `identify` has it."""
    post = scales_problem(folder)
    post.log_prob(np.zeros((1, 6)))  # its tables are part of the problem

    def solve() -> tuple[list[float], list[np.ndarray]]:
        from estimation.mode import find_mode

        mode = find_mode(post)
        return [-float(post.log_prob(mode.scales[None])[0])], [mode.scales]

    return solve


def scales_optimistix(folder: Path) -> Solve:
    """BFGS by optimistix from the same start, the objective written again in JAX."""
    from estimation.mode import _start

    post = scales_problem(folder)
    start = _start(post)

    @lru_cache
    def program():
        import equinox
        import jax
        import optimistix

        cost, solver = jax_objective(post), optimistix.BFGS(rtol=1e-6, atol=1e-6)

        @equinox.filter_jit
        def run(x, data):
            found = optimistix.minimise(cost, solver, x, data, throw=False).value
            return found, jax.hessian(cost)(found, data)  # find_mode has it too

        return run

    def solve() -> tuple[list[float], list[np.ndarray]]:
        import jax.numpy as jnp

        found, hessian = program()(jnp.asarray(start), jax_tables(post))
        assert np.isfinite(np.asarray(hessian)).all()
        x = np.asarray(found)
        return [-float(post.log_prob(x[None])[0])], [x]

    return solve


def jax_tables(post):
    """Arrays that the JAX objective takes: of each channel its count, table and places in the hand."""
    import jax.numpy as jnp

    tables = tuple(jnp.asarray(t.values) for t in post._tables)
    return tables, *(jnp.asarray(z) for z in (post.hand_precision, post.hand_gradient, post.scale_sd))


def jax_objective(post):
    """Minus `post.log_prob` of scales (6,), in JAX."""
    import jax.numpy as jnp
    from jax.scipy.linalg import solve_triangular

    from estimation import priors
    from estimation.posterior import NUM_CHANNELS, REACH, STEP

    num, counts = len(post.design.nuisances), [t.count for t in post._tables]
    size = num + 2 * NUM_CHANNELS

    def cost(theta, data):
        tables, hand_precision, hand_gradient, scale_sd = data
        log_s = theta[:NUM_CHANNELS]
        own = (jnp.asarray(priors.SCATTER_MEDIAN) * jnp.exp(theta[NUM_CHANNELS:])) ** 2
        common = jnp.concatenate(
            [jnp.asarray(priors.COMMON) ** 2 + own, jnp.asarray(post.design.slope_sd) ** 2 + own]
        )
        precision = jnp.zeros((size, size)).at[:num, :num].set(hand_precision)
        precision = precision + jnp.diag(jnp.concatenate([jnp.zeros(num), 1 / common]))
        gradient = jnp.zeros(size).at[:num].set(hand_gradient)
        out = -0.5 * jnp.sum((log_s / scale_sd) ** 2) - 0.5 * jnp.sum(jnp.log(common))
        out -= 0.5 * jnp.sum((theta[NUM_CHANNELS:] / jnp.asarray(priors.SCATTER_LOG_SD)) ** 2)
        for c, (count, values) in enumerate(zip(counts, tables, strict=True)):
            if not count:
                continue
            log_r = 2 * (theta[NUM_CHANNELS + c] - log_s[c])
            place = jnp.clip((log_r - REACH[0]) / STEP, 1, len(values) - 3.001)
            index = jnp.floor(place).astype(int)
            t = place - index
            weights = 0.5 * jnp.stack([
                t * (t * (2 - t) - 1), t**2 * (3 * t - 5) + 2, t * (t * (4 - 3 * t) + 1), t**2 * (t - 1)
            ])  # fmt: skip
            row = weights @ values[index + jnp.arange(-1, 3)]
            mine = np.array([*range(num), num + c, num + NUM_CHANNELS + c])
            quadratic, linear = row[2 : -mine.size].reshape(mine.size, mine.size), row[-mine.size :]
            weight = jnp.exp(-2 * log_s[c])
            precision = precision.at[np.ix_(mine, mine)].add(weight * quadratic)
            gradient = gradient.at[mine].add(weight * linear)
            out -= 0.5 * (2 * count * log_s[c] + row[1] + weight * row[0])
        chol = jnp.linalg.cholesky(precision)
        white = solve_triangular(chol, gradient, lower=True)
        return -(out + 0.5 * white @ white - jnp.log(jnp.diagonal(chol)).sum())

    return cost
