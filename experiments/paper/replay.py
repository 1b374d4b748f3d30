"""Healthy recordings replayed through the calibrated virtual model: what is left of the net forces.

    python -m experiments.paper.replay

The model takes only the finger motions and the properties identified from the recordings; the
boundaries of `truth` serve to score by subtask, not to replay.
"""

from __future__ import annotations

import numpy as np

from estimation.identification import Identification
from experiments.paper.estimates import identified
from experiments.paper.sources import ONE, recorded, save
from hmmseg.contact.decompose import subtasks
from simgap.world.properties import UNITS, Block, Blocks
from simgap.world.replay import replay, residual_summary

LIMIT = 1.5  # times the sensors' noise, in free motion and carry


def calibrated(found: Identification) -> Blocks:
    """Blocks of the virtual model from posterior means; friction only where slip shows it."""
    return {name: Block(**{key: float(found.of(name, key).mean()) for key in UNITS})
            for name in found.task.objects}  # fmt: skip


def main() -> None:
    """Save residuals by contact state of every trial, and one trial's forces."""
    case = recorded()
    blocks = calibrated(identified(case))
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


if __name__ == "__main__":
    main()
