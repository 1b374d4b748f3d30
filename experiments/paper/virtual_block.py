"""The calibrated virtual model: recordings replayed, and block 2 picked up and placed twice (Figures 11-14).

A replay takes only the finger motions and the properties identified from the recordings; the true boundaries
serve to score it by subtask.

python -m experiments.paper.virtual_block
"""

from __future__ import annotations

import numpy as np

from estimation.identification import Identification
from experiments.paper.estimates import identified
from experiments.paper.sources import ONE, qualitative, recorded, save
from experiments.recordings import Case
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.task import GROUND, BlockTask, Move
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import label_states, segment_qualitative
from simgap.world.properties import UNITS, Block, Blocks
from simgap.world.replay import replay, residual_summary
from simgap.world.simulate import simulate_trials

TWICE = BlockTask({"block2": GROUND}, (Move("block2", GROUND), Move("block2", GROUND)))
SEED = 0
FRAMES = (0.3, 0.5, 0.7)  # of the first carry, for the picture of the virtual scene


LIMIT = 1.5  # times the sensors' noise, in free motion and carry


def calibrated(found: Identification) -> Blocks:
    """Blocks of the virtual model from posterior means; friction only where slip shows it."""
    return {name: Block(**{key: float(found.of(name, key).mean()) for key in UNITS})
            for name in found.task.objects}  # fmt: skip


def save_replays(case: Case, blocks: Blocks) -> None:
    """Save residuals by contact state of every trial, and the forces of one trial."""
    states = [step.state for step in subtasks(case.task)]
    rows, shown = [], None
    for i, (trial, truth) in enumerate(zip(case.trials, case.truth, strict=True)):
        played = replay(trial, case.task, case.rig, blocks)
        rows.append({"file": trial.name} | residual_summary(played, truth, states))
        if i == ONE:
            shown = played
    assert shown is not None
    edges = [span.start for span in identified(case).segmentations[ONE].spans[1:]]
    save("replay", {
        "limit": LIMIT, "trials": rows, "file": case.trials[ONE].name, "t": shown.signals.t,
        "boundaries": edges, "states": states,
        "measured": {"fx": shown.measured[..., 0].sum(axis=1), "fy": shown.measured[..., 1].sum(axis=1),
                     "grip": np.minimum(shown.measured[:, 0, 0], -shown.measured[:, 1, 0])},
        "predicted": {"fx": shown.force[..., 0].sum(axis=1), "fy": shown.force[..., 1].sum(axis=1),
                      "grip": np.minimum(shown.force[:, 0, 0], -shown.force[:, 1, 0])},
        "sd_net": float(np.sqrt(2) * shown.signals.sd_force),
        "sd_height": float(np.nanmedian(shown.signals.sd_y)),
    })  # fmt: skip


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
    """Save the replays, the virtual trial, the recording and a few frames of the scene."""
    case = recorded()
    blocks = calibrated(identified(case))
    save_replays(case, blocks)
    simulated = simulate_trials(TWICE, case.rig, [{"block2": blocks["block2"]}], [SEED])[0]
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
