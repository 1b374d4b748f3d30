"""The alignment kernels beside what anyone would pick instead: the same inputs, the same path, one run.

    python -m experiments.benchmarks.kernels [--small]

Writes experiments/results/benchmark_kernels.json and docs/figures/benchmarks.png. Every time is the least of
several repeats on the processor's clock (wall time of a busy machine says little), one thread, libraries in
turn; ratios are to the limit, a plain loop over the band compiled by numba. Memory is the highest of a
process of its own above what it held with the input made.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numba
import numpy as np

import hmmseg.hmm as hmm
from experiments.benchmarks import peers
from experiments.benchmarks.timing import least
from experiments.saving import save
from hmmseg.jaxconfig import configure

OUT = Path(__file__).parents[1] / "results" / "benchmark_kernels.json"
FIGURE = Path(__file__).parents[2] / "docs" / "figures" / "benchmarks.png"
SEPARATION = 2.0  # sds between the states' means: paths are determined, not trivial
WEAK = 0.05  # the same of states that can hardly be told apart: many are probable at every sample
CHUNK = 1 << 16  # samples made at a time


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


def signal_of(num_samples: int, num_states: int, seed: int = 0, separation: float = SEPARATION) -> np.ndarray:
    """A signal that goes through the states in turn."""
    rng = np.random.default_rng(seed)
    state = np.minimum(np.arange(num_samples) * num_states // num_samples, num_states - 1)
    return separation * state + rng.normal(size=num_samples)


def problem(num_samples: int, num_states: int, seed: int = 0, separation: float = SEPARATION,
            dtype: type = np.float64) -> np.ndarray:  # fmt: skip
    """Its log-likelihoods (num_samples, num_states), made without holding more than them."""
    signal = signal_of(num_samples, num_states, seed, separation)
    out = np.empty((num_samples, num_states), dtype)
    for at in range(0, num_samples, CHUNK):
        part = slice(at, at + CHUNK)
        out[part] = -0.5 * (signal[part, None] - separation * np.arange(num_states)) ** 2
    return out


def chain_of(num_samples: int, num_states: int) -> hmm.Chain:
    """A chain in which all states last alike on average."""
    return hmm.left_to_right([num_samples / num_states] * num_states)


def one_stream(num_samples: int, num_states: int, seconds: float, general: bool = True,
               smoothed: bool = True) -> dict:  # fmt: skip
    """One recording: times, ratios to the limit, whether the paths agree; `general`: other libraries too."""
    x, chain = problem(num_samples, num_states), chain_of(num_samples, num_states)
    reference = limit(x, chain)
    functions = peers.paths(x, chain, jax_too=general)
    if not general:
        functions.pop(peers.HMMLEARN, None)
    same = {}
    for name, function in functions.items():
        path = function()
        starts = path if path.size == num_states else np.searchsorted(path, np.arange(num_states))
        same[name] = bool((starts == reference).all())
    if num_samples < 1000:
        functions |= peers.change_points(signal_of(num_samples, num_states), num_states)
    times = least({"limit": lambda: limit(x, chain), **functions}, seconds)
    rows = {name: {"seconds": times[name], "ratio": times[name] / times["limit"], "same_path": same.get(name)}
            for name in functions}  # fmt: skip
    found = {"samples": num_samples, "states": num_states, "limit": times["limit"], "viterbi": rows}
    if smoothed:
        found |= smoothing(x, chain, seconds)
    return found


def smoothing(x: np.ndarray, chain: hmm.Chain, seconds: float) -> dict:
    """Forward-backward with boundary posteriors: times, ours also over our path's."""
    times = least({"viterbi": lambda: hmm.viterbi(x, chain), **peers.smoothers(x, chain)}, seconds)
    own = times.pop("viterbi")
    return {"smoothing": times, "smoothing_over_viterbi": times["hmmseg"] / own}


def many(num: int, seconds: float) -> dict:
    """Trials of ragged lengths up to 200 in one batch, one thread each."""
    lengths = np.random.default_rng(1).integers(150, 201, num)
    tables = [problem(int(n), 9, seed) for seed, n in enumerate(lengths)]
    chain = hmm.left_to_right([22.0] * 9)
    reference = np.array([limit(x, chain) for x in tables])
    found = hmm.viterbi(tables, chain)
    assert isinstance(found, hmm.Alignments)
    functions = {"limit": lambda: [limit(x, chain) for x in tables],
                 peers.DOUBLE: lambda: hmm.viterbi(tables, chain)}  # fmt: skip
    single = [x.astype(np.float32) for x in tables]
    functions[peers.SINGLE] = lambda: hmm.viterbi(single, chain)
    try:
        import jax
        import jax.numpy as jnp
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode

        padded = np.zeros((num, 200, 9))  # of one length, as it takes no others
        for row, x in zip(padded, tables, strict=True):
            row[: len(x)] = x
        mode = jax.jit(jax.vmap(hmm_posterior_mode, (None, None, 0)))
        arguments = [jnp.asarray(a) for a in (np.eye(9)[0], peers.matrix(chain), padded)]
        functions[peers.DYNAMAX] = lambda: np.asarray(mode(*arguments))
    except ImportError:
        pass
    try:
        from hmmlearn import _hmmc

        dense, start = peers.matrix(chain), np.eye(9)[0]
        functions[peers.HMMLEARN] = lambda: [_hmmc.viterbi(start, dense, x) for x in tables]
    except ImportError:
        pass
    times = least(functions, seconds)
    rows = {name: {"seconds": times[name], "ratio": times[name] / times["limit"], "same_path": None}
            for name in functions if name != "limit"}  # fmt: skip
    rows[peers.DOUBLE]["same_path"] = bool((found.starts == reference).all())
    return {"trials": num, "limit": times["limit"], "viterbi": rows}


