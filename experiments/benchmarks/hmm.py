"""Alignment by hmmseg.hmm beside hmmlearn's kernel and dynamax: the same inputs and path, one run.

    python -m experiments.benchmarks.hmm [--small] [--parallel]

Writes experiments/results/benchmark_hmm.json and docs/figures/benchmarks.png. Every time is the least
processor time of several repeats, one thread, libraries in turn. General libraries take a matrix of
transitions and have no end-state constraint: the last row of what they are given forbids all states but
the last; dynamax takes trials of one length. With --parallel (for an accelerator) the recursions run by
associative scans, on wall time, on one stream of 1e6 and of 1e7 samples and on 4,096 trials, beside
torchaudio and torbi where they are installed, into benchmark_hmm_parallel.json.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax
import jax.numpy as jnp
import numpy as np

import hmmseg.hmm as hmm
from experiments.benchmarks.timing import least
from experiments.saving import save
from hmmseg.jaxconfig import configure

RESULTS = Path(__file__).parents[1] / "results"
FIGURE = Path(__file__).parents[2] / "docs" / "figures" / "benchmarks.png"
STATES = 9
SHORT = 100  # trials of 200 samples that one program aligns in turn
ON_HOST, BY_SCAN = "row by row, processor", "associative scan"
TORCHAUDIO, TORBI = "torchaudio.forced_align", "torbi"
INSIDE, CALLED, HMMLEARN, DYNAMAX = "inside jit", "as called", "hmmlearn's kernel", "dynamax"
Functions = dict[str, Callable[[], object]]


def problem(num_samples: int, seed: int = 0) -> np.ndarray:
    """Log-likelihoods (num_samples, STATES) of a signal that goes through levels two sd apart, in turn."""
    state = np.minimum(np.arange(num_samples) * STATES // num_samples, STATES - 1)
    signal = 2.0 * state + np.random.default_rng(seed).normal(size=num_samples)
    return -0.5 * (signal[:, None] - 2.0 * np.arange(STATES)) ** 2


def general(chain: hmm.Chain) -> tuple[np.ndarray, np.ndarray]:
    """Initial and transition probabilities, which libraries of general models take."""
    return np.eye(STATES)[0], np.diag(np.exp(chain.bands[0])) + np.diag(np.exp(chain.bands[1]), 1)


def ended(x: np.ndarray) -> np.ndarray:
    """Log-likelihoods that force the last state at the end."""
    out = np.array(x)
    out[-1, :-1] = -np.inf
    return out


def in_turn(num_samples: int, num: int) -> tuple[Functions, Functions]:
    """Functions that align recordings of one length one after the other, and that smooth them.

    Several in one program, as the call of a program takes as long as one short recording.
    """
    xs = np.stack([problem(num_samples, seed) for seed in range(num)])
    chain = hmm.left_to_right([num_samples / STATES] * STATES)
    start, matrix = general(chain)
    inside, forced = jnp.asarray(xs), np.stack([ended(x) for x in xs])
    best = jax.jit(lambda xs: jax.lax.map(lambda x: hmm.viterbi(x, chain).starts, xs))
    soft = jax.jit(lambda xs: jax.lax.map(lambda x: hmm.smooth(x, chain).smoothed, xs))
    paths: Functions = {
        INSIDE: lambda: np.asarray(best(inside)),
        CALLED: lambda: np.stack([hmm.viterbi(x, chain).starts for x in xs]),
    }
    smoothers: Functions = {INSIDE: lambda: soft(inside).block_until_ready(),
                            CALLED: lambda: [hmm.smooth(x, chain) for x in xs]}  # fmt: skip
    try:
        from hmmlearn import _hmmc

        paths[HMMLEARN] = lambda: np.stack([first_of(_hmmc.viterbi(start, matrix, x)[1]) for x in forced])
        smoothers[HMMLEARN] = lambda: [(_hmmc.forward_log(start, matrix, x),
                                        _hmmc.backward_log(start, matrix, x)) for x in forced]  # fmt: skip
    except ImportError:
        pass
    try:
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode, hmm_smoother

        first, between, given = (jnp.asarray(a) for a in (start, matrix, forced))
        mode = jax.jit(lambda xs: jax.lax.map(lambda x: hmm_posterior_mode(first, between, x), xs))
        smoother = jax.jit(
            lambda xs: jax.lax.map(lambda x: hmm_smoother(first, between, x).smoothed_probs, xs)
        )
        paths[DYNAMAX] = lambda: np.stack([first_of(path) for path in np.asarray(mode(given))])
        smoothers[DYNAMAX] = lambda: smoother(given).block_until_ready()
    except ImportError:
        pass
    return paths, smoothers


def many(num: int) -> Functions:
    """Functions that align trials of ragged lengths up to 200 in one batch."""
    lengths = np.random.default_rng(1).integers(150, 201, num)
    tables = [problem(int(n), seed) for seed, n in enumerate(lengths)]
    chain = hmm.left_to_right([22.0] * STATES)
    start, matrix = general(chain)
    padded = np.zeros((num, 200, STATES))
    for into, x in zip(padded, tables, strict=True):
        into[: len(x)] = x
    together = jnp.asarray(padded)
    batch = jax.jit(jax.vmap(lambda x, n: hmm.viterbi(x, chain, n).starts))
    functions: Functions = {
        INSIDE: lambda: np.asarray(batch(together, lengths)),
        CALLED: lambda: np.stack([hmm.viterbi(x, chain).starts for x in tables]),
    }
    try:
        from hmmlearn import _hmmc

        forced = [ended(x) for x in tables]
        functions[HMMLEARN] = lambda: np.array([first_of(_hmmc.viterbi(start, matrix, x)[1]) for x in forced])
    except ImportError:
        pass
    try:
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode

        mode = jax.jit(jax.vmap(hmm_posterior_mode, (None, None, 0)))
        given = [jnp.asarray(a) for a in (start, matrix, padded)]
        functions[DYNAMAX] = lambda: mode(*given).block_until_ready()  # of the padding, too
    except ImportError:
        pass
    return functions


def first_of(path: object) -> np.ndarray:
    """Where each state begins in a path (num_samples,)."""
    return np.searchsorted(np.asarray(path), np.arange(STATES))


def measured(functions: Functions, seconds: float) -> dict:
    """Times of all, and whether those that give where states begin agree."""
    starts = [found for f in functions.values() if isinstance(found := f(), np.ndarray)]
    agree = all((found == starts[0]).all() for found in starts[1:])
    return {"seconds": least(functions, seconds), "same": agree}


def on_accelerator(scale: int) -> dict:
    """Wall times [s] on the default device, log-likelihoods already there, libraries of PyTorch in turn.

    The reference is the recursion row by row on the processor of the same machine.
    """
    host = jax.devices("cpu")[0]
    found: dict = {"device": jax.devices()[0].device_kind, "jax": jax.__version__, "cases": {}}
    for num_samples in (1_000_000 // scale, 10_000_000 // scale):
        chain = hmm.left_to_right([num_samples / STATES] * STATES)
        x = problem(num_samples)
        functions = {ON_HOST: aligned(jax.device_put(x, host), chain, False)}
        functions[BY_SCAN] = aligned(jnp.asarray(x), chain, True)
        if num_samples <= 1_000_000:  # row by row, PyTorch's start a kernel for every sample
            functions |= of_torch(x[None], chain)
        title = f"one stream, {num_samples:,} x {STATES}"
        found["cases"]["path: " + title] = compared(functions)
        smoothers = {ON_HOST: smoothed(jax.device_put(x, host), chain, False),
                     BY_SCAN: smoothed(jnp.asarray(x), chain, True)}  # fmt: skip
        found["cases"]["posterior: " + title] = compared(smoothers)
    trials = np.stack([problem(200, seed) for seed in range(4096 // scale)])
    chain = hmm.left_to_right([200 / STATES] * STATES)
    functions = {ON_HOST: aligned(jax.device_put(trials, host), chain, False)}
    functions |= {BY_SCAN: aligned(jnp.asarray(trials), chain, True)}
    title = f"{len(trials):,} trials, 200 x {STATES}"
    found["cases"]["path: " + title] = compared(functions | of_torch(trials, chain))
    smoothers = {ON_HOST: smoothed(jax.device_put(trials, host), chain, False)}
    smoothers |= {BY_SCAN: smoothed(jnp.asarray(trials), chain, True)}
    found["cases"]["posterior: " + title] = compared(smoothers)
    return found


def aligned(x: jax.Array, chain: hmm.Chain, parallel: bool) -> Callable[[], np.ndarray]:
    """A function that aligns one recording, or trials of one length together, where `x` lies."""

    def one(x: jax.Array) -> jax.Array:
        return hmm.viterbi(x, chain, parallel=parallel).starts

    best = jax.jit(one if x.ndim == 2 else jax.vmap(one))
    return lambda: np.asarray(best(x))


def smoothed(x: jax.Array, chain: hmm.Chain, parallel: bool) -> Callable[[], object]:
    """A function that smooths one recording, or trials of one length together, where `x` lies."""

    def one(x: jax.Array) -> jax.Array:
        return hmm.smooth(x, chain, parallel=parallel).smoothed

    soft = jax.jit(one if x.ndim == 2 else jax.vmap(one))
    return lambda: soft(x).block_until_ready()


def of_torch(trials: np.ndarray, chain: hmm.Chain) -> dict[str, Callable[[], object]]:
    """Functions of torchaudio and torbi, as far as installed, that align trials (num, num_samples, STATES).

    torchaudio.functional.forced_align knows no weights of transitions (the same for every path here, as all
    advance as often) and takes one trial a call; its blank is made impossible.
    """
    functions: dict[str, Callable[[], object]] = {}
    try:
        import torch
        from torchaudio.functional import forced_align
    except ImportError:
        return functions
    device = "cuda" if torch.cuda.is_available() else "cpu"
    table = torch.tensor(trials, dtype=torch.float32, device=device)
    blank = torch.full((*table.shape[:2], 1), -torch.inf, device=device)
    emissions = torch.cat([blank, table], 2)
    target = torch.arange(1, STATES + 1, dtype=torch.int32, device=device)[None]
    functions[TORCHAUDIO] = lambda: np.stack(
        [first_of(path) for path in
         torch.cat([forced_align(each[None], target)[0] - 1 for each in emissions]).cpu().numpy()]
    )  # fmt: skip
    try:
        import torbi
    except Exception:  # it loads its own kernels, for some versions of PyTorch only
        return functions
    start, matrix = general(chain)
    with np.errstate(divide="ignore"):
        logs = [torch.tensor(np.maximum(np.log(a), -1e30), dtype=torch.float32, device=device)
                for a in (start, matrix)]  # fmt: skip
    forced = torch.tensor(np.maximum(np.stack([ended(x) for x in trials]), -1e30),
                          dtype=torch.float32, device=device)  # fmt: skip
    frames = torch.full((len(trials),), trials.shape[1], dtype=torch.int32, device=device)
    functions[TORBI] = lambda: np.stack(
        [
            first_of(path)
            for path in torbi.decode(forced, frames, logs[1].T.contiguous(), logs[0]).cpu().numpy()
        ]
    )
    return functions


def compared(functions: dict[str, Callable[[], object]]) -> dict:
    """Wall times; in how many trials each gives the first one's starts; how far its posterior is from it."""
    first = next(iter(functions.values()))()
    found: dict = {"seconds": {}, "same": {}, "largest difference": {}}
    for name, function in functions.items():
        try:
            found["seconds"][name] = wall(function)
            again = np.asarray(function())
            if isinstance(first, np.ndarray):
                found["same"][name] = float(np.mean((np.atleast_2d(again) == first).all(-1)))
            else:
                found["largest difference"][name] = float(np.abs(again - np.asarray(first)).max())
        except Exception as problem:  # a peer's, of which the rest is no less true
            found["seconds"][name] = None
            found["same"][name] = str(problem).splitlines()[0][:200]
    print(json.dumps(found), flush=True)
    return found


