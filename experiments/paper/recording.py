"""Figures 3, 5, 6, 8 and 9: the signals of one recording, and what the estimates take of them.

python -m experiments.paper.recording
"""

from __future__ import annotations

import numpy as np

from estimation.paper_formulas import TRIM
from experiments.paper.sources import BLOCKS, ONE, qualitative, recorded, save, true_blocks
from hmmseg.contact.decompose import subtasks
from hmmseg.segmentation.thresholds import label_states
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


def main() -> None:
    """Save the signals with their spans and the nine scenes."""
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


if __name__ == "__main__":
    main()
