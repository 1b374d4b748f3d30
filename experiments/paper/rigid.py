"""Widths under the paper's rigid fingertips: short by what the pads give under the grip.

    python -m experiments.paper.rigid

A block of width w between pads of stiffness k under a grip N holds the undeformed fingertips
w - 2 N / k apart. Whoever takes the fingertips for rigid takes that distance for the width.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimation import identify
from estimation.paper_formulas import Properties, estimate_plugin
from experiments.paper.estimates import identified
from experiments.paper.sources import BLOCKS, PRINTED, qualitative, recorded, save, simulated
from experiments.recordings import Case
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.thresholds import label_states

ACTUAL = {"block1": 0.0159, "block2": 0.0254}  # m, the paper's calipers
GRIPS = np.linspace(1.0, 4.0, 31)  # N; its Figure 6 shows grips up to 4 N
LOADED = 0.2  # N; from here on both pads press


def without_pads(signals: Signals, rig: Rig) -> Signals:
    """Signals of the pads' outer faces: each position less what its pad gives under its force."""
    tip, moved = rig.fingertip, {}
    for finger in (1, 2):
        for axis, stiffness in (("x", tip.normal_stiffness), ("y", tip.shear_stiffness)):
            name = f"{axis}{finger}"
            moved[name] = getattr(signals, name) - getattr(signals, f"f{name}") / stiffness
    return replace(signals, **moved)


def by_formula(case: Case, index: int, compliant: bool) -> Properties:
    """The paper's formulas on one trial, pads rigid or taken out first."""
    signals, found = case.signals[index], qualitative(case)[index]
    labels = label_states(signals)
    return estimate_plugin([without_pads(signals, case.rig) if compliant else signals], [found],
                           case.task, [labels])[0]  # fmt: skip


def shortfalls(case: Case) -> list[dict]:
    """Per trial and block: grip [N], width [m] short with rigid pads, what 2 N / k predicts, what remains."""
    rows = []
    for i, (signals, found) in enumerate(zip(case.signals, qualitative(case), strict=True)):
        rigid, compliant = (by_formula(case, i, flag) for flag in (False, True))
        held = label_states(signals).state > 1
        for name in BLOCKS:
            span = next(s for s in found.spans if (s.subtask, s.object) == ("carry", name))
            inside = held & (signals.t >= span.start) & (signals.t < span.end)
            squeeze = float(np.nanmean((signals.fx1 - signals.fx2)[inside]))  # of both pads: 2 N
            width = case.blocks[name]["width"][0]
            rows.append({
                "file": case.trials[i].name, "object": name, "grip": squeeze / 2,
                "short": width - rigid[name]["width"]["mean"],
                "predicted": squeeze / case.rig.fingertip.normal_stiffness,
                "remaining": compliant[name]["width"]["mean"] - width,
            })  # fmt: skip
    return rows


def from_the_data(case: Case, name: str) -> dict:
    """Width [m] and pad stiffness [N/m] by regression of distance on squeeze, neither one given.

    Grips close and open, so the distance is seen under all loads. Standard errors from the
    scatter between trials (jackknife).
    """
    pairs = []
    for signals, found in zip(case.signals, qualitative(case), strict=True):
        of_grip = [s for s in found.spans if s.object == name and s.state != "free-motion"]
        inside = (signals.t >= of_grip[0].start) & (signals.t < of_grip[-1].end) & (signals.grip > LOADED)
        pairs.append((signals.fx1[inside] - signals.fx2[inside], signals.distance[inside]))

    def fit(chosen: list) -> np.ndarray:
        squeeze, distance = (np.concatenate(column) for column in zip(*chosen, strict=True))
        slope, width = np.polyfit(squeeze, distance, 1)
        return np.array([width, -1 / slope])

    left_out = np.array([fit(pairs[:i] + pairs[i + 1 :]) for i in range(len(pairs))])
    n = len(pairs)
    error = np.sqrt((n - 1) / n * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
    width, stiffness = fit(pairs)
    return {"width": width, "width_error": error[0], "stiffness": stiffness, "stiffness_error": error[1]}


def needed(case: Case, rows: list[dict]) -> dict:
    """Pad stiffness [N/m] and grip [N] that the paper's own shortfalls ask for."""
    nominal, out = case.rig.fingertip.normal_stiffness, {}
    for name in BLOCKS:
        width, sd = PRINTED[name]["width"]
        short = ACTUAL[name] - width
        grip = float(np.mean([row["grip"] for row in rows if row["object"] == name]))
        out[name] = {
            "short": short, "short_sd": math.hypot(sd, 0.0001), "grip_at_nominal": nominal * short / 2,
            "grip_recorded": grip, "stiffness_at_recorded_grip": 2 * grip / short,
            "stiffness": 2 * GRIPS / short,
        }  # fmt: skip
    return {"grip": GRIPS, "nominal_stiffness": nominal, "blocks": out,
            "grip_ratio": out["block2"]["short"] / out["block1"]["short"]}  # fmt: skip


def bayes(case: Case) -> dict:
    """Posterior widths [m] of all trials pooled, pads rigid and pads as the rig has them."""
    rigid = case.rig.model_copy(update={"fingertip": type(case.rig.fingertip)()})
    found = {"rigid": identify(case.trials, case.task, rigid), "compliant": identified(case)}
    return {
        pads: {name: {"mean": one.of(name, "width").mean(), "sd": one.of(name, "width").std(ddof=1)}
               for name in BLOCKS}
        for pads, one in found.items()
    }  # fmt: skip


def main() -> None:
    """Save the shortfalls of both sets of trials, what they need and what remains."""
    case = recorded()
    rows = shortfalls(case)
    save("rigid", {
        "recordings": rows, "simulated": shortfalls(simulated()),
        "from_the_data": {name: from_the_data(case, name) for name in BLOCKS},
        "needed": needed(case, rows), "bayes": bayes(case),
    })  # fmt: skip


if __name__ == "__main__":
    main()
