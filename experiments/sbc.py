"""Simulation-based calibration of the posterior: where true values rank among the draws.

    python -m experiments.sbc [--sets 1000]

The cheap configuration: designs of one to six blocks and one to twenty trials, without a simulator in
between. Each data set is drawn from the model that the posterior stands for, properties from their own
priors, scales from theirs; the ranks of the true properties among the posterior's draws are then uniform
(Talts et al. 2018). Writes experiments/results/sbc.json and docs/figures/sbc.png.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from estimation import priors
from estimation.design import PROPERTIES, Design, Nuisance, Unknown
from estimation.posterior import posterior
from estimation.sampler import sample
from experiments.saving import panels, save
from experiments.table_text import markdown, percent

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "sbc.json"
CHUNKS, CHUNK = HERE.parent / "build" / "sbc", 25  # ranks are kept, so that a run goes on where it stopped
SETS, DRAWS, BINS, SEED = 1000, 99, 20, 7
MEAN_SD = np.array([4e-3, 5e-6, 1e-5])  # of one mean, by channel [N, m, m]: as at 20 Hz
UNIT = np.array([0.5, 1.4e-3, 2e-4])  # what shares of model error are taken of [N, m, m]
BIAS, WIDER = 0.02, 3e-5  # of one sd of two deviations: a bias of force [N], a shift of width [m]


def design_of(blocks: int, trials: int, rng: np.random.Generator) -> Design:
    """A design with one grip per block and trial, with means and slopes but without data."""
    unknowns = tuple(Unknown(prop, {f"b{k}": 1}) for k in range(blocks) for prop in PROPERTIES)
    rows = [(t, m, c, s) for s in (0, 1) for t in range(trials) for m in range(blocks) for c in range(3)
            if s == 0 or c > 0]  # fmt: skip
    trial, move, channel, slope = np.array(rows).T
    slope = slope.astype(bool)
    coefficients = np.zeros((len(rows), len(unknowns)))
    tilt = 1 + 0.02 * rng.normal(size=len(rows))
    coefficients[np.arange(len(rows)), 3 * move + channel] = np.where(
        slope, 0.0, np.where(channel, 1.0, tilt)
    )
    sd = np.where(slope, 0.15, MEAN_SD[channel] * np.sqrt(rng.uniform(0.5, 2.0, size=len(rows))))
    shifts = np.stack([np.where((channel == 0), BIAS, 0.0), np.where((channel == 1) & ~slope, WIDER, 0.0)], 1)
    free_shifts = np.zeros((trials, 4, 2))
    free_shifts[:, 1, 0] = BIAS
    unit = np.where(slope, 1.0, UNIT[channel] * (1 + 0.1 * rng.normal(size=len(rows))))
    deviations = tuple(Nuisance(name, 1.0, 1.0, _unread) for name in ("bias", "wider"))
    return Design(
        unknowns=unknowns, nuisances=deviations, mean=np.zeros(len(rows)), variance=sd**2,
        coefficients=coefficients, shifts=shifts, channel=channel, unit=unit, trial=trial, move=move,
        slope=slope, free_mean=np.zeros((trials, 4)), free_variance=np.full((trials, 4), 2e-3**2),
        free_shifts=free_shifts, scale_count=np.full(3, 60.0),
    )  # fmt: skip


def _unread(trial: Any, rig: Any, size: float) -> Any:
    raise AssertionError("designs made here are complete")


def drawn(design: Design, rng: np.random.Generator) -> tuple[Design, np.ndarray]:
    """The design with data drawn from the model, and the true properties (Q,)."""
    d = design
    mean = np.log([priors.PROPERTY_MEDIAN[u.prop] for u in d.unknowns])
    sd = np.array([priors.PROPERTY_LOG_SD[u.prop] for u in d.unknowns])
    true = np.exp(mean + sd * rng.normal(size=mean.size))
    log_s = rng.normal(size=3) / np.sqrt(2 * d.scale_count)
    share = priors.SCATTER_MEDIAN * np.exp(priors.SCATTER_LOG_SD * rng.normal(size=3))
    common = np.hypot(priors.COMMON, share) * rng.normal(size=3)
    slopes = np.hypot(d.slope_sd, share) * rng.normal(size=3)
    z = rng.normal(size=len(d.nuisances))
    grips, grip = np.unique(np.stack([d.trial, d.move, d.channel], 1), axis=0, return_inverse=True)
    own = (share[grips[:, 2]] * rng.normal(size=len(grips)))[grip.ravel()]
    other = np.where(d.slope, share[d.channel] * rng.normal(size=d.mean.size) + slopes[d.channel], 0.0)
    noise = np.exp(log_s[d.channel]) * np.sqrt(d.variance) * rng.normal(size=d.mean.size)
    data = d.coefficients @ true + d.shifts @ z + d.unit * (common[d.channel] + own) + other + noise
    free = d.free_shifts @ z + np.sqrt(d.free_variance) * rng.normal(size=d.free_mean.shape)
    return replace(d, mean=data, free_mean=free), true


def ranks_of(number: int) -> tuple[np.ndarray, list[str], str]:
    """Ranks (Q,) in 0 .. DRAWS of one data set's properties, their kinds, and how they were sampled."""
    rng = np.random.default_rng([SEED, number])
    blocks, trials = int(rng.integers(1, 7)), int(rng.choice([1, 2, 4, 20]))
    design, true = drawn(design_of(blocks, trials, rng), rng)
    found = sample(posterior(design), seed=number)
    chosen = rng.permutation(len(found.flat))[:DRAWS]  # the chain's draws are nearly independent
    ranks = (found.flat[chosen] < true).sum(axis=0)
    return ranks, [u.prop for u in design.unknowns], "emcee" if found.converged else "not converged"


