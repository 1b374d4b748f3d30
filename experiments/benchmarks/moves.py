"""Which moves sample the posterior best: ours against emcee's own.

    python -m experiments.benchmarks.moves [--cases 2]

Per set of moves: acceptance, the largest autocorrelation time over parameters (steps), R-hat, and
effective samples per second of the worst parameter, on single trials and four pooled trials of
simulated cases. Writes experiments/results/benchmark_moves.json.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import emcee
import numpy as np

from estimation.design import build
from estimation.observations import aligned_weights
from estimation.posterior import Mode, Posterior, find_mode, posterior
from estimation.sampler import (
    BURN_IN,
    INDEPENDENT,
    WALKERS,
    effective_sample_size,
    independence_move,
    proposal,
    split_rhat,
)
from experiments.recordings import Case
from experiments.saving import save
from experiments.worlds import SEED, simulated_cases
from hmmseg.segmentation.align import align

RESULTS = Path(__file__).parents[1] / "results"
STEPS = 600


def posterior_of(case: Case, num_trials: int) -> tuple[Posterior, Mode]:
    """Posterior of a case's first trials, and its mode."""
    aligned = align(list(case.trials[:num_trials]), case.task, case.rig)
    weighed, noise = aligned_weights(aligned, np.random.default_rng(0))
    post = posterior(build(aligned, weighed, noise))
    return post, find_mode(post)


def move_sets(post: Posterior, mode: Mode) -> dict[str, list]:
    """Sets of moves by name."""
    differential = emcee.moves.DEMove()
    return {
        "ours": [(independence_move(proposal(post, mode)), INDEPENDENT), (differential, 1 - INDEPENDENT)],
        "differential evolution": [(differential, 1.0)],
        "differential evolution with snooker": [(differential, 0.8), (emcee.moves.DESnookerMove(), 0.2)],
        "stretch (emcee's default)": [(emcee.moves.StretchMove(), 1.0)],
    }


def measure(post: Posterior, mode: Mode, moves: list) -> dict[str, float]:
    """Efficiency of a set of moves from the same start."""
    random = np.random.RandomState(0)
    first = proposal(post, mode).draw(WALKERS, random)
    sampler = emcee.EnsembleSampler(WALKERS, first.shape[1], post.log_prob, moves=moves, vectorize=True)
    state = sampler.run_mcmc(emcee.State(first, random_state=random.get_state()), BURN_IN)
    sampler.reset()
    began = time.process_time()
    sampler.run_mcmc(state, STEPS)
    seconds = time.process_time() - began
    chain = np.swapaxes(sampler.get_chain(), 0, 1)
    ess = effective_sample_size(chain)
    return {
        "acceptance": float(sampler.acceptance_fraction.mean()),
        "autocorrelation_time": chain.shape[0] * chain.shape[1] / max(ess, 1e-9),
        "rhat": split_rhat(chain), "ess_per_second": ess / seconds,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=2)
    options = parser.parse_args(arguments)
    cases = simulated_cases(options.cases, seed=SEED + 3000)
    document: dict = {"walkers": WALKERS, "steps": STEPS, "seconds": "processor time", "trials": {}}
    for num_trials in (1, 4):
        found = [posterior_of(case, num_trials) for case in cases]
        rows = {}
        for name in move_sets(*found[0]):
            each = [measure(post, mode, move_sets(post, mode)[name]) for post, mode in found]
            rows[name] = {key: float(np.median([f[key] for f in each])) for key in each[0]}
            print(f"{num_trials} trials, {name}: tau {rows[name]['autocorrelation_time']:.1f} steps, "
                  f"{rows[name]['ess_per_second']:.0f} effective samples a second", flush=True)  # fmt: skip
        document["trials"][str(num_trials)] = rows
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / "benchmark_moves.json"
    save(path, document)


if __name__ == "__main__":
    main()
