"""Figures 3 and 5 to 9: the signals of a recording, the samples that estimates use, and the state sequences.

python -m experiments.paper.recording
"""

from __future__ import annotations

import itertools

import numpy as np

from estimation.paper_formulas import TRIM
from experiments.paper.sources import BLOCKS, ONE, qualitative, recorded, save, simulated, true_blocks
from experiments.recordings import Case
from hmmseg.contact.decompose import FREE, subtasks
from hmmseg.segmentation.thresholds import NUMBERS, label_states
from simgap.world.replay import replay

MOMENT = {"pregrasp": 0.6, "release": 0.25}  # share of a subtask at which it is shown, else half
CHANNELS = ("x", "y", "distance", "offset", "fx", "fy", "grip", "shear", "y2")


def used(index: int) -> dict:
    """Samples that the paper's formulas take: `weight` and `height` (num_timesteps,) of 0 and 1."""
    case = recorded()
    signals, found = case.signals[index], qualitative(case)[index]
    held, t = label_states(signals).state > 1, signals.t
    chosen = {"weight": np.zeros(t.size, int), "height": np.zeros(t.size, int)}
    for span in found.spans:
        cut = TRIM * (span.end - span.start)
        if span.subtask == "carry":
            chosen["weight"] |= held & (t >= span.start + cut) & (t < span.end - cut)
        if span.subtask in ("pickup", "place"):
            chosen["height"] |= held & (t >= span.start) & (t < span.end)
    return chosen


def scenes(index: int) -> list[dict]:
    """Figure 3: fingers and blocks midway through each subtask, blocks from the replayed model.

    Lengths in m; `fingers` and `blocks` are positions (x, y) of contact faces and centres.
    """
    case = recorded()
    blocks, steps = true_blocks(case), subtasks(case.task)
    spans = qualitative(case)[index].spans
    played = replay(case.trials[index], case.task, case.rig, blocks,
                    boundaries=[span.start for span in spans[1:]])  # fmt: skip
    out = []
    for step, span in zip(steps, spans, strict=True):
        share = MOMENT.get(step.name, 0.5)
        k = int(np.searchsorted(played.t, span.start + share * (span.end - span.start)))
        out.append({"subtask": step.name, "object": step.object, "state": step.state,
                    "fingers": played.motion.position[k], "blocks": played.motion.blocks[k]})  # fmt: skip
    return out


# Figure 7: the state sequence 1, 3, 2, 3, 1, 3, 2, 3, 1 and its dropouts, trial by trial.

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
    """Counts of samples labelled hold-above-ground in true free motion, pickup and place: the flicker."""
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
    """Save the signals with their spans and scenes, the sequences of all trials, and two timelines."""
    case = recorded()
    signals, found = case.signals[ONE], qualitative(case)[ONE]
    save("recording", {
        "file": case.trials[ONE].name, "t": signals.t,
        "signals": {name: getattr(signals, name) for name in CHANNELS}, "used": used(ONE),
        "spans": [{"subtask": s.subtask, "object": s.object, "state": s.state, "start": s.start,
                   "end": s.end} for s in found.spans],
        "scenes": scenes(ONE),
        "sizes": {name: [case.blocks[name][key][0] for key in ("width", "height")] for name in BLOCKS},
    })  # fmt: skip
    save("states", {
        "expected": EXPECTED, "recordings": trials(case), "simulated": trials(simulated()),
        "above_ground_too_early": before_lift(case), "steady": timeline(case, ONE),
        "dropping": timeline(case, dropping(case)),
    })  # fmt: skip


if __name__ == "__main__":
    main()
