"""Figure 7: the state sequence 1, 3, 2, 3, 1, 3, 2, 3, 1 and its dropouts, trial by trial.

python -m experiments.paper.states
"""

from __future__ import annotations

import itertools

import numpy as np

from experiments.paper.sources import ONE, qualitative, recorded, save, simulated
from experiments.recordings import Case
from hmmseg.contact.decompose import FREE, subtasks
from hmmseg.segmentation.thresholds import NUMBERS, label_states

EXPECTED = (1, 3, 2, 3, 1, 3, 2, 3, 1)


def sequence(state: np.ndarray) -> list[int]:
    """States in the order in which they appear, runs and dropouts (0) taken out."""
    return [key for key, _ in itertools.groupby(int(k) for k in state if k)]


def trials(case: Case) -> list[dict]:
    """Per trial: the sequence as the rules give it, and after the subtasks' known order.

    `flickers` are changes of state beyond the eight that the task has, `dropouts` samples without
    a state inside the task.
    """
    numbers = [NUMBERS[step.state] for step in subtasks(case.task)]
    rows = []
    for trial, signals, found in zip(case.trials, case.signals, qualitative(case), strict=True):
        labels = label_states(signals)
        seen = sequence(labels.state)
        ordered = [NUMBERS[span.state] for span in found.spans]
        rows.append({
            "file": trial.name, "sequence": seen, "flickers": max(len(seen) - len(numbers), 0),
            "dropouts": int((labels.state == 0).sum()), "sliding": int(labels.sliding.sum()),
            "ordered": ordered, "as_expected": seen == numbers,
            "ordered_as_expected": ordered == numbers and found.complete,
        })  # fmt: skip
    return rows


def timeline(case: Case, index: int) -> dict:
    """State of every sample of one trial, sliding marked."""
    labels = label_states(case.signals[index])
    return {"file": case.trials[index].name, "t": case.signals[index].t, "state": labels.state,
            "sliding": labels.sliding.astype(int)}  # fmt: skip


def dropping(case: Case) -> int:
    """Index of the trial with most dropouts, then most flicker."""
    rows = trials(case)
    return max(range(len(rows)), key=lambda i: (rows[i]["dropouts"], rows[i]["flickers"]))


def before_lift(case: Case) -> dict:
    """Where the flicker lies: samples of hold-above-ground in true free motion, pickup and place."""
    steps = subtasks(case.task)
    names = np.array(["free" if s.state == FREE else s.name for s in steps])
    counts = dict.fromkeys(("free", "pickup", "place"), 0)
    for signals, truth in zip(case.signals, case.truth, strict=True):
        true = names[np.searchsorted(truth, signals.t, side="right")]
        above = label_states(signals).state == NUMBERS["hold-above-ground"]
        for name in counts:
            counts[name] += int((above & (true == name)).sum())
    return counts


def main() -> None:
    """Save the sequences of all trials and two timelines."""
    case = recorded()
    save("states", {
        "expected": EXPECTED, "recordings": trials(case), "simulated": trials(simulated()),
        "above_ground_too_early": before_lift(case), "steady": timeline(case, ONE),
        "dropping": timeline(case, dropping(case)),
    })  # fmt: skip


if __name__ == "__main__":
    main()
