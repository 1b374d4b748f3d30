"""Score a method on every case of a recordings folder.

    python -m experiments.score_recordings RECORDINGS --method hmm qualitative first-change

Boundaries are scored against truth/, properties (of groups of pooled trials) against labels.json
or actual.toml. Prints a table a method and writes experiments/results/score_METHOD.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from estimation.paper_formulas import estimate_plugin
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from experiments.scoring import (
    PROPERTIES,
    boundaries_covered,
    boundary_residuals,
    property_scores,
    state_accuracy,
    summarise_boundaries,
    summarise_properties,
)
from experiments.table_text import markdown, milliseconds, percent
from hmmseg.contact.decompose import Subtask, subtasks
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import (
    Assignment,
    Order,
    StateLabels,
    agreement,
    monotone_order,
    segment_qualitative,
)

RESULTS = Path(__file__).parent / "results"
SAVED = "score_hmm score_qualitative score_first-change"  # results that the table is made of
HEAD = ("trials complete", "boundary, median", "95th percentile", *PROPERTIES)
Method = Callable[[Case, slice, int], tuple[Sequence[Segmentation], dict]]


def by_hmm(case: Case, group: slice, seed: int) -> tuple[Sequence[Segmentation], dict]:
    """Spans of the switching model and properties of the Bayesian model."""
    from estimation import identify  # its modules take long to import; the rules do without

    found = identify(case.trials[group], case.task, case.rig, seed)
    return found.segmentations, found.to_json()["properties"]


def first_change_order(labels: StateLabels, steps: tuple[Subtask, ...]) -> Assignment:
    """Each subtask begins at the first sample after the last one's that shows its state."""
    agrees = agreement(labels, steps)
    length, count = agrees.shape
    first, last, hits = np.full(count, -1), np.full(count, -1), 0
    for s in range(count):
        begin = 0 if s == 0 else first[s - 1] + 1
        shown = np.flatnonzero(agrees[begin:, s])
        if not shown.size:
            break
        first[s] = begin + shown[0]
    reached = np.flatnonzero(first >= 0)
    for s in reached:
        last[s] = first[s + 1] - 1 if s + 1 in reached else length - 1
        hits += int(agrees[first[s] : last[s] + 1, s].sum())
    return Assignment(first, last, hits / length)


def by_thresholds(order: Order) -> Method:
    """Spans of the thresholds, in order by this rule, and the paper's estimates."""

    def run(case: Case, group: slice, seed: int) -> tuple[Sequence[Segmentation], dict]:
        pairs = zip(case.trials[group], case.signals[group], strict=True)
        spans = [segment_qualitative(trial, signals, case.task, order=order) for trial, signals in pairs]
        return spans, estimate_plugin(case.signals[group], spans, case.task)[0]

    return run


METHODS: dict[str, Method] = {
    "hmm": by_hmm,
    "qualitative": by_thresholds(monotone_order),
    "first-change": by_thresholds(first_change_order),
}


def score_case(case: Case, method: Method, pooled: int, seed: int) -> dict:
    """Scores of one case, its trials in groups of `pooled` (a last smaller group is merged)."""
    steps, size = subtasks(case.task), len(case.trials)
    starts = list(range(0, max(size - pooled + 1, 1), pooled))
    groups = [slice(a, b) for a, b in zip(starts, [*starts[1:], size], strict=True)]
    residuals, covered, accuracy, properties, complete = [], [], [], [], 0
    for group in groups:
        spans, estimates = method(case, group, seed)
        properties += property_scores(estimates, case.blocks)
        for segmentation, signals, truth in zip(spans, case.signals[group], case.truth[group], strict=True):
            complete += segmentation.complete
            if truth is not None:
                residuals.append(boundary_residuals(segmentation, truth))
                covered.append(boundaries_covered(segmentation, truth))
                accuracy.append(state_accuracy(segmentation, truth, signals.t, steps))
    return {
        "case": case.name, "healthy": case.healthy, "trials": size, "complete": complete,
        "residuals": np.array(residuals).tolist(), "covered": np.array(covered).tolist(),
        "state_accuracy": float(np.mean(accuracy)) if accuracy else None, "properties": properties,
    }  # fmt: skip


def summarise(scores: Sequence[dict]) -> dict:
    """Boundaries and properties of several cases together."""
    residuals = np.concatenate([np.ravel(s["residuals"]) for s in scores])
    covered = np.concatenate([np.ravel(s["covered"]) for s in scores])
    return {
        "cases": len(scores),
        "trials": sum(s["trials"] for s in scores),
        "complete": sum(s["complete"] for s in scores),
        "boundaries": summarise_boundaries(residuals, covered),
        "properties": summarise_properties([p for s in scores for p in s["properties"]]),
    }


def cells(s: dict) -> list[str]:
    """A summary's cells, under HEAD."""
    b, p = s["boundaries"], s["properties"]
    rms = [percent(p[k]["rms"], 2) if "rms" in p[k] else "none" for k in PROPERTIES]
    times = [milliseconds(b[k]) if b[k] is not None else "none" for k in ("median", "percentile_95")]
    return [f"{s['complete']} of {s['trials']}", *times, *rms]


def table(*found: dict) -> str:
    """docs/results.md: the model against the paper's method, on every recording."""
    labels = "this model", "thresholds, best monotone order", "thresholds, first change (the paper)"
    rows = []
    for label, one in zip(labels, found, strict=True):
        rows += [[label, group, *cells(one["summary"][group])] for group in ("healthy", "all")]
    return markdown(["method", "recordings", *HEAD], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--method", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--pooled", type=int, default=4, help="trials pooled for one estimate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    cases = [read_case(folder) for folder in list_cases(options.recordings)]
    for name in options.method:
        scores = [score_case(case, METHODS[name], options.pooled, options.seed) for case in cases]
        rows = [(score["case"], summarise([score])) for score in scores]
        together = {"all": scores, "healthy": [score for score in scores if score["healthy"]]}
        summaries = {key: summarise(group) for key, group in together.items() if group}
        shown = [[case, *cells(summary)] for case, summary in [*rows, *summaries.items()]]
        print(markdown([name, *HEAD], shown), flush=True)
        document = {"method": name, "pooled": options.pooled, "seed": options.seed,
                    "summary": summaries, "cases": scores}  # fmt: skip
        save(options.output / f"score_{name}.json", _null(document))


def _null(value):
    if isinstance(value, dict):
        return {key: _null(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_null(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


if __name__ == "__main__":
    main()