def exactness(num_samples: int) -> dict:
    """Labels that single precision moves, states half a standard deviation apart."""
    import jax.numpy as jnp

    from experiments import jax_viterbi

    single = problem(num_samples, 9, 2, 0.5, np.float32)
    chain = chain_of(num_samples, 9)
    starts = {"host": hmm.viterbi(single, chain).starts}
    bands = [jnp.asarray(band, jnp.float32) for band in chain.bands]
    path = np.asarray(jax_viterbi.viterbi(single, *bands).path)
    starts["JAX"] = np.searchsorted(path, np.arange(9))
    reference = hmm.viterbi(single.astype(np.float64), chain).starts
    moved = {name: int(np.abs(found - reference).sum()) for name, found in starts.items()}
    return {"samples": num_samples, "moved": moved}


def memory(num_samples: int) -> dict:
    """Memory above the input [as a share of it] of one path, each in a process of its own."""
    shares = {}
    for name in (peers.DOUBLE, peers.SINGLE, peers.HMMLEARN, peers.DYNAMAX):
        command = [sys.executable, "-m", "experiments.benchmarks.kernels", "--memory", name, str(num_samples)]
        done = subprocess.run(command, capture_output=True, text=True)
        shares[name] = float(done.stdout) if done.returncode == 0 else None
    return {"samples": num_samples, "shares": shares}


def memory_of(name: str, num_samples: int) -> float:
    """Highest memory of this process during one path above that before it, over the input's size."""
    dtype = np.float32 if name in (peers.SINGLE, peers.DYNAMAX) else np.float64
    x, chain = problem(num_samples, 9, dtype=dtype), chain_of(num_samples, 9)
    x[-1, :-1] = -np.inf
    short = x[-1000:].copy()
    dense, start = peers.matrix(chain).astype(dtype), np.eye(9, dtype=dtype)[0]
    if name == peers.HMMLEARN:
        from hmmlearn import _hmmc

        run = lambda ll: _hmmc.viterbi(start, dense, ll)  # noqa: E731
    elif name == peers.DYNAMAX:
        import jax
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode

        x, short = jax.numpy.asarray(x), jax.numpy.asarray(short)
        run = lambda ll: jax.jit(hmm_posterior_mode)(start, dense, ll).block_until_ready()  # noqa: E731
    else:
        run = lambda ll: hmm.viterbi(ll, chain).starts  # noqa: E731
    run(short)
    Path("/proc/self/clear_refs").write_text("5")  # the highest so far is what is held now
    before = _held("VmRSS")
    run(x)
    return (_held("VmHWM") - before) / x.nbytes


def _held(which: str) -> float:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(which))
    return 1024.0 * float(line.split()[1])


def draw(document: dict) -> None:
    """Times of every library over the limit, one group of bars a case."""
    from experiments.table_speed import CASES
    from hmmseg.plot.style import BLUE, GREEN, GREY, ORANGE, RED, SKY, canvas

    names = (peers.DOUBLE, peers.SINGLE, peers.JAX_DOUBLE, peers.JAX_SINGLE, peers.HMMLEARN, peers.DYNAMAX)
    with canvas(FIGURE, 7.2, 2.9) as figure:
        axes = figure.subplots()
        for i, (name, colour) in enumerate(zip(names, (BLUE, SKY, GREEN, ORANGE, GREY, RED), strict=True)):
            at = [(c, document[case]["viterbi"][name]["ratio"]) for c, case in enumerate(CASES)
                  if name in document[case]["viterbi"]]  # fmt: skip
            axes.bar(
                [c + 0.13 * (i - 2.5) for c, _ in at], [r for _, r in at], 0.12, color=colour, label=name
            )
        axes.axhline(1.0, color="k", linewidth=0.6)
        axes.set(yscale="log", ylabel="time over a plain compiled loop", xticks=range(len(CASES)))
        axes.set_xticklabels([title.replace(", ", "\n", 1) for title in CASES.values()])
        axes.legend(ncols=3, loc="upper left", bbox_to_anchor=(0.0, 1.28))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the samples and repeats")
    parser.add_argument("--memory", nargs=2, metavar=("NAME", "SAMPLES"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.memory:
        print(memory_of(args.memory[0], int(args.memory[1])))
        return
    configure()
    scale, seconds = (10, 0.2) if args.small else (1, 1.0)
    document = {
        "versions": peers.versions(), "machine": platform.machine(), "small": args.small,
        "repeats": f"least of those that fit in {seconds} s of processor, at least 3, in turn",
        "one trial": one_stream(200, 9, seconds),
        "4,096 trials": many(4096 // scale, seconds),
        "one stream": one_stream(1_000_000 // scale, 9, seconds),
        "many states": one_stream(100_000 // scale, 101, seconds),
        "weakly apart": smoothing(problem(1_000_000 // scale, 9, separation=WEAK),
                                  chain_of(1_000_000 // scale, 9), seconds),
        "long and many": one_stream(1_000_000 // scale, 101, seconds, general=False, smoothed=False),
        "exactness": exactness(10_000_000 // scale),
        "memory": memory(10_000_000 // scale),
    }  # fmt: skip
    save(OUT, document)
    draw(document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
