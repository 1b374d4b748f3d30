"""A small network learns the phases of a snap assembly from their order alone.

    python -m experiments.real.hiro_network FOLDER

FOLDER is that of hiro_snap.py. Nobody tells the network where a phase begins: it is trained on the log
evidence of the known order, whose gradient is the posterior of the alignment (hmmseg.hmm.log_evidence),
with its outputs divided by how often it gives each phase, as hybrids of networks and hidden Markov models
do (Bourlard and Morgan, 1994). Trained and judged on the same trials, as `segment` without labels is;
labels only judge. Trials are cropped at the start by a random 0-3 s.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import hmmseg.hmm as hmm
from experiments.real.hiro_snap import KINDS, MAX_CROP, WRENCH_AND_POSE, cropped, read_kind, without_labels
from experiments.saving import save
from hmmseg.io.trial import Trial

RATE = 20.0  # Hz
AROUND = 5  # samples before and after that the network sees
HIDDEN, STEPS, PACE, DECAY = 16, 400, 0.01, 1e-3
RESULTS = Path(__file__).resolve().parents[1] / "results" / "hiro_network.json"


def inputs(trials: list[Trial]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Standardised windows of all channels, padded to one length, the lengths, and the times [s]."""
    times = [np.arange(trial.t[0], trial.t[-1], 1 / RATE) for trial in trials]
    signals = [np.stack([np.interp(t, trial.t, trial.channels[c]) for c in WRENCH_AND_POSE], 1)
               for t, trial in zip(times, trials, strict=True)]  # fmt: skip
    every = np.concatenate(signals)
    centre, scale = every.mean(0), every.std(0)
    lengths = np.array([len(t) for t in times])
    width = 2 * AROUND + 1
    out = np.zeros((len(trials), lengths.max(), width * len(WRENCH_AND_POSE)))
    for row, signal in zip(out, signals, strict=True):
        padded = np.pad((signal - centre) / scale, ((AROUND, AROUND), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
        row[: len(signal)] = windows.reshape(len(signal), -1)
    return out, lengths, times


def network(weights: dict, x: jax.Array) -> jax.Array:
    """Log probabilities (num_samples, num_phases) of windows."""
    hidden = jnp.tanh(x @ weights["in"] + weights["bias"][None])
    return jax.nn.log_softmax(hidden @ weights["out"])


def emissions(weights: dict, x: jax.Array, there: jax.Array) -> jax.Array:
    """Scaled log-likelihoods of all trials: outputs over how often each phase is given."""
    outputs = jax.vmap(partial(network, weights))(x)
    often = (jnp.exp(outputs) * there).sum((0, 1)) / there.sum()
    return outputs - jnp.log(often)[None, None]


def train(x: np.ndarray, lengths: np.ndarray, num_phases: int, seed: int) -> np.ndarray:
    """Log-likelihoods (num_trials, num_samples, num_phases) of the trained network (Adam)."""
    chain = hmm.left_to_right([lengths.mean() / num_phases] * num_phases)
    there = jnp.asarray(np.arange(x.shape[1])[None, :, None] < lengths[:, None, None], x.dtype)
    keys = jax.random.split(jax.random.key(seed), 2)
    weights = {
        "in": jax.random.normal(keys[0], (x.shape[2], HIDDEN)) / np.sqrt(x.shape[2]),
        "bias": jnp.zeros(HIDDEN),
        "out": jax.random.normal(keys[1], (HIDDEN, num_phases)) / np.sqrt(HIDDEN),
    }

    def loss(weights: dict) -> jax.Array:
        evidence = jax.vmap(hmm.log_evidence, (0, None, 0))(emissions(weights, x, there), chain, lengths)
        decay = sum((each**2).sum() for each in jax.tree.leaves(weights))
        return -evidence.sum() / lengths.sum() + DECAY * decay

    @jax.jit
    def step(i: jax.Array, weights: dict, first: dict, second: dict) -> tuple[dict, dict, dict]:
        gradient = jax.grad(loss)(weights)
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
        second = jax.tree.map(lambda v, g: 0.99 * v + 0.01 * g**2, second, gradient)
        moved = jax.tree.map(
            lambda m, v: m / (1 - 0.9**i) / (jnp.sqrt(v / (1 - 0.99**i)) + 1e-8), first, second
        )
        return jax.tree.map(lambda w, d: w - PACE * d, weights, moved), first, second

    first = second = jax.tree.map(jnp.zeros_like, weights)
    for i in range(STEPS):
        weights, first, second = step(jnp.asarray(i + 1.0), weights, first, second)
    return np.asarray(emissions(weights, jnp.asarray(x), there))


def main() -> None:
    """Train, compare with labels, write experiments/results/hiro_network.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=3, help="random crops and starts of the network")
    args = parser.parse_args()
    kind = KINDS["real_guarded"]
    trials = read_kind(args.folder, "real_guarded")
    errors: dict[str, list] = {"network": [], "own": []}
    for seed in range(args.seeds):
        rng = np.random.default_rng(seed)
        data = [cropped(trial, rng.uniform(0, MAX_CROP)) for trial, _ in trials]
        x, lengths, times = inputs(data)
        tables = train(x, lengths, len(kind.sequence), seed)
        chain = hmm.left_to_right([lengths.mean() / len(kind.sequence)] * len(kind.sequence))
        for table, n, t, (_, labels) in zip(tables, lengths, times, trials, strict=True):
            starts = t[np.minimum(hmm.viterbi(table[:n], chain).starts[1:], n - 1)] - 0.5 / RATE
            errors["network"].append([abs(starts[b] - labels[b]) for b in kind.scored])
        own = without_labels(trials, kind, WRENCH_AND_POSE, seed)
        errors["own"] += [[abs(e) for e in row["difference"]] for row in own]
    document = {
        "trials": len(trials), "seeds": args.seeds,
        "median_error": {name: np.median(rows, 0).tolist() for name, rows in errors.items()},
        "p90_error": {name: np.quantile(rows, 0.9, axis=0).tolist() for name, rows in errors.items()},
    }  # fmt: skip
    save(RESULTS, document)
    print(document)


if __name__ == "__main__":
    main()
