"""Tables 3 and 4, and the posterior's figures: the paper's formulas and the Bayesian model.

python -m experiments.paper.estimates
"""

from __future__ import annotations

from functools import cache

import numpy as np

from estimation import identify
from estimation.identification import Identification, source_subtasks
from estimation.observations import draw_boundaries
from estimation.paper_formulas import estimate_plugin
from estimation.priors import PROPERTY_LOG_SD, PROPERTY_MEDIAN
from experiments.paper.sources import BLOCKS, ONE, PRINTED, qualitative, recorded, save, simulated
from experiments.recordings import Case
from hmmseg.contact.decompose import decompose

KEYS = ("weight", "height", "width")
PROPERTIES = (("block1", "weight"), ("block2", "height"), ("block1", "width"), ("block1", "friction"))
DRAWS = 2000  # of the posterior, saved for the figures
ALIGNMENTS = 60
CASES = {"recordings": recorded, "simulated": simulated}


@cache
def _identified(name: str, index: int | None) -> Identification:
    case = next(read() for read in CASES.values() if read().name == name)
    return identify(case.trials if index is None else [case.trials[index]], case.task, case.rig)


def identified(case: Case, index: int | None = None) -> Identification:
    """Bayesian result of all trials of the paper's blocks, or of one; computed once a run."""
    return _identified(case.name, index)


def table_3() -> list[dict]:
    """Per property of block 1's move: the subtasks that the paper's formulas and ours draw on."""
    case = recorded()
    paper, _ = estimate_plugin(case.signals, qualitative(case), case.task)
    ours = identified(case).to_json()["properties"]
    rows = []
    for name, key in PROPERTIES:
        used = (ours[name][key] or {}).get("subtasks") or held(case, name)
        found = paper[name][key]
        rows.append({"object": name, "property": key, "paper": found["subtasks"], "bayes": used})
    return rows


def held(case: Case, name: str) -> list[str]:
    """Subtasks in which a block is held: all of them bear on its friction."""
    return source_subtasks(decompose(case.task), name, "width")


def by_formula(case: Case) -> dict:
    """The paper's estimates: of the one trial with sd over samples, of all with sd between trials."""
    found = qualitative(case)
    each = [estimate_plugin([s], [f], case.task)[0]
            for s, f in zip(case.signals, found, strict=True)]  # fmt: skip
    out: dict = {"one": {}, "all": {}}
    for name in BLOCKS:
        out["one"][name], out["all"][name] = {}, {}
        for key in KEYS:
            one, means = each[ONE][name][key], [trial[name][key]["mean"] for trial in each]
            out["one"][name][key] = {"mean": one["mean"], "sd": one["sd"]}
            out["all"][name][key] = {"mean": np.mean(means), "sd": np.std(means, ddof=1)}
        bounds = [trial[name]["friction"]["lower_bound"] for trial in each]
        out["one"][name]["friction"] = bounds[ONE]
        out["all"][name]["friction"] = max(bounds)
    return out


def by_posterior(found: Identification) -> dict:
    """Posterior mean, sd and 95 % interval of every property; the 5 % quantile of friction."""
    properties, out = found.to_json()["properties"], {}
    for name in BLOCKS:
        out[name] = {
            key: {k: properties[name][key][k] for k in ("mean", "sd", "interval_95")} for key in KEYS
        }
        friction = properties[name]["friction"]
        out[name]["friction"] = None if friction is None else friction["lower_bound"]
    return out


def posterior(found: Identification) -> dict:
    """Draws for a corner plot, with the priors of the log properties."""
    chosen = np.linspace(0, len(found.draws) - 1, DRAWS).astype(int)
    mean = np.log([PROPERTY_MEDIAN[prop] for _, prop in found.names])
    sd = np.array([PROPERTY_LOG_SD[prop] for _, prop in found.names])
    return {"names": [list(name) for name in found.names], "draws": found.draws[chosen],
            "prior_log_mean": mean, "prior_log_sd": sd}  # fmt: skip


def alignments(case: Case, index: int) -> dict:
    """Boundaries drawn from their posterior over the signals of one trial; `truth` for comparison."""
    found = identified(case)
    trial, signals = found.aligned.trials[index], case.signals[index]
    spans = trial.segmentation.spans
    return {
        "file": case.trials[index].name, "t": signals.t, "fy": signals.fy, "grip": signals.grip,
        "y": signals.y, "truth": case.truth[index],
        "drawn": draw_boundaries(trial, np.random.default_rng(0), ALIGNMENTS),
        "spans": [{"subtask": s.subtask, "object": s.object, "state": s.state, "start": s.start,
                   "end": s.end, "start_90": s.start_90, "start_sd": s.start_sd} for s in spans],
    }  # fmt: skip


def main() -> None:
    """Save the tables and what the posterior's figures draw."""
    case = recorded()
    table: dict = {"printed": PRINTED, "actual": case.blocks, "file": case.trials[ONE].name}
    for name, read in CASES.items():
        bayes = {"one": by_posterior(identified(read(), ONE)), "all": by_posterior(identified(read()))}
        table[name] = {"paper": by_formula(read()), "bayes": bayes}
    save("estimates", {"table_3": table_3(), "table_4": table})
    save("posterior", {"all": posterior(identified(case)), "one": posterior(identified(case, ONE)),
                       "actual": case.blocks})  # fmt: skip
    save("alignments", alignments(case, ONE))


if __name__ == "__main__":
    main()
