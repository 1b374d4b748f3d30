"""Figures 11 to 14: the calibrated virtual block 2 picked up and placed twice, and the recording.

python -m experiments.paper.virtual_block
"""

from __future__ import annotations

import numpy as np

from experiments.paper.estimates import identified
from experiments.paper.replay import calibrated
from experiments.paper.sources import ONE, qualitative, recorded, save
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.task import GROUND, BlockTask, Move
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import label_states, segment_qualitative
from simgap.world.simulate import simulate_trial

TWICE = BlockTask({"block2": GROUND}, (Move("block2", GROUND), Move("block2", GROUND)))
SEED = 0
FRAMES = (0.3, 0.5, 0.7)  # of the first carry, for the picture of the virtual scene


def carries(signals: Signals, found: Segmentation) -> list[dict]:
    """Per carry: its samples, net vertical force [N], width [m] and grip [N], mean and sd."""
    held, out = label_states(signals).state > 1, []
    for span in found.spans:
        if span.subtask == "carry":
            inside = held & (signals.t >= span.start) & (signals.t < span.end)
            row = {"object": span.object, "start": span.start, "end": span.end, "inside": inside.astype(int)}
            for name, values in (("weight", signals.fy), ("width", signals.distance), ("grip", signals.grip)):
                row[name] = {"mean": values[inside].mean(), "sd": values[inside].std(ddof=1)}
            out.append(row)
    return out


def shown(signals: Signals, found: Segmentation) -> dict:
    """Signals that the figures draw, with the carries."""
    names = ("fx", "fy", "grip", "shear", "distance")
    return {"t": signals.t, **{name: getattr(signals, name) for name in names},
            "carries": carries(signals, found)}  # fmt: skip


def main() -> None:
    """Save the virtual trial, the recording and a few frames of the scene."""
    case = recorded()
    blocks = calibrated(identified(case))
    simulated = simulate_trial(TWICE, case.rig, {"block2": blocks["block2"]}, SEED)
    signals = task_space(simulated.trial, case.rig)
    virtual = shown(signals, segment_qualitative(simulated.trial, signals, TWICE))
    first = virtual["carries"][0]
    times = [first["start"] + share * (first["end"] - first["start"]) for share in FRAMES]
    rows = [int(np.searchsorted(simulated.t, time)) for time in times]
    save("virtual_block", {
        "seed": SEED, "file": case.trials[ONE].name, "virtual": virtual,
        "recording": shown(case.signals[ONE], qualitative(case)[ONE]),
        "recorded_grips": [c["grip"]["mean"] for s, f in zip(case.signals, qualitative(case), strict=True)
                           for c in carries(s, f) if c["object"] == "block2"],
        "size": [blocks["block2"].width, blocks["block2"].height], "weight": blocks["block2"].weight,
        "frames": [{"t": simulated.t[k], "fingers": simulated.motion.position[k],
                    "forces": simulated.motion.force[k], "block": simulated.motion.blocks[k, 0]}
                   for k in rows],
    })  # fmt: skip


if __name__ == "__main__":
    main()