def wall(function: Callable[[], object], repeats: int = 5, seconds: float = 3.0) -> float:
    """Least wall time [s] of a call after one that warms up, of as many as about `seconds` allow."""
    function()
    best, spent = np.inf, 0.0
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        best = min(best, took := time.perf_counter() - began)
        spent += took
        if spent > seconds:
            break
    return best


def draw(document: dict) -> None:
    """Times of every library over ours inside jit, one group of bars a case."""
    from hmmseg.plot.style import BLUE, GREY, RED, SKY, canvas

    with canvas(FIGURE, 6.4, 2.6) as figure:
        axes = figure.subplots()
        for i, (name, colour) in enumerate(
            zip((INSIDE, CALLED, HMMLEARN, DYNAMAX), (BLUE, SKY, GREY, RED), strict=True)
        ):
            times = [case["seconds"] for case in document["cases"].values()]
            at = [(c, t[name] / t[INSIDE]) for c, t in enumerate(times) if name in t]
            axes.bar([c + 0.2 * (i - 1.5) for c, _ in at], [r for _, r in at], 0.18, color=colour, label=name)
        axes.axhline(1.0, color="k", linewidth=0.6)
        axes.set(yscale="log", ylabel="processor time over hmmseg's inside jit", xticks=range(len(times)))
        axes.set_xticklabels(
            [title.replace(": ", ":\n").replace(", ", "\n", 1) for title in document["cases"]]
        )
        axes.legend(ncols=4, loc="upper left", bbox_to_anchor=(0.0, 1.18), frameon=False)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the samples and repeats")
    parser.add_argument(
        "--parallel", action="store_true", help="associative scans on this machine's accelerator"
    )
    args = parser.parse_args()
    configure()
    scale, seconds = (10, 0.2) if args.small else (1, 1.0)
    if args.parallel:
        document = on_accelerator(scale)
        save(RESULTS / "benchmark_hmm_parallel.json", document)
    else:
        trial, stream = in_turn(200, SHORT), in_turn(1_000_000 // scale, 1)
        document = {
            "versions": {name: importlib.metadata.version(name) for name in ("jax", "numpy", "hmmseg")},
            "small": args.small,
            "cases": {
                f"path: {SHORT} trials in turn, 200 x 9": measured(trial[0], seconds),
                f"path: {4096 // scale:,} trials, 150 to 200 x 9": measured(many(4096 // scale), seconds),
                f"path: one stream, {1_000_000 // scale:,} x 9": measured(stream[0], seconds),
                f"posterior: {SHORT} trials in turn, 200 x 9": measured(trial[1], seconds),
                f"posterior: one stream, {1_000_000 // scale:,} x 9": measured(stream[1], seconds),
            },
        }
        for name in ("hmmlearn", "dynamax"):
            try:
                document["versions"][name] = importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                document["versions"][name] = "not installed"
        save(RESULTS / "benchmark_hmm.json", document)
        draw(document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
