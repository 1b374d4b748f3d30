"""Whether simulated trials are segmented and identified as well as recordings, trial by trial.

python -m experiments.paper.alike
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.stats import binomtest

from experiments.paper.sources import recorded, save, simulated
from experiments.recordings import Case
from experiments.score_recordings import METHODS, Method, score_case, summarise
from experiments.scoring import PROPERTIES

HEALTHY = ("paper_blocks", "none_1", "none_2")


def coverage(share: float, count: int, nominal: float) -> dict:
    """Share covered with its 95 % interval (Clopper and Pearson), which should contain the nominal share."""
    low, high = binomtest(round(share * count), count).proportion_ci(0.95)
    return {"share": share, "count": count, "nominal": nominal, "interval_95": [low, high],
            "holds": bool(low <= nominal <= high)}  # fmt: skip


def scored(read: Callable[[str], Case], method: Method) -> dict:
    """Scores of boundaries, states and properties in all healthy cases, each trial alone."""
    scores = [score_case(read(name), method, 1, 0) for name in HEALTHY]
    found = summarise(scores)
    trials = [s["trials"] for s in scores]
    boundaries = int(np.isfinite(np.concatenate([np.ravel(s["residuals"]) for s in scores])).sum())
    covered = {"boundary 90 %": coverage(found["boundaries"]["coverage_90"], boundaries, 0.90)}
    for name in PROPERTIES:
        one = found["properties"][name]
        for percent in (68, 95):
            entry = coverage(one[f"coverage_{percent}"], one["count"], percent / 100)
            covered[f"{name} {percent} %"] = entry
    accuracy = float(np.average([s["state_accuracy"] for s in scores], weights=trials))
    return found | {"state_accuracy": accuracy, "coverage": covered}


def main() -> None:
    """Save the scores of both, by our method and by the paper's."""
    sources = {"recordings": recorded, "simulated": simulated}
    save("alike", {source: {method: scored(read, METHODS[method]) for method in ("hmm", "qualitative")}
                   for source, read in sources.items()})  # fmt: skip


if __name__ == "__main__":
    main()
