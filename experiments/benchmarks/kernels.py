"""The alignment kernels beside what anyone would pick instead: the same inputs, the same path, one run.

    python -m experiments.benchmarks.kernels [--small]

Writes experiments/results/benchmark_kernels.json. Every time is the least of several repeats on the
processor's clock (wall time of a busy machine says little), one thread; ratios are to the limit, a plain
loop over the band compiled by numba. A peer that is not installed (`pip install hmmseg[bench]`) is left out
and said so.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numba
import numpy as np

import hmmseg.hmm as hmm
from experiments.saving import save
from hmmseg.jaxconfig import configure

OUT = Path(__file__).parents[1] / "results" / "benchmark_kernels.json"
SEPARATION = 2.0  # sds between the states' means: paths are determined, not trivial


@numba.njit(nogil=True)
def _limit(x, stay, advance, came, starts):
    """The least that a Viterbi path of a chain can cost: one pass, one comparison a cell."""
    num_rows, num_states = x.shape
    delta = np.full(num_states, -np.inf)
    delta[0] = x[0, 0]
    for t in range(1, num_rows):
        for k in range(num_states - 1, 0, -1):
            moved, stayed = delta[k - 1] + advance[k - 1], delta[k] + stay[k]
            came[t, k] = moved > stayed
            delta[k] = (moved if moved > stayed else stayed) + x[t, k]
        delta[0] += stay[0] + x[t, 0]
    k = num_states - 1
    for t in range(num_rows - 1, 0, -1):
        if k > 0 and came[t, k]:
            starts[k] = t
            k -= 1
    return delta[-1]


def limit(x: np.ndarray, chain: hmm.Chain) -> np.ndarray:
    """First samples of the states by the plain loop, tables made before."""
    starts = np.zeros(x.shape[1], np.int64)
    _limit(x, chain.bands[0], chain.bands[1], np.empty(x.shape, np.bool_), starts)
    return starts


def problem(num_samples: int, num_states: int, seed: int = 0) -> np.ndarray:
    """Log-likelihoods of a signal that goes through the states in turn."""
    rng = np.random.default_rng(seed)
    state = np.minimum(np.arange(num_samples) * num_states // num_samples, num_states - 1)
    signal = SEPARATION * state + rng.normal(size=num_samples)
    return -0.5 * (signal[:, None] - SEPARATION * np.arange(num_states)) ** 2


def least(function: Callable[[], object], seconds: float, most: int = 2000) -> float:
    """Least processor time [s] of a call, after one that warms up; calls repeat over `seconds`."""
    function()
    times: list[float] = []
    until = time.process_time() + seconds
    while len(times) < 3 or (time.process_time() < until and len(times) < most):
        began = time.process_time_ns()
        function()
        times.append((time.process_time_ns() - began) * 1e-9)
    return min(times)


def matrix(chain: hmm.Chain) -> np.ndarray:
    """Transition probabilities (num_states, num_states), which libraries of general models take."""
    return np.diag(np.exp(chain.bands[0])) + np.diag(np.exp(chain.bands[1]), 1)


def peers(x: np.ndarray, chain: hmm.Chain) -> dict[str, Callable[[], np.ndarray]]:
    """Viterbi paths by other libraries and by ours, as functions of nothing that give states or starts."""
    import jax
    import jax.numpy as jnp

    from hmmseg.hmm import banded

    found: dict[str, Callable[[], np.ndarray]] = {}
    dense, num_states = matrix(chain), x.shape[1]
    start = np.eye(num_states)[0]
    ended = np.array(x)
    ended[-1, :-1] = -np.inf  # they have no end-state constraint
    try:
        from hmmlearn import _hmmc

        found["hmmlearn's kernel"] = lambda: np.asarray(_hmmc.viterbi(start, dense, ended)[1])
    except ImportError:
        pass
    try:
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode

        mode = jax.jit(hmm_posterior_mode)
        arguments = [jnp.asarray(a) for a in (start, dense, ended)]
        found["dynamax"] = lambda: np.asarray(mode(*arguments))
    except ImportError:
        pass
    jitted = jax.jit(lambda ll, stay, advance: banded.viterbi(ll, stay, advance).path)
    inside = [jnp.asarray(a) for a in (x, *chain.bands)]
    found["hmmseg, JAX inside jit"] = lambda: np.asarray(jitted(*inside))
    single = x.astype(np.float32)
    found["hmmseg, float32, as called"] = lambda: hmm.viterbi(single, chain).starts
    found["hmmseg, float64, as called"] = lambda: hmm.viterbi(x, chain).starts
    return found


def one_stream(num_samples: int, num_states: int, seconds: float, slow: bool = True) -> dict:
    """One recording: times, ratios to the limit, and whether the paths agree."""
    x = problem(num_samples, num_states)
    chain = hmm.left_to_right([num_samples / num_states] * num_states)
    reference = limit(x, chain)
    least_time = least(lambda: limit(x, chain), seconds)
    rows = {}
    for name, function in peers(x, chain).items():
        if not slow and name.startswith(("hmmlearn", "dynamax")) and num_states > 50:
            continue
        path = function()
        starts = path if path.size == num_states else np.searchsorted(path, np.arange(num_states))
        rows[name] = {"seconds": least(function, seconds), "same_path": bool((starts == reference).all())}
    smoothing = {"hmmseg": least(lambda: hmm.smooth(x, chain), seconds)}
    try:
        from hmmlearn import _hmmc

        if num_states <= 50:
            dense, start = matrix(chain), np.eye(num_states)[0]
            smoothing["hmmlearn's kernels"] = least(
                lambda: (_hmmc.forward_log(start, dense, x), _hmmc.backward_log(start, dense, x)), seconds
            )
    except ImportError:
        pass
    for row in rows.values():
        row["ratio"] = row["seconds"] / least_time
    own = rows["hmmseg, float64, as called"]["seconds"]
    return {
        "samples": num_samples, "states": num_states, "limit": least_time, "viterbi": rows,
        "smoothing": smoothing, "smoothing_over_viterbi": smoothing["hmmseg"] / own,
    }  # fmt: skip


def many(num: int, seconds: float) -> dict:
    """Trials of ragged lengths up to 200 in one batch, one thread each."""
    rng = np.random.default_rng(1)
    tables = [problem(int(n), 9, seed) for seed, n in enumerate(rng.integers(150, 201, num))]
    chain = hmm.left_to_right([22.0] * 9)
    reference = np.array([limit(x, chain) for x in tables])
    limit_time = least(lambda: [limit(x, chain) for x in tables], seconds)
    ours = least(lambda: hmm.viterbi(tables, chain), seconds)
    found = hmm.viterbi(tables, chain)
    row = {"seconds": ours, "ratio": ours / limit_time, "same_path": bool((found.starts == reference).all())}
    rows = {"hmmseg, float64, as called": row}
    try:
        from hmmlearn import _hmmc

        dense, start = matrix(chain), np.eye(9)[0]
        t = least(lambda: [_hmmc.viterbi(start, dense, x) for x in tables], seconds)
        rows["hmmlearn's kernel"] = {"seconds": t, "ratio": t / limit_time}
    except ImportError:
        pass
    return {"trials": num, "limit": limit_time, "viterbi": rows}


def exactness(num_samples: int) -> dict:
    """Labels that single precision moves, states half a standard deviation apart."""
    rng = np.random.default_rng(2)
    state = np.minimum(np.arange(num_samples) * 9 // num_samples, 8)
    signal = 0.5 * state + rng.normal(size=num_samples)
    single = (-0.5 * (signal[:, None] - 0.5 * np.arange(9)) ** 2).astype(np.float32)
    chain = hmm.left_to_right([num_samples / 9] * 9)
    moved = hmm.viterbi(single, chain).starts != hmm.viterbi(single.astype(np.float64), chain).starts
    return {"samples": num_samples, "moved": int(moved.sum())}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the samples and repeats")
    args = parser.parse_args()
    configure()
    scale, seconds = (10, 0.2) if args.small else (1, 1.0)
    versions = {name: _version(name) for name in ("hmmlearn", "dynamax", "jax", "numba", "numpy", "hmmseg")}
    document = {
        "versions": versions, "machine": platform.machine(), "small": args.small,
        "repeats": f"least of those that fit in {seconds} s of processor, at least 3",
        "one trial": one_stream(200, 9, seconds),
        "4,096 trials": many(4096 // scale, seconds),
        "one stream": one_stream(1_000_000 // scale, 9, seconds),
        "many states": one_stream(100_000 // scale, 101, seconds, slow=False),
        "exactness": exactness(10_000_000 // scale),
    }  # fmt: skip
    for name, key in (("hmmlearn", "hmmlearn's kernel"), ("dynamax", "dynamax")):
        if key not in document["one trial"]["viterbi"]:
            versions[name] = None  # not there, or not to be imported beside the others
    save(OUT, document)
    print(json.dumps(document, indent=1))


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    main()