def summary(ranks: np.ndarray) -> dict[str, Any]:
    """Counts by bin, the chi-square p-value of uniformity, coverages of central intervals."""
    counts, _ = np.histogram(ranks, bins=BINS, range=(-0.5, DRAWS + 0.5))
    place = (ranks + 0.5) / (DRAWS + 1)
    return {
        "count": int(ranks.size), "bins": counts.tolist(), "p_value": float(stats.chisquare(counts).pvalue),
        "coverage_68": float(np.mean(np.abs(place - 0.5) < 0.34)),
        "coverage_95": float(np.mean(np.abs(place - 0.5) < 0.475)),
    }  # fmt: skip


def ranked(first: int, num: int) -> list[dict[str, Any]]:
    """Ranks of a chunk of data sets, one property of each kind from each; kept in CHUNKS.

    One, as blocks of a data set share their deviations.
    """
    path = CHUNKS / f"{first:05d}_{num}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    out = []
    for number in range(first, first + num):
        ranks, props, method = ranks_of(number)
        out.append({"method": method} | {prop: int(ranks[props.index(prop)]) for prop in PROPERTIES})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(out) + "\n", encoding="utf-8")
    return out


def table(found: dict) -> str:
    """docs/tables/sbc.csv: ranks of drawn data sets."""
    rows = [[prop, f"{s['count']}", f"{s['p_value']:.2f}", percent(s["coverage_68"], 1),
             percent(s["coverage_95"], 1)] for prop, s in found["properties"].items()]  # fmt: skip
    return markdown(["property", "data sets", "p of uniform ranks", "68 % cover", "95 % cover"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=SETS)
    parser.add_argument("--fresh", action="store_true", help="forget the ranks that were kept")
    options = parser.parse_args(arguments)
    if options.fresh:
        for path in CHUNKS.glob("*.json"):
            path.unlink()
    began, rows = time.process_time(), []
    for first in range(0, options.sets, CHUNK):
        rows += ranked(first, min(CHUNK, options.sets - first))
        print(f"{len(rows)} data sets, {time.process_time() - began:.0f} s", flush=True)
    methods = {m: sum(r["method"] == m for r in rows) for m in sorted({r["method"] for r in rows})}
    good = [r for r in rows if r["method"] != "not converged"]
    document = {
        "sets": options.sets, "draws": DRAWS, "methods": methods,
        "properties": {prop: summary(np.array([r[prop] for r in good])) for prop in PROPERTIES},
    }  # fmt: skip
    for prop, s in document["properties"].items():
        print(f"{prop:7} {s['count']} ranks, p {s['p_value']:.3f}, 68 %: {100 * s['coverage_68']:.1f}, "
              f"95 %: {100 * s['coverage_95']:.1f}")  # fmt: skip
    save(RESULTS, document)
    draw(document, HERE.parent / "docs" / "figures" / "sbc.png")


def draw(document: dict[str, Any], path: Path) -> None:
    """Rank histograms with the band that holds all bins of a uniform one in 99 % of figures."""
    with panels(path, 1, 3, figsize=(9, 2.4), sharey=True) as axes:
        for ax, (prop, s) in zip(axes, document["properties"].items(), strict=True):
            level = 1 - 0.99 ** (1 / (3 * BINS))  # all bins of all panels together
            low, high = stats.binom.ppf([level / 2, 1 - level / 2], s["count"], 1 / BINS)
            ax.axhspan(low, high, color="0.88", lw=0)
            ax.stairs(s["bins"], np.linspace(0, 1, BINS + 1), fill=True, alpha=0.7)
            ax.set_title(f"{prop}, p {s['p_value']:.2f}", fontsize=9)
            ax.set_xlabel("rank of the true value", fontsize=8)
        axes[0].set_ylabel("data sets", fontsize=8)


if __name__ == "__main__":
    main()
