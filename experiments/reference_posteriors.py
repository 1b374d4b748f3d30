"""The sampler against NUTS on the same log density, for ten tasks of one to six blocks.

    python -m experiments.reference_posteriors [--tasks 10]

NumPyro's NUTS walks the same six scales with gradients by JAX; unknowns are drawn given them as identify
does. Means are to agree within 0.1 posterior sd, sds within 5 %. Also effective samples a second of both
and of emcee's default move, and log densities a second for 12 blocks x 50 trials beside 2 x 4. Writes
experiments/results/reference_posteriors.json.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import emcee
import numpy as np

from estimation.posterior import Posterior, find_mode, log_density, posterior
from estimation.sampler import BURN_IN, WALKERS, draw_unknowns, effective_sample_size, proposal, sample
from experiments.saving import save
from experiments.sbc import design_of, drawn
from hmmseg.jaxconfig import double_precision

RESULTS = Path(__file__).parent / "results" / "reference_posteriors.json"
TASKS = [(1, 1), (1, 4), (2, 1), (2, 4), (2, 20), (3, 2), (3, 4), (4, 4), (5, 2), (6, 4)]  # blocks, trials
CHAINS, WARM_UP, KEPT = 4, 500, 3000


def task_posterior(blocks: int, trials: int, number: int = 0) -> Posterior:
    """The posterior of a drawn data set."""
    rng = np.random.default_rng([11, blocks, trials, number])
    return posterior(drawn(design_of(blocks, trials, rng), rng)[0])


def nuts(post: Posterior, seed: int = 0) -> tuple[np.ndarray, float]:
    """Chains (CHAINS, KEPT, 6) of the scales and the processor time of sampling, compiled before [s]."""
    import jax
    import jax.numpy as jnp
    from numpyro.infer import MCMC, NUTS

    tables = jax.tree.map(jnp.asarray, post.tables)
    kernel = NUTS(potential_fn=lambda x: -log_density(x[None], tables, jnp)[0], target_accept_prob=0.9)
    mode = find_mode(post).scales
    start = mode + 0.1 * np.random.default_rng(seed).normal(size=(CHAINS, mode.size))
    mcmc = MCMC(kernel, num_warmup=WARM_UP, num_samples=KEPT, num_chains=CHAINS, chain_method="sequential",
                progress_bar=False)  # fmt: skip
    mcmc.warmup(jax.random.PRNGKey(seed), init_params=start)
    began = time.process_time()
    mcmc.run(jax.random.PRNGKey(seed + 1))
    return np.asarray(mcmc.get_samples(group_by_chain=True)), time.process_time() - began


@double_precision
def compare(blocks: int, trials: int) -> dict[str, Any]:
    """Differences of means (posterior sds) and of sds (shares) between identify's sampler and NUTS."""
    import arviz

    post = task_posterior(blocks, trials)
    began = time.process_time()
    ours = sample(post, seed=0)
    seconds = time.process_time() - began
    chains, nuts_seconds = nuts(post)
    theta = chains.reshape(-1, chains.shape[-1])
    unknowns, _ = draw_unknowns(post, theta, np.random.RandomState(1))
    reference = np.concatenate([theta, unknowns[:, : len(post.design.unknowns)]], axis=1)
    mine = np.concatenate([ours.scales.reshape(-1, 6), ours.flat], axis=1)
    sd = reference.std(axis=0)
    apart, wider = (mine.mean(axis=0) - reference.mean(axis=0)) / sd, mine.std(axis=0) / sd - 1
    kinds = {"scales": slice(0, 6), "properties": slice(6, None)}
    ess = float(min(arviz.ess(chains[..., k]) for k in range(6)))
    return {
        "blocks": blocks, "trials": trials, "ess": ours.ess, "nuts_ess": ess,
        "means": {k: float(np.abs(apart[s]).max()) for k, s in kinds.items()},
        "sds": {k: float(np.abs(wider[s]).max()) for k, s in kinds.items()},
        "ess_per_second": ours.ess / seconds, "nuts_ess_per_second": ess / nuts_seconds,
        "stretch_ess_per_second": stretch(post),
    }  # fmt: skip


def stretch(post: Posterior, steps: int = 1000) -> float:
    """Effective samples a second of emcee with its default move, started as ours."""
    random = np.random.RandomState(0)
    start = proposal(post, find_mode(post)).draw(WALKERS, random)
    sampler = emcee.EnsembleSampler(WALKERS, start.shape[1], post.log_prob, vectorize=True)
    state = sampler.run_mcmc(emcee.State(start, random_state=random.get_state()), 4 * BURN_IN)
    sampler.reset()
    began = time.process_time()
    sampler.run_mcmc(state, steps)
    return effective_sample_size(np.swapaxes(sampler.get_chain(), 0, 1)) / (time.process_time() - began)


def densities_a_second(blocks: int, trials: int) -> float:
    """Log densities a second, WALKERS at once, the table made before."""
    post = task_posterior(blocks, trials)
    theta = 0.1 * np.random.default_rng(0).normal(size=(WALKERS, 6))
    post.log_prob(theta)
    began = time.process_time()
    for _ in range(200):
        post.log_prob(theta)
    return 200 * WALKERS / (time.process_time() - began)


def line(row: dict[str, Any]) -> str:
    """A row for people."""
    parts = [f"{k} {row['means'][k]:.3f} sd and {100 * row['sds'][k]:.1f} % apart" for k in row["means"]]
    ours, others, plain = (row[f"{k}ess_per_second"] for k in ("", "nuts_", "stretch_"))
    head = f"{row['blocks']} blocks x {row['trials']:2} trials: {', '.join(parts)}"
    return f"{head}; effective samples a second: {ours:.0f}, NUTS {others:.0f}, stretch {plain:.0f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", type=int, default=len(TASKS))
    options = parser.parse_args(arguments)
    rows = []
    for blocks, trials in TASKS[: options.tasks]:
        row = compare(blocks, trials)
        rows.append(row)
        print(line(row), flush=True)
    speed = {f"{b} x {t}": densities_a_second(b, t) for b, t in ((2, 4), (12, 50))}
    print("log densities a second:", {k: round(v) for k, v in speed.items()})
    document = {"tasks": rows, "log_densities_a_second": speed}
    save(RESULTS, document)


if __name__ == "__main__":
    main()
